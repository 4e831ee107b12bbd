"""The gradient by hand is that of automatic differentiation, for both heads and every term of the objective."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from control_stubs import point
from corridor import corridor
from torch import Tensor

from prefrl.improve import by_hand
from prefrl.improve.gradient import Batch, adam, step, update
from prefrl.improve.objectives import Objective
from prefrl.policies.acting import Decisions
from prefrl.policies.mlp import MLPPolicy, MLPPolicySettings
from prefrl.types import Metrics

B = 40
FULL = Objective(clip=0.2, value=0.5, entropy=0.1)
OBJECTIVES = {
    "ppo": FULL,
    "no entropy": Objective(clip=0.2, value=0.5),
    "a2c": Objective(value=0.7, entropy=0.01),
    "no critic": Objective(clip=0.1, entropy=0.3),
    "critic alone": Objective(clip=0.2, policy=False, value=0.5, entropy=0.1),
    "short": Objective(clip=0.2, value=0.5, entropy=0.1, max_grad_norm=1e-3),
}
HEADS = {"box": point(), "discrete": point(discrete=True), "legal": corridor()}


def policy_of(head: str, dtype: torch.dtype) -> MLPPolicy:
    """Some way from its start, so that no gradient is small by accident."""
    policy = MLPPolicySettings(hidden=(9, 7), initial_std=0.6).build(HEADS[head], np.random.default_rng(0))
    (weights,) = policy.parameters()
    weights.data = weights.data.to(dtype)
    weights.data += 0.3 * torch.randn(weights.shape, generator=torch.Generator().manual_seed(1), dtype=dtype)
    policy.to(policy.device)  # as after a move: the views are of the new memory
    return policy


def batch_of(policy: MLPPolicy, head: str, dtype: torch.dtype) -> Batch[Decisions]:
    """Ratios from about a half to two, so that the clip holds some of them, on both sides."""
    task, generator = HEADS[head], torch.Generator().manual_seed(2)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=dtype)

    choices, legal = normal(B, task.action_size), None
    if head != "box":
        legal = torch.rand(B, task.action_size, generator=generator) < 0.7 if head == "legal" else None
        places = torch.randint(task.action_size, (B,), generator=generator)
        choices = torch.eye(task.action_size, dtype=dtype)[places]
        legal = None if legal is None else legal | choices.bool()
    decisions = Decisions(normal(B, task.observation_size), choices, legal)
    with torch.no_grad():
        logp = policy.log_prob(decisions)[0] + 0.4 * normal(B, 1)
    return Batch(decisions, logp, normal(B, 1), normal(B, 1))


def stepped(head: str, dtype: torch.dtype, objective: Objective, hand: bool) -> tuple[Tensor, Tensor, Metrics]:
    """The gradient of a minibatch, where the step led, and what it measured."""
    policy = policy_of(head, dtype)
    batch, rows = batch_of(policy, head, dtype), torch.arange(3, B)
    optimizer = adam(policy.parameters(), 1e-3)
    if hand:
        (metrics,) = update(policy, optimizer, batch, [rows], objective)
    else:
        metrics = step(policy, optimizer, batch.rows(rows), objective, None)
    (weights,) = policy.parameters()
    assert weights.grad is not None
    return weights.grad, weights.detach(), metrics


@pytest.mark.parametrize("head", HEADS)
@pytest.mark.parametrize("name", OBJECTIVES)
@pytest.mark.parametrize(("dtype", "near"), [(torch.float32, 5e-6), (torch.float64, 1e-10)], ids=["single", "double"])
def test_a_step_by_hand_is_that_of_automatic_differentiation(
    head: str, name: str, dtype: torch.dtype, near: float
) -> None:
    ours, theirs = (stepped(head, dtype, OBJECTIVES[name], hand) for hand in (True, False))
    assert ours[0].dtype == dtype
    assert ours[0].abs().max() > 1e-4
    torch.testing.assert_close(ours[0], theirs[0], rtol=near, atol=near)
    if dtype == torch.float64:  # Adam's first step is about the gradient's sign, which rounding may turn
        torch.testing.assert_close(ours[1], theirs[1], rtol=near, atol=near)
    # Shares are single numbers in torch.
    assert ours[2] == pytest.approx(theirs[2], rel=20 * near, abs=max(20 * near, 1e-7))


def test_some_ratios_were_held_by_the_clip_and_some_were_not() -> None:
    assert 0.2 < stepped("box", torch.float64, FULL, hand=True)[2]["clipped"] < 0.9


def test_a_ratio_beyond_all_bounds_teaches_nothing() -> None:
    policy = policy_of("box", torch.float64)
    batch = batch_of(policy, "box", torch.float64)
    columns: dict[str, Any] = batch.columns() | {"logp": batch.columns()["logp"] - 1000.0}
    columns["advantages"] = -np.ones_like(columns["advantages"])  # the clip does not hold these
    by_hand.losses(policy, columns, Objective(clip=0.2))
    (weights,) = policy.parameters()
    assert weights.grad is not None
    assert not weights.grad.any()


def test_what_is_not_finite_stops_it_before_anything_changes() -> None:
    policy = policy_of("box", torch.float32)
    batch, before = batch_of(policy, "box", torch.float32), policy.state()["parameters"]
    batch.advantages[5] = float("nan")
    with pytest.raises(FloatingPointError, match="the loss of a gradient step is nan"):
        update(policy, adam(policy.parameters(), 1e-3), batch, [torch.arange(B)], FULL)
    for name, parameter in policy.state()["parameters"].items():
        assert torch.equal(parameter, before[name])
