"""The assembled control learner against the same round written out by hand: one rollout, one gradient step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import torch
from control_stubs import Known, point
from torch import Tensor

from prefrl.improve.control import ControlLearner, ControlLearnerSettings
from prefrl.policies.mlp import MLPPolicySettings
from prefrl.store import Store
from prefrl.types import Segment, State

RATE, ENTROPY, VALUE, DISCOUNT, TRACE = 1e-2, 0.1, 0.5, 0.9, 0.8


def _learner(**settings: Any) -> ControlLearner:
    """Two environments, 30 steps in each: an episode ends after 20, and the rollout cuts the next one off."""
    return ControlLearnerSettings(
        environments=2,
        steps_per_round=60,
        rollout_steps=30,
        **{"epochs": 1, "critic_epochs": 0, "minibatch": 60, "target_kl": None} | settings,
        discount=DISCOUNT,
        trace=TRACE,
        learning_rate=RATE,
        entropy=ENTROPY,
        value_weight=VALUE,
        max_grad_norm=1e9,
        policy=MLPPolicySettings(hidden=(4,), initial_std=0.5),
        evaluation_episodes=3,
    ).build(point(), np.random.default_rng(0))


def _network(weights: dict[str, Tensor], name: str, x: Tensor) -> Tensor:
    hidden = torch.tanh(x @ weights[f"{name}_0"].T + weights[f"{name}_1"])
    return hidden @ weights[f"{name}_2"].T + weights[f"{name}_3"]


def _normalised(policy: State, observations: np.ndarray) -> Tensor:
    return torch.from_numpy((observations - policy["mean"]) / np.sqrt(policy["variance"])).float()


@dataclass(frozen=True)
class Expected:
    """What one step on a rollout comes to."""

    metrics: dict[str, float]
    gradients: dict[str, Tensor]


def _by_hand(policy: State, recent: State) -> Expected:
    """Advantages as sums over what follows, the surrogate at ratio 1, and torch's own normal distribution."""
    weights = {name: p.clone().requires_grad_() for name, p in policy["parameters"].items()}
    inputs = _normalised(policy, recent["observations"])
    values = _network(weights, "critic", inputs)[..., 0]
    later = _network(weights, "critic", _normalised(policy, recent["final_observations"]))[..., 0].detach()
    rewards = torch.from_numpy(1.0 - 2.0 * np.abs(recent["observations"][..., 0])) * (1 - DISCOUNT**2) ** 0.5
    surprise = (rewards + DISCOUNT * later - values.detach()).double()
    ends, advantages = recent["terminated"] | recent["truncated"], torch.zeros(surprise.shape, dtype=torch.float64)
    for row in range(surprise.shape[0]):
        for start in range(surprise.shape[1]):
            for t in range(start, surprise.shape[1]):
                advantages[row, start] += (DISCOUNT * TRACE) ** (t - start) * surprise[row, t]
                if ends[row, t]:
                    break
    returns = advantages + values.detach()
    white = (advantages - advantages.mean()) / advantages.std(correction=0)
    normal = torch.distributions.Normal(_network(weights, "actor", inputs), weights["log_std"].exp())
    logp = normal.log_prob(torch.from_numpy(recent["choices"])).sum(-1)  # type: ignore[no-untyped-call]
    gain = ((logp - logp.detach()).exp() * white).mean()
    value = ((values - returns) ** 2 / 2).mean()
    entropy = normal.entropy().sum(-1).mean()  # type: ignore[no-untyped-call]
    loss = -gain + VALUE * value - ENTROPY * entropy
    gradients = dict(zip(weights, torch.autograd.grad(loss, list(weights.values())), strict=True))
    length = torch.stack([g.square().sum() for g in gradients.values()]).sum().sqrt()
    metrics = {"loss": loss, "value_loss": value, "entropy": entropy, "grad_norm": length}
    return Expected({name: float(x.detach()) for name, x in metrics.items()}, gradients)


@pytest.mark.parametrize("rounds_before", [0, 2])
def test_a_round_is_the_step_that_is_written_out_by_hand(store: Store[Segment], rounds_before: int) -> None:
    """The normaliser is the one that acted, rewards are scaled, advantages whitened, and entropy is wanted."""
    learner = _learner()
    for number in range(rounds_before):
        learner.improve(Known(), store, np.random.default_rng(number))
    before = learner.policy.state()
    metrics = learner.improve(Known(), store, np.random.default_rng(9))
    expected = _by_hand(before, learner.state()["recent"])
    assert {name: metrics[name] for name in expected.metrics} == pytest.approx(expected.metrics, rel=1e-4)
    if rounds_before:
        return
    for name, gradient in expected.gradients.items():  # Adam's first step has one length, and the gradient's signs
        moved = learner.policy.state()["parameters"][name] - before["parameters"][name]
        torch.testing.assert_close(moved, -RATE * gradient / (gradient.abs() + 1e-5), rtol=0.01, atol=RATE / 100)


def test_the_normaliser_knows_all_that_was_seen_once_a_round_is_over(store: Store[Segment]) -> None:
    learner, seen = _learner(), []
    for number in range(2):
        learner.improve(Known(), store, np.random.default_rng(number))
        seen.append(learner.state()["recent"]["observations"].reshape(-1, 1).astype(np.float64))
    policy, every = learner.policy.state(), np.concatenate(seen)
    assert policy["count"] == 120
    np.testing.assert_allclose(policy["mean"], every.mean(0), rtol=1e-9)
    np.testing.assert_allclose(policy["variance"], every.var(0), rtol=1e-9)


def test_after_the_critics_own_epochs_returns_and_advantages_are_made_anew(store: Store[Segment]) -> None:
    """Rewards of sqrt(1 - 0.9^2) a step: what the critic has learned by heart, about 0.44 / (1 - 0.9 x 0.8), is not
    the whole return yet. It is off by about one from its new targets, from the old ones not at all; without epochs of
    its own it would be off by about 1.3."""
    flat = Known(lambda o, a: np.ones(o.shape[:-1]))
    metrics = _learner(critic_epochs=300).improve(flat, store, np.random.default_rng(0))
    assert 0.3 < metrics["value_loss"] < 0.6


@pytest.mark.parametrize(("target", "factor"), [(None, 1.0), (1e9, 1.5), (1e-9, 1 / 1.5)])
def test_a_round_steers_the_learning_rate_by_how_far_the_policy_went(
    store: Store[Segment], target: float | None, factor: float
) -> None:
    learner = _learner(epochs=2, minibatch=30, target_kl=target)
    assert learner.improve(Known(), store, np.random.default_rng(0))["kl_old"] > 1e-6
    (group,) = learner.state()["optimizer"]["param_groups"]
    assert group["lr"] == pytest.approx(RATE * factor)


@pytest.mark.parametrize("discrete", [False, True])
def test_an_evaluation_plays_the_mode(discrete: bool) -> None:
    task = point(discrete)
    learner = ControlLearnerSettings(policy=MLPPolicySettings(hidden=(4,)), evaluation_episodes=3).build(
        task, np.random.default_rng(0)
    )
    found = learner.evaluate(Known(), np.random.default_rng(1)).examples
    policy = learner.policy.state()
    for segment in found:
        mode = _network(policy["parameters"], "actor", _normalised(policy, segment.observations)).numpy()
        expected = np.eye(2)[mode.argmax(1)] if discrete else mode.clip(-1, 1)
        np.testing.assert_allclose(segment.actions, expected, atol=1e-5)
