"""E perceptrons and their gradient, by hand: a small network's time goes into memory and calls, not into numbers.

One member after another, a piece of the steps at a time, as plain matrix products on what is still in cache: faster
than batched products of all members, and than what automatic differentiation makes of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Literal, NamedTuple, TypeAlias

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

NUMBERS = 262_144
"""In the widest layer of a piece: a megabyte."""

Activation: TypeAlias = Literal["tanh", "relu", "silu"]
Layers: TypeAlias = list[tuple[Tensor, Tensor]]
"""The weight (in, out) and bias (1, out) of each layer of one member; the last out is 1."""


class _Function(NamedTuple):
    forward: Callable[[Tensor], Tensor]
    backward: Callable[[Tensor, Tensor], Tensor]
    """(gradient of the output, what was kept) -> gradient of the input."""
    from_output: bool
    """Whether the derivative is had from the output, so that it may overwrite the input; else the input is kept."""


_aten = torch.ops.aten
_FUNCTIONS: dict[Activation, _Function] = {
    "tanh": _Function(torch.tanh_, lambda g, y: _aten.tanh_backward.grad_input(g, y, grad_input=g), True),
    "relu": _Function(torch.relu_, lambda g, y: _aten.threshold_backward.grad_input(g, y, 0, grad_input=g), True),
    "silu": _Function(torch.nn.functional.silu, lambda g, x: _aten.silu_backward.grad_input(g, x, grad_input=g), False),
}


class _Piece(NamedTuple):
    """What the gradient needs of one member's forward pass over some steps."""

    member: int
    steps: slice
    inputs: list[Tensor]
    """(S, in) of each layer."""
    activated: list[Tensor]
    """(S, out) of each hidden layer: the activation's output, or its input, as `_Function` wants it."""


def perceptrons(x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], activation: Activation) -> Tensor:
    """(S, I) steps that all members share, or (E, S, I) -> (E, S).

    A layer's `weights` are (E, in, out) and its `biases` (E, 1, out); the last layer's out is 1.
    """
    if torch.is_grad_enabled():
        found: Tensor = _Perceptrons.apply(x, activation, *weights, *biases)  # type: ignore[no-untyped-call]
        return found
    # Without a gradient nothing is kept, and each piece's memory is free again at once.
    return _all(x, weights, biases, _FUNCTIONS[activation], None)


class _Perceptrons(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, activation: Activation, *parameters: Tensor) -> Tensor:
        weights, biases = parameters[: len(parameters) // 2], parameters[len(parameters) // 2 :]
        ctx.save_for_backward(*weights)
        ctx.function, ctx.shape, ctx.pieces = _FUNCTIONS[activation], x.shape, []
        return _all(x, weights, biases, ctx.function, ctx.pieces)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        (gradient,), weights = gradients, ctx.saved_tensors
        of_weights = [torch.zeros_like(w) for w in weights]
        of_biases = [w.new_zeros(len(w), 1, w.shape[2]) for w in weights]
        # Zeros, since members that share the steps add up in it.
        of_x = gradient.new_zeros(ctx.shape) if ctx.needs_input_grad[0] else None
        for piece in ctx.pieces:
            of_input = None if of_x is None else _own(of_x, piece.member)[piece.steps]
            into = _layers(of_weights, of_biases, piece.member)
            of_output = gradient[piece.member, piece.steps, None]
            _backward(of_output, [w[piece.member] for w in weights], piece, ctx.function, into, of_input)
        return of_x, None, *of_weights, *of_biases


def _all(
    x: Tensor, weights: Sequence[Tensor], biases: Sequence[Tensor], function: _Function, pieces: list[_Piece] | None
) -> Tensor:
    """As `perceptrons`; what a gradient needs is appended to `pieces`, if there are any."""
    outputs = x.new_empty(len(weights[0]), x.shape[-2])
    size = max(1, NUMBERS // max(w.shape[2] for w in weights))  # by the widest layer, so that a piece stays in cache
    for member, steps in _pieces(len(outputs), x.shape[-2], size):
        piece = _Piece(member, steps, [_own(x, member)[steps]], [])
        # A view (S, 1) of the result, which the last product writes into: no copy.
        _forward(piece, _layers(weights, biases, member), function, outputs[member, steps, None])
        if pieces is not None:
            pieces.append(piece)
    return outputs


def _pieces(members: int, count: int, size: int) -> Iterator[tuple[int, slice]]:
    for member in range(members):
        for start in range(0, count, size):
            yield member, slice(start, start + size)


def _own(x: Tensor, member: int) -> Tensor:
    return x[member] if x.dim() == 3 else x


def _layers(weights: Sequence[Tensor], biases: Sequence[Tensor], member: int) -> Layers:
    return [(w[member], b[member]) for w, b in zip(weights, biases, strict=True)]


def _forward(piece: _Piece, layers: Layers, function: _Function, into: Tensor) -> None:
    """Outputs (S, 1) are written `into`, and what the gradient needs to the piece."""
    *hidden, (last_weight, last_bias) = layers
    for weight, bias in hidden:
        before = torch.addmm(bias, piece.inputs[-1], weight)
        after = function.forward(before)
        piece.activated.append(after if function.from_output else before)
        piece.inputs.append(after)
    torch.addmm(last_bias, piece.inputs[-1], last_weight, out=into)


def _backward(
    gradient: Tensor, weights: list[Tensor], piece: _Piece, function: _Function, into: Layers, of_input: Tensor | None
) -> None:
    """From the gradient of the outputs (S, 1) add those of the layers `into`, and that of the input to `of_input`."""
    for layer in reversed(range(len(weights))):
        of_weight, of_bias = into[layer]
        # In place and over all pieces: the gradients of a member add up here.
        of_weight.addmm_(piece.inputs[layer].T, gradient)
        of_bias.add_(gradient.sum(0))
        back = weights[layer].T
        if layer:
            gradient = gradient * back if len(back) == 1 else gradient @ back  # (S, 1) x (1, in)
            gradient = function.backward(gradient, piece.activated[layer - 1])  # overwrites `gradient`, which is ours
        elif of_input is not None:
            of_input.addmm_(gradient, back)
