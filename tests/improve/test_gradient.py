"""The one update: parts add up to the whole, each term pulls the right way, and what is not finite stops it."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import pytest
import torch
from torch import Tensor

from prefrl.improve.gradient import Batch, adam, steer, step, update
from prefrl.improve.objectives import Objective, Reduction

V, L = 4, 3


@dataclass(frozen=True)
class Rows:
    """Sequences of choices among V, of up to L steps."""

    chosen: Tensor
    mask: Tensor

    def rows(self, at: Tensor) -> Rows:
        width = int(self.mask[at].sum(1).max())
        return Rows(self.chosen[at, :width], self.mask[at, :width])

    def order(self) -> Tensor:
        return self.mask.sum(1).argsort(stable=True)


class Table:
    """A policy without inputs: one distribution and one value for each step."""

    def __init__(self) -> None:
        self.logits = torch.nn.Parameter(torch.randn(L, V, generator=torch.Generator().manual_seed(0)))
        self.critic = torch.nn.Parameter(torch.zeros(L))

    def parameters(self) -> list[torch.nn.Parameter]:
        return [self.logits, self.critic]

    def log_prob(self, inputs: Rows) -> tuple[Tensor, Tensor]:
        logp = self.logits.log_softmax(-1)[: inputs.chosen.shape[1]]
        entropy = -(logp.exp() * logp).sum(-1)
        found = logp.expand(len(inputs.chosen), -1, -1).gather(2, inputs.chosen[..., None])[..., 0]
        return found * inputs.mask, entropy.expand_as(found) * inputs.mask

    def values(self, inputs: Rows) -> Tensor:
        return self.critic[: inputs.chosen.shape[1]].expand(inputs.chosen.shape)

    def log_prob_and_values(self, inputs: Rows) -> tuple[Tensor, Tensor, Tensor]:
        return *self.log_prob(inputs), self.values(inputs)


def batch_of(policy: Table, count: int = 6) -> Batch[Rows]:
    generator = torch.Generator().manual_seed(1)
    lengths = torch.randint(1, L + 1, (count,), generator=generator)
    mask = torch.arange(L) < lengths[:, None]
    rows = Rows(torch.randint(0, V, (count, L), generator=generator), mask)
    advantages = torch.randn(count, 1, generator=generator)
    logp = policy.log_prob(rows)[0].detach()
    return Batch(rows, logp, advantages, returns=advantages + 0.5)


def measure(
    objective: Objective, part: int | None = None, change: Callable[[Batch[Rows]], Batch[Rows]] = lambda b: b
) -> tuple[list[Tensor], dict[str, float]]:
    """The gradient of a step, of the logits and of the critic, and what the step measured."""
    policy = Table()
    optimizer = torch.optim.SGD(policy.parameters(), 1.0)
    before = [p.detach().clone() for p in policy.parameters()]
    metrics = step(policy, optimizer, change(batch_of(policy)), objective, part)
    return [old - p.detach() for old, p in zip(before, policy.parameters(), strict=True)], metrics


@pytest.mark.parametrize("reduction", ["token", "sequence", "constant"])
@pytest.mark.parametrize("part", [1, 2, 100])
def test_the_parts_of_a_minibatch_add_up_to_the_whole(reduction: Reduction, part: int) -> None:
    objective = Objective(clip=0.2, value=0.5, entropy=0.1, reduction=reduction)
    whole, once = measure(objective)
    parts, in_parts = measure(objective, part)
    torch.testing.assert_close(parts, whole)
    assert in_parts == pytest.approx(once, abs=1e-6)


def test_a_step_is_the_gradient_of_the_objective_written_out() -> None:
    found, metrics = measure(Objective(value=0.5, entropy=0.1))
    policy = Table()
    batch = batch_of(policy)
    logp, entropy = policy.log_prob(batch.inputs)
    mask, steps = batch.inputs.mask, batch.inputs.mask.sum()
    assert batch.returns is not None
    loss = (
        (-logp * batch.advantages * mask).sum()
        + 0.5 * ((policy.values(batch.inputs) - batch.returns) ** 2 / 2 * mask).sum()
        - 0.1 * (entropy * mask).sum()
    ) / steps
    torch.testing.assert_close(found, list(torch.autograd.grad(loss, policy.parameters())))
    assert metrics["loss"] == pytest.approx(float(loss.detach()))
    norm = torch.cat([g.flatten() for g in found]).norm()
    assert metrics["grad_norm"] == pytest.approx(float(norm))


@pytest.mark.parametrize(("away", "moves"), [(0.05, True), (0.3, False), (-0.3, True)])
def test_a_value_that_went_far_from_the_batchs_towards_its_target_learns_no_more(away: float, moves: bool) -> None:
    def gone(batch: Batch[Rows]) -> Batch[Rows]:
        now = torch.zeros_like(batch.logp)  # the table's
        return replace(batch, values=now - away, returns=torch.ones_like(now))

    found, metrics = measure(Objective(value=1.0, value_clip=0.1), change=gone)
    assert bool(found[1].any()) is moves
    # The larger loss counts: the one at the border, or the plain one where the value went the wrong way.
    expected = max(0.5, 0.5 * (1 + away - 0.1) ** 2) if away > 0 else 0.5
    assert metrics["value_loss"] == pytest.approx(expected)


def test_before_the_first_step_the_clip_changes_nothing_and_no_ratio_is_off() -> None:
    plain, _ = measure(Objective())
    clipped, metrics = measure(Objective(clip=0.2))
    torch.testing.assert_close(plain, clipped)
    assert metrics["ratio_error"] == pytest.approx(0.0, abs=1e-6)
    assert metrics["kl_old"] == pytest.approx(0.0, abs=1e-6)
    assert metrics["clipped"] == 0.0


def test_ratios_beyond_the_clip_are_counted_and_teach_nothing() -> None:
    def far(batch: Batch[Rows]) -> Batch[Rows]:
        return replace(batch, logp=batch.logp - 1.0, advantages=torch.ones_like(batch.advantages))

    found, metrics = measure(Objective(clip=0.2), change=far)
    assert metrics["clipped"] == 1.0
    assert metrics["ratio_error"] == pytest.approx(math.e - 1)
    assert metrics["kl_old"] == pytest.approx(math.e - 1 - 1.0)  # mean of r - 1 - log r, r = e
    assert not found[0].any()


def test_the_critic_can_learn_alone() -> None:
    found, metrics = measure(Objective(value=0.5, policy=False))
    assert not found[0].any()
    assert found[1].all()
    assert set(metrics) == {"loss", "value_loss", "grad_norm"}


def test_the_entropy_bonus_flattens() -> None:
    policy, start = Table(), Table()
    batch = replace(batch_of(policy, 400), advantages=torch.zeros(400, 1))
    update(policy, adam(policy.parameters(), 0.05), batch, [torch.arange(400)] * 60, Objective(entropy=1.0))
    flat = torch.full((L, V), -math.log(V))
    after, before = (p.logits.detach().log_softmax(-1) for p in (policy, start))
    assert (after - flat).abs().mean() < 0.7 * (before - flat).abs().mean()


def test_a_long_gradient_is_shortened() -> None:
    found, metrics = measure(Objective(max_grad_norm=0.01))
    assert metrics["grad_norm"] > 0.01
    assert torch.cat([g.flatten() for g in found]).norm() == pytest.approx(0.01, rel=1e-3)


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_loss_that_is_not_finite_stops_before_the_weights_change(bad: float) -> None:
    policy = Table()
    before, batch = policy.logits.detach().clone(), batch_of(policy)
    with pytest.raises(FloatingPointError, match=r"the loss of a gradient step is (nan|-?inf)"):
        step(
            policy, adam(policy.parameters(), 0.1), replace(batch, advantages=batch.advantages * bad), Objective(), None
        )
    assert torch.equal(policy.logits.detach(), before)


def test_each_minibatch_is_a_step_and_says_what_it_measured() -> None:
    policy = Table()
    minibatches = [torch.arange(2), torch.arange(2, 4), torch.arange(4, 6)]
    found = update(policy, adam(policy.parameters(), 0.1), batch_of(policy), minibatches, Objective())
    assert len(found) == 3
    assert all(metrics["grad_norm"] > 0 for metrics in found)


def test_the_learning_rate_follows_the_kl() -> None:
    optimizer = adam([torch.nn.Parameter(torch.zeros(1))], 1e-3)
    group = optimizer.param_groups[0]
    steer(optimizer, 0.05, 0.01, 1e-3)
    assert group["lr"] == pytest.approx(1e-3 / 1.5)
    steer(optimizer, 0.01, 0.01, 1e-3)
    assert group["lr"] == pytest.approx(1e-3 / 1.5)
    for _ in range(20):
        steer(optimizer, 0.0, 0.01, 1e-3)
    assert group["lr"] == pytest.approx(1e-2)
