"""Perceptrons and their gradient, by hand: a small network's time goes into memory and calls, not into numbers.

One network is `forward` and `backward`, in NumPy, whose calls cost a fraction of torch's: policies of control step with
them. An ensemble's are one member after another, a piece of the steps at a time, as plain matrix products on what is
still in cache: faster than batched products of all members, and than what automatic differentiation makes of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from prefrl.seeding import to_numpy
from prefrl.types import Floats

NUMBERS = 65_536
"""In the widest layer of a piece: a quarter of a megabyte, so that all of them stay in cache."""

Activation: TypeAlias = Literal["tanh", "relu", "silu"]
Layers: TypeAlias = Sequence[tuple[Floats, Floats]]
"""The weight (in, out) and bias (1, out) of each layer of one network."""


def _tanh_back(gradient: Floats, y: Floats) -> None:
    slope = np.multiply(y, y)
    gradient *= np.subtract(1, slope, out=slope)


def _relu_back(gradient: Floats, y: Floats) -> None:
    gradient *= y > 0


def _silu(x: Floats) -> Floats:
    return x * _sigmoid(x)


def _silu_back(gradient: Floats, x: Floats) -> None:
    s = _sigmoid(x)
    gradient *= s * (1 + x * (1 - s))


def _sigmoid(x: Floats) -> Floats:
    found: Floats = 0.5 + 0.5 * np.tanh(0.5 * x)  # where 1 / (1 + exp(-x)) would overflow
    return found


class _Function(NamedTuple):
    forward: Callable[[Floats], Floats]
    """What has an output to go back from overwrites its input."""
    backward: Callable[[Floats, Floats], None]
    """(gradient of the output, what was kept): it becomes that of the input."""
    from_output: bool
    """Whether the derivative is had from the output; else the input is kept."""
    torch: Callable[[Tensor], Tensor]


_FUNCTIONS: dict[Activation, _Function] = {
    "tanh": _Function(lambda x: np.tanh(x, out=x), _tanh_back, True, torch.tanh),
    "relu": _Function(lambda x: np.maximum(x, 0, out=x), _relu_back, True, torch.relu),
    "silu": _Function(_silu, _silu_back, False, torch.nn.functional.silu),
}


def activated(x: Tensor, activation: Activation) -> Tensor:
    return _FUNCTIONS[activation].torch(x)


class Trace(NamedTuple):
    """What the gradient needs of a forward pass over S steps."""

    inputs: list[Floats]
    """(S, in) of each layer."""
    activated: list[Floats]
    """(S, out) of each hidden layer: the activation's output, or its input, as `_Function` wants it."""


# BLAS may raise flags for what it only touches, and who calls looks for what is not finite: warnings would say neither.
_QUIET = np.errstate(all="ignore")


@_QUIET
def forward(x: Floats, layers: Layers, activation: Activation, into: Floats | None = None) -> tuple[Floats, Trace]:
    """(S, in) -> (S, out), written `into` an array where one is given, and what `backward` needs."""
    function, trace = _FUNCTIONS[activation], Trace([x], [])
    *hidden, (last_weight, last_bias) = layers
    for weight, bias in hidden:
        before = trace.inputs[-1] @ weight
        before += bias
        after = function.forward(before)
        trace.activated.append(after if function.from_output else before)
        trace.inputs.append(after)
    outputs = np.matmul(trace.inputs[-1], last_weight, out=into)
    outputs += last_bias
    return outputs, trace


@_QUIET
def backward(
    gradient: Floats, layers: Layers, trace: Trace, activation: Activation, into: Layers, of_input: Floats | None = None
) -> None:
    """From the gradient of the outputs (S, out) write those of the layers `into`, and add that of the input to
    `of_input`."""
    ones = np.ones((1, len(gradient)), gradient.dtype)
    for layer in reversed(range(len(layers))):
        of_weight, of_bias = into[layer]
        np.matmul(trace.inputs[layer].T, gradient, out=of_weight)
        np.matmul(ones, gradient, out=of_bias)  # the sum, in half the time
        back = layers[layer][0].T
        if layer:
            gradient = gradient * back if len(back) == 1 else gradient @ back  # (S, 1) x (1, in)
            _FUNCTIONS[activation].backward(gradient, trace.activated[layer - 1])  # overwrites what is ours
        elif of_input is not None:
            of_input += gradient @ back


def perceptrons(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], activation: Activation) -> Tensor:
    """(S, I) steps that all members share, or (E, S, I) -> (E, S).

    A layer's `weights` are (E, in, out) and its `biases` (E, 1, out); the last layer's out is 1.
    """
    if not x.is_cpu:
        return _batched(x, weights, biases, activation)
    if torch.is_grad_enabled():
        found: Tensor = _Perceptrons.apply(x, activation, *weights, *biases)  # type: ignore[no-untyped-call]
        return found
    # Without a gradient nothing is kept, and each piece's memory is free again at once.
    return _all(x, weights, biases, activation, None)


def _batched(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], activation: Activation) -> Tensor:
    """For a device that likes few and large products."""
    x = x.expand(len(weights[0]), -1, -1) if x.dim() == 2 else x
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        x = _FUNCTIONS[activation].torch(torch.baddbmm(bias, x, weight))
    return torch.baddbmm(biases[-1], x, weights[-1])[..., 0]


class _Piece(NamedTuple):
    """A pass of one member over some steps."""

    member: int
    steps: slice
    trace: Trace


class _Perceptrons(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, activation: Activation, *parameters: Tensor) -> Tensor:
        weights, biases = parameters[: len(parameters) // 2], parameters[len(parameters) // 2 :]
        ctx.save_for_backward(*parameters)
        ctx.activation, ctx.shape, ctx.pieces = activation, x.shape, []
        return _all(x, weights, biases, activation, ctx.pieces)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        gradient, parameters = to_numpy(gradients[0]), [to_numpy(p) for p in ctx.saved_tensors]
        found, of_piece = [np.zeros_like(p) for p in parameters], [np.empty_like(p[0]) for p in parameters]
        half = len(parameters) // 2
        # Zeros, since members that share the steps add up in it.
        of_x = np.zeros(ctx.shape, gradient.dtype) if ctx.needs_input_grad[0] else None
        for piece in ctx.pieces:
            of_input = None if of_x is None else _own(of_x, piece.member)[piece.steps]
            layers, into = _layers(parameters, piece.member), list(zip(of_piece[:half], of_piece[half:], strict=True))
            of_output = gradient[piece.member, piece.steps, None]
            backward(of_output, layers, piece.trace, ctx.activation, into, of_input)
            for total, one in zip(found, of_piece, strict=True):
                total[piece.member] += one
        return None if of_x is None else torch.from_numpy(of_x), None, *map(torch.from_numpy, found)


def _all(
    x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], activation: Activation, pieces: list[_Piece] | None
) -> Tensor:
    """As `perceptrons`; what a gradient needs is appended to `pieces`, if there are any."""
    array, parameters = to_numpy(x), [to_numpy(p) for p in (*weights, *biases)]
    outputs = np.empty((len(weights[0]), x.shape[-2]), array.dtype)
    size = max(1, NUMBERS // max(w.shape[2] for w in weights))  # by the widest layer, so that a piece stays in cache
    for member, steps in _pieces(len(outputs), x.shape[-2], size):
        # A view (S, 1) of the result, which the last product writes into: no copy.
        into, layers = outputs[member, steps, None], _layers(parameters, member)
        _, trace = forward(_own(array, member)[steps], layers, activation, into)
        if pieces is not None:
            pieces.append(_Piece(member, steps, trace))
    return torch.from_numpy(outputs)


def _pieces(members: int, count: int, size: int) -> Iterator[tuple[int, slice]]:
    for member in range(members):
        for start in range(0, count, size):
            yield member, slice(start, start + size)


def _own(x: Floats, member: int) -> Floats:
    return x[member] if x.ndim == 3 else x


def _layers(parameters: Sequence[Floats], member: int) -> Layers:
    """Of a member, from the weights of all layers and then the biases."""
    half = len(parameters) // 2
    return [(w[member], b[member]) for w, b in zip(parameters[:half], parameters[half:], strict=True)]
