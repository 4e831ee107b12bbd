"""Implicit Q-learning: recorded segments are imitated by how much better their actions are, by the learned reward.

Variant: Kostrikov et al. 2022: V by expectile regression on the smaller of two target Qs, Q towards r + discount V(s'),
the policy by advantage-weighted regression. The policy has no part in the critics, so it is learned after them; both
critics are learned anew in each round, whose reward is a new one. What differs: rewards are scaled by
sqrt(1 - discount^2), so that the temperature means about the same at any discount. A segment's last step leads out of
what was recorded and is not learned from; every other step has a future, also where an episode terminated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Literal, Self

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from prefrl.improve.gradient import adam, descend
from prefrl.improve.objectives import expectile_loss
from prefrl.improve.offline import Material, Offline, OfflineSettings, Recordings, gaussian
from prefrl.improve.pairs import means
from prefrl.policies.perceptron import perceptrons
from prefrl.policies.rollout import step_rewards
from prefrl.protocols import RewardModel, Task, control
from prefrl.reward_models.steps import uniform
from prefrl.seeding import generator
from prefrl.types import Integers, Metrics, Segment

MOST = 100.0
"""The largest weight of an action (section 4.3 and the paper's code)."""


class IQLSettings(OfflineSettings):
    """Implicit Q-learning on the learned reward over all segments: judged ones and those of the file."""

    kind: Literal["iql"] = "iql"
    cloning_epochs: int = Field(0, ge=0)
    """Passes over all segments before anything else is learned, in the first round."""
    discount: float = Field(0.99, ge=0, lt=1)
    """What a reward a step later counts for."""
    expectile: float = Field(0.7, gt=0, lt=1)
    """0.5 values what was done on average, towards 1 the best that was done."""
    temperature: float = Field(3.0, ge=0)
    """Inverse temperature of the weights exp(temperature x advantage); 0 clones."""
    target_rate: float = Field(0.005, gt=0, le=1)
    """How far the target critics follow at each step."""
    critic_steps: int = Field(5000, ge=1)
    """Gradient steps of the critics in a round."""
    policy_steps: int = Field(5000, ge=1)
    """Gradient steps of the policy in a round, after those."""
    minibatch: int = Field(256, ge=1)
    """Steps of behaviour in a gradient step."""

    def shrunk(self) -> Self:
        return super().shrunk().model_copy(update={"critic_steps": 2, "policy_steps": 2})

    def work(self) -> float:
        return float(self.critic_steps + self.policy_steps)

    def build(self, task: Task, rng: np.random.Generator) -> Offline:
        found = control(task, f"learner kind {self.kind!r} learns from segments of control")
        return Offline(self, found, partial(improve, self), gaussian(self, found, rng), self.discount)

    def formula(self) -> str:
        return (
            f"maximise  mean[ min({MOST:g}, exp({self.temperature:g} A)) log pi(a|s) ],  A = min Q'(s, a) - V(s)\n"
            f"V: expectile {self.expectile:g} of min Q';  Q: r + {self.discount:g} V(s');  "
            f"Q' follows Q by {self.target_rate:g}"
        )


@dataclass(frozen=True, eq=False)
class Networks:
    """E perceptrons of one number each."""

    weights: list[Tensor]
    biases: list[Tensor]

    @classmethod
    def new(cls, members: int, sizes: Sequence[int], rng: np.random.Generator, device: torch.device) -> Networks:
        order, pairs = generator(rng), list(pairwise(sizes))
        weights = [uniform((members, i, o), i, order) for i, o in pairs]
        biases = [uniform((members, 1, o), i, order) for i, o in pairs]
        for one in (*weights, *biases):
            one.data = one.data.to(device)
        return cls([*weights], [*biases])

    @property
    def parameters(self) -> list[torch.nn.Parameter]:
        return [one for one in (*self.weights, *self.biases) if isinstance(one, torch.nn.Parameter)]

    def copied(self) -> Networks:
        """The same, to follow these."""
        return Networks(*([one.detach().clone() for one in some] for some in (self.weights, self.biases)))

    def follow(self, other: Networks, rate: float) -> None:
        mine, theirs = ([*one.weights, *one.biases] for one in (self, other))
        torch._foreach_lerp_(mine, [one.detach() for one in theirs], rate)

    def __call__(self, x: Tensor) -> Tensor:
        """(S, I) -> (E, S)."""
        return perceptrons(x, self.weights, self.biases, "relu")


@dataclass(frozen=True, eq=False)
class Transitions:
    """M steps whose next step was recorded as well."""

    observations: Tensor
    """(S, O) normalised, of all steps."""
    inputs: Tensor
    """(S, O + A) with the choices."""
    rewards: Tensor
    """(S,)."""
    rows: Integers
    """(M,) which of the steps; each one's next stands right behind it."""

    @classmethod
    def of(
        cls, segments: Sequence[Segment], learner: Offline, reward: RewardModel[Segment], scale: float
    ) -> Transitions:
        """Raises ValueError where no segment has two steps."""
        recordings, device = Recordings.of(segments, learner.policy), learner.policy.device
        ends = recordings.starts + recordings.lengths - 1
        count = int(ends[-1]) + 1
        rows = np.setdiff1d(np.arange(count), ends)
        if not len(rows):
            raise ValueError("iql learns from what steps lead to: it needs segments of two steps or more")
        begins = np.zeros((1, count), bool)
        begins[0, recordings.starts] = True  # no reward looks back into another segment
        observations = np.concatenate([one.observations for one in segments])[None]
        actions = np.concatenate([one.actions for one in segments])[None]
        rewards = torch.from_numpy(step_rewards(reward).rewards(observations, actions, begins)[0]).float() * scale
        seen = recordings.decisions
        return cls(seen.observations, torch.cat([seen.observations, seen.choices], 1), rewards.to(device), rows)


def improve(
    settings: IQLSettings,
    learner: Offline,
    material: Material,
    reward: RewardModel[Segment],
    rng: np.random.Generator,
) -> Metrics:
    """Critics, then the policy. Metrics, means over the last tenth of gradient steps: value_loss, critic_loss, loss
    (the policy's) and grad_norm (its length before it is shortened); and weight, the mean of all actions.
    """
    scale = math.sqrt(1 - settings.discount**2)
    steps = Transitions.of(material.segments, learner, reward, scale)
    weights, metrics = _weights(settings, learner, steps, rng)
    decisions, seen = Recordings.of(material.segments, learner.policy).decisions, []
    for _ in range(settings.policy_steps):
        at = rng.integers(len(steps.rows), size=settings.minibatch)
        counts = weights[torch.from_numpy(at).to(weights.device)]
        seen.append(learner.descend(decisions, steps.rows[at], partial(_loss, learner, counts)))
    return metrics | _late(seen) | {"weight": float(weights.mean())}


def _weights(
    settings: IQLSettings, learner: Offline, steps: Transitions, rng: np.random.Generator
) -> tuple[Tensor, Metrics]:
    """Learn the critics; (M,) what each step's action counts."""
    device, hidden = learner.policy.device, settings.hidden
    value = Networks.new(1, (steps.observations.shape[1], *hidden, 1), rng, device)
    critic = Networks.new(2, (steps.inputs.shape[1], *hidden, 1), rng, device)
    target, seen = critic.copied(), []
    optimizers = [adam(one.parameters, settings.learning_rate) for one in (value, critic)]
    for _ in range(settings.critic_steps):
        at = torch.from_numpy(steps.rows[rng.integers(len(steps.rows), size=settings.minibatch)]).to(device)
        with torch.no_grad():
            best = target(steps.inputs[at]).amin(0)
        loss = expectile_loss(best - value(steps.observations[at])[0], settings.expectile).mean()
        found = descend(value.parameters, optimizers[0], [(loss, {})], settings.max_grad_norm)
        with torch.no_grad():
            goal = steps.rewards[at] + settings.discount * value(steps.observations[at + 1])[0]
        loss = ((critic(steps.inputs[at]) - goal) ** 2).mean(1).sum()
        other = descend(critic.parameters, optimizers[1], [(loss, {})], settings.max_grad_norm)
        target.follow(critic, settings.target_rate)
        seen.append({"value_loss": found["loss"], "critic_loss": other["loss"]})
    with torch.no_grad():
        rows = torch.from_numpy(steps.rows).to(device)
        advantages = target(steps.inputs[rows]).amin(0) - value(steps.observations[rows])[0]
        # Not clipped before exp: what overflows is infinite, and becomes the largest weight.
        return (settings.temperature * advantages).exp().clamp(max=MOST), _late(seen)


def _loss(learner: Offline, weights: Tensor, logp: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
    return (weights * (learner.policy.peak - logp[:, 0])).mean(), {}


def _late(seen: list[Metrics]) -> Metrics:
    """Means over the last tenth."""
    return means(seen[-max(1, len(seen) // 10) :])
