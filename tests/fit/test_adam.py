"""Adam: torch.optim's numbers and states, without its surroundings."""

from __future__ import annotations

import subprocess
import sys

import pytest
import torch
from torch import Tensor

from prefrl.fit.adam import Adam


def parameters() -> list[Tensor]:
    order = torch.Generator().manual_seed(0)
    shapes: list[tuple[int, ...]] = [(50,), (), (3, 4), (7,)]
    found = [torch.randn(shape, generator=order).requires_grad_() for shape in shapes]
    return [*found[:-1], found[-1].detach().double().requires_grad_()]


def groups_of(tensors: list[Tensor]) -> list[dict[str, object]]:
    return [{"params": tensors[:2], "weight_decay": 0.1}, {"params": tensors[2:], "lr": 0.02, "eps": 1e-5}]


def test_it_goes_where_torchs_goes_to_the_bit_and_each_takes_up_the_others_state() -> None:
    ours, theirs = parameters(), parameters()
    one, other = Adam(groups_of(ours), 0.05), torch.optim.AdamW(groups_of(theirs), 0.05, weight_decay=0.0, fused=True)
    order = torch.Generator().manual_seed(1)
    for number in range(30):
        for i, (mine, its) in enumerate(zip(ours, theirs, strict=True)):
            seldom = i == 1 and number % 3  # a tensor without a gradient stays, and so do its moments
            mine.grad = None if seldom else torch.randn(mine.shape, generator=order, dtype=mine.dtype)
            its.grad = None if mine.grad is None else mine.grad.clone()
        one.step()
        other.step()
        assert all(torch.equal(mine, its) for mine, its in zip(ours, theirs, strict=True))
        if number == 10:
            state = one.state_dict()
            one.load_state_dict(other.state_dict())
            other.load_state_dict(state)
        one.param_groups[0]["lr"] = other.param_groups[0]["lr"] = 0.05 / (number + 1)


def test_a_state_before_the_first_step_takes_the_moments_away() -> None:
    (weights, *_) = parameters()
    optimizer = Adam([{"params": [weights]}], 0.1)
    fresh = optimizer.state_dict()
    for size in (1.0, 1000.0):
        before = weights.detach().clone()
        weights.grad = torch.full_like(weights, size)
        optimizer.step()
        # The first step is as long as the learning rate, whatever the gradient.
        torch.testing.assert_close(weights.detach(), before - 0.1)
        optimizer.load_state_dict(fresh)


def test_states_of_other_groups_are_refused() -> None:
    with pytest.raises(ValueError, match="zip"):
        Adam(groups_of(parameters()), 0.1).load_state_dict(Adam([{"params": parameters()}], 0.1).state_dict())


def test_gradients_go_where_they_are_asked_to() -> None:
    tensors = parameters()
    for tensor in tensors:
        tensor.grad = torch.ones_like(tensor)
    Adam(groups_of(tensors), 0.1).zero_grad()
    assert all(tensor.grad is None for tensor in tensors)


def test_torchs_compiler_is_not_loaded_for_a_step() -> None:
    code = """
import sys, torch
from prefrl.fit.adam import Adam
weights = torch.zeros(3, requires_grad=True)
weights.grad = torch.ones(3)
optimizer = Adam([{"params": [weights]}], 0.1)
optimizer.step()
optimizer.load_state_dict(optimizer.state_dict())
assert "torch._dynamo" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True)
