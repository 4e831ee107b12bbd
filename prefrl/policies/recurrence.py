"""Gated recurrent units over sequences, and their gradient by hand: between small products, calls are what takes time.

The unit is that of Cho et al. 2014, with the reset gate after the product. E networks of one width go step by step
together. On other devices than the CPU it is automatic differentiation; a test holds the two together.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from prefrl.seeding import to_numpy
from prefrl.types import Floats


def recurrence(gates: Tensor, start: Tensor, weight: Tensor, bias: Tensor, begins: Tensor) -> Tensor:
    """(L, E, B, H): the states after each step.

    `gates` (L, E, B, 3 H): what the inputs add to the gates reset, update and new; `start` (E, B, H): the state before
    the first step; `weight` (E, H, 3 H) and `bias` (E, 1, 3 H): of the state's own share; `begins` (L, B) bool: before
    these steps the state is set to zero.
    """
    if gates.is_cpu:
        found: Tensor = _ByHand.apply(gates, start, weight, bias, begins)  # type: ignore[no-untyped-call]
        return found
    return differentiable(gates, start, weight, bias, begins)


def differentiable(gates: Tensor, start: Tensor, weight: Tensor, bias: Tensor, begins: Tensor) -> Tensor:
    """The same by torch's own operations."""
    width, state, states = start.shape[2], start, list[Tensor]()
    keep = (~begins).to(start.dtype)[:, None, :, None]  # (L, 1, B, 1)
    for gate, kept in zip(gates.unbind(), keep.unbind(), strict=True):
        state = state * kept
        own = torch.baddbmm(bias, state, weight)
        reset, update = (gate[..., : 2 * width] + own[..., : 2 * width]).sigmoid().chunk(2, -1)
        new = torch.tanh(gate[..., 2 * width :] + reset * own[..., 2 * width :])
        state = torch.lerp(new, state, update)  # (1 - update) new + update state
        states.append(state)
    return torch.stack(states)


def unit(gate: Floats, state: Floats, weight: Floats, bias: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """One step in NumPy: (E, B, 3 H) and (E, B, H) -> the next state, both gates (E, B, 2 H), the new part and the
    state's own share of it (E, B, H)."""
    width = state.shape[2]
    own = state @ weight
    own += bias
    gated = gate[..., : 2 * width] + own[..., : 2 * width]
    # The sigmoid, by tanh: exp may overflow.
    gated *= 0.5
    np.tanh(gated, out=gated)
    gated += 1.0
    gated *= 0.5
    part = own[..., 2 * width :]
    new = gated[..., :width] * part
    new += gate[..., 2 * width :]
    np.tanh(new, out=new)
    following = state - new
    following *= gated[..., width:]
    following += new
    return following, gated, new, part


class _ByHand(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, gates: Tensor, start: Tensor, weight: Tensor, bias: Tensor, begins: Tensor) -> Tensor:
        inputs, own_weight, own_bias = to_numpy(gates), to_numpy(weight), to_numpy(bias)
        state, over = to_numpy(start), to_numpy(begins)
        (steps, _, _, _), some = inputs.shape, [bool(row.any()) for row in over]
        shape = (steps, *state.shape)
        states, before, new, part = (np.empty(shape, state.dtype) for _ in range(4))
        gated = np.empty((*shape[:-1], 2 * shape[-1]), state.dtype)
        for t in range(steps):
            before[t] = np.where(over[t][:, None], 0, state) if some[t] else state
            state, gated[t], new[t], part[t] = unit(inputs[t], before[t], own_weight, own_bias)
            states[t] = state
        ctx.save_for_backward(weight)
        ctx.kept, ctx.over, ctx.some = (before, gated, new, part), over, some
        return torch.from_numpy(states)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> Any:
        of_states, weight = to_numpy(gradients[0]), to_numpy(ctx.saved_tensors[0])
        before, gated, new, part = ctx.kept
        width = new.shape[-1]
        reset, update = gated[..., :width], gated[..., width:]
        # What a unit of the state's gradient adds to that of each gate, for all steps at once.
        of_new = (1 - update) * (1 - new * new)
        of_reset = of_new * part * reset * (1 - reset)
        of_update = (before - new) * update * (1 - update)
        of_gates = np.stack([of_reset, of_update, of_new * reset], -2)  # (L, E, B, 3, H) of the state's own share
        back, carry = weight.swapaxes(1, 2), np.zeros(new.shape[1:], new.dtype)
        of_state = np.empty_like(new)
        for t in reversed(range(len(new))):
            of_state[t] = carry = of_states[t] + carry
            of_gates[t] *= carry[..., None, :]
            carry = carry * update[t] + of_gates[t].reshape(*carry.shape[:2], -1) @ back
            if ctx.some[t]:
                carry = np.where(ctx.over[t][:, None], 0, carry)
        own = _by_network(of_gates.reshape(*new.shape[:3], -1))  # (E, L B, 3 H)
        of_weight, of_bias = _by_network(before).swapaxes(1, 2) @ own, own.sum(1, keepdims=True)
        of_gates[..., 2, :] = of_new * of_state  # of the inputs' share: no reset gate on the way
        of_inputs = of_gates.reshape(*new.shape[:3], -1)
        return *map(torch.from_numpy, (of_inputs, carry, of_weight, of_bias)), None


def _by_network(x: Floats) -> Floats:
    """(L, E, B, n) -> (E, L B, n)"""
    return x.swapaxes(0, 1).reshape(x.shape[1], -1, x.shape[3])


__all__ = ["differentiable", "recurrence", "unit"]
