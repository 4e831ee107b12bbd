"""Our own policy gradients for control: REINFORCE with a baseline ... PPO, on the learned reward."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from prefrl.components import Settings
from prefrl.improve.objectives import (
    clipped_surrogate,
    gae,
    log_ratio,
    masked_mean,
    masked_whiten,
    policy_gradient,
    value_loss,
)
from prefrl.improve.policy import Policy
from prefrl.improve.rollout import (
    Rollout,
    collect,
    control,
    cut,
    evaluation,
    first_rollout,
    joined,
    learned_rewards,
    step_rewards,
    whole_episodes,
)
from prefrl.protocols import ControlTask, RewardModel, StepRewardModel, Store, Task
from prefrl.types import Evaluation, Floats, Metrics, Segment, State, Steps


class PPOSettings(Settings):
    """Policy gradients on the learned reward: PPO (Schulman et al. 2017); with clip=null, epochs=1 and trace=1 it is
    REINFORCE with a learned baseline."""

    kind: Literal["ppo"] = "ppo"
    environments: int = Field(16, ge=1)
    """How many are stepped side by side."""
    steps_per_round: int = Field(8192, ge=1)
    """Environment steps of one round's learning, all environments together; a multiple of `environments`."""
    rollout_steps: int = Field(128, ge=2)
    """Steps in each environment between updates, about: a round is divided into equal rollouts."""
    epochs: int = Field(10, ge=1)
    """Passes over each rollout."""
    minibatch: int = Field(256, ge=2)
    """Steps in a gradient step."""
    learning_rate: float = Field(1e-3, gt=0)
    """Adam's step size, or where it starts when it is steered."""
    discount: float = Field(0.99, ge=0, le=1)
    """What a reward a step later counts for."""
    trace: float = Field(0.95, ge=0, le=1)
    """GAE's lambda: 1 weighs whole returns, 0 only the next step."""
    target_kl: float | None = Field(0.01, gt=0)
    """Steer the learning rate until a rollout's updates move the policy by about this KL (nats); null keeps it."""
    clip: float | None = Field(0.2, gt=0)
    """How far the ratio of new to old probability counts; null for the plain policy gradient."""
    value_weight: float = Field(0.5, ge=0)
    """Weight of the critic's loss."""
    entropy: float = Field(0.01, ge=0)
    """Weight of the entropy bonus: it keeps a policy from settling on what an early, wrong reward praised."""
    critic_epochs: int = Field(10, ge=0)
    """Extra passes for the critic alone at the start of a round, when the reward is new to it."""
    max_grad_norm: float = Field(0.5, gt=0)
    """A gradient that is longer is shortened to this."""
    hidden: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers, of the policy and of the critic."""
    initial_std: float = Field(1.0, gt=0)
    """Of the actions' noise at the start, in units of half the action bounds."""
    evaluation_episodes: int = Field(20, ge=1)
    """Episodes of an evaluation, with the policy's mode, in environments of their own."""

    @model_validator(mode="after")
    def _whole_steps(self) -> PPOSettings:
        if self.steps_per_round % self.environments or self.steps_per_round < 2 * self.environments:
            raise ValueError(
                f"steps_per_round must be a multiple of environments, and at least twice it, "
                f"got {self.steps_per_round} and {self.environments}"
            )
        return self

    def shrunk(self) -> PPOSettings:
        steps = min(self.steps_per_round, self.environments * self.rollout_steps)
        return self.model_copy(update={"steps_per_round": steps, "evaluation_episodes": 1})

    def with_evaluation_of(self, other: PPOSettings) -> PPOSettings:
        return self.model_copy(update={"evaluation_episodes": other.evaluation_episodes})

    def work(self) -> float:
        return float(self.steps_per_round)

    def build(self, task: Task, rng: np.random.Generator) -> PPO:
        return PPO(self, control(task, self.kind), rng)

    def formula(self) -> str:
        """The objective, as text."""
        surrogate = (
            "log pi(a|s) A"
            if self.clip is None
            else f"min(r A, clip(r, {1 - self.clip:g}, {1 + self.clip:g}) A),  r = pi(a|s) / pi_old(a|s)"
        )
        lines = [
            f"maximise  mean[ {surrogate} ] + {self.entropy:g} H[pi] - {self.value_weight:g} mean[ (V(s) - R)^2 / 2 ]",
            f"A = GAE(discount {self.discount:g}, lambda {self.trace:g}) of the learned reward, whitened per rollout",
            "R = A + V before whitening; a time limit bootstraps from V(final observation), a termination does not",
            f"{self.epochs} epochs over each rollout; {self.critic_epochs} more for V alone after each reward fit",
        ]
        return "\n".join(lines)


@dataclass(frozen=True, eq=False)
class _Data:
    """A rollout as the update sees it; B = n x T steps."""

    inputs: Tensor
    """(B, O) normalised observations."""
    choices: Tensor
    """(B, A)."""
    logp: Tensor
    """(B,) of the choices, under the policy that made them."""
    advantages: Tensor
    """(B,) whitened."""
    returns: Tensor
    """(B,) the critic's targets."""


class PPO:
    """A `prefrl.protocols.Learner` of segments.

    Rewards are scored once a rollout, in one batch, and multiplied by sqrt(1 - discount^2): returns, and with them the
    critic's targets, are then of the order of one for any discount. The normaliser moves between a rollout's last
    update and the next rollout only, so the probability ratio is exactly 1 before the first gradient step.
    """

    def __init__(self, settings: PPOSettings, task: ControlTask, rng: np.random.Generator) -> None:
        self._settings, self._task = settings, task
        self.policy = Policy(task, settings.hidden, settings.initial_std, rng)
        self._parameters = [*self.policy.actor_parameters(), *self.policy.critic]
        self._optimizer = torch.optim.Adam(self._parameters, settings.learning_rate, eps=1e-5, fused=True)
        self._steps, self._rounds = Steps(), 0
        self._recent: Rollout | None = None

    @property
    def steps(self) -> Steps:
        return self._steps

    def sample(self, count: int, rng: np.random.Generator) -> list[Segment]:
        """Segments of the last round's rollouts; before the first round, of the starting policy (query steps)."""
        rollout = self._recent
        if rollout is None:
            most = self._settings.environments
            rollout = first_rollout(self._task, lambda o: self.policy.act(o, rng), count, most, rng)
            self._steps = self._steps.add(query=rollout.ends.size)
        return cut(rollout, self._task.segment_steps, count, f"round {self._rounds}", rng)

    def improve(self, reward: RewardModel[Segment], store: Store[Segment], rng: np.random.Generator) -> Metrics:
        """`steps_per_round` environment steps of learning, from fresh episodes."""
        scorer, count = step_rewards(reward), self._settings.environments
        envs, rollouts, metrics = self._task.environments(count), [], []
        observations = envs.reset(rng)
        for number, steps in enumerate(self._rollout_lengths()):
            rollout, observations = collect(envs, observations, steps, lambda o: self.policy.act(o, rng))
            self._steps = self._steps.add(learn=rollout.ends.size)
            metrics.append(self._learn(rollout, scorer, rng, critic_first=number == 0))
            rollouts.append(rollout)
        self._recent, self._rounds = joined(rollouts), self._rounds + 1
        return {name: float(np.mean([m[name] for m in metrics])) for name in metrics[0]}

    def evaluate(self, reward: RewardModel[Segment], rng: np.random.Generator) -> Evaluation[Segment]:
        """The policy's mode in fresh environments."""
        episodes = self._settings.evaluation_episodes
        rollout = whole_episodes(self._task, lambda o: self.policy.act(o, None), episodes, rng)
        self._steps = self._steps.add(evaluate=rollout.ends.size)
        return evaluation(self._task, rollout, reward)

    def state(self) -> State:
        recent = None if self._recent is None else self._recent.state()
        policy, optimizer = self.policy.state(), self._optimizer.state_dict()
        return {
            "policy": policy,
            "optimizer": optimizer,
            "recent": recent,
            "steps": list(self._steps),
            "rounds": self._rounds,
        }

    def load(self, state: State) -> None:
        self.policy.load(state["policy"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._recent = None if state["recent"] is None else Rollout(**state["recent"])
        self._steps, self._rounds = Steps(*state["steps"]), state["rounds"]

    def _rollout_lengths(self) -> list[int]:
        each = self._settings.steps_per_round // self._settings.environments
        parts = max(1, round(each / self._settings.rollout_steps))
        return [len(part) for part in np.array_split(np.arange(each), parts)]

    def _learn(
        self, rollout: Rollout, reward: StepRewardModel, rng: np.random.Generator, critic_first: bool
    ) -> Metrics:
        rewards = learned_rewards(reward, rollout)
        data, spread = self._data(rollout, rewards)
        if critic_first and self._settings.critic_epochs:
            for rows in self._minibatches(len(data.returns), self._settings.critic_epochs, rng):
                self._descend(self._value_loss(data, rows))
            data, spread = self._data(rollout, rewards)
        losses = [self._update(data, rows) for rows in self._minibatches(len(data.returns), self._settings.epochs, rng)]
        self.policy.observe(rollout.observations)
        self._steer(float(np.mean([loss[4] for loss in losses[-len(losses) // self._settings.epochs :]])))
        means = torch.tensor(losses).mean(0).tolist()
        names = ("policy_loss", "value_loss", "entropy", "clipped", "kl_old")
        return dict(zip(names, means, strict=True)) | {"explained": spread, "reward": float(rewards.mean())}

    @torch.no_grad()
    def _data(self, rollout: Rollout, rewards: Floats) -> tuple[_Data, float]:
        """What the update needs, and the share of the returns' variance that the critic explains."""
        settings, policy = self._settings, self.policy
        inputs = torch.from_numpy(policy.normalise(rollout.observations))
        values = policy.values(inputs)
        ends = torch.from_numpy(rollout.ends)
        scaled = torch.from_numpy(rewards).float() * _scale(settings.discount)
        advantages = gae(scaled, values, self._next_values(rollout, values), ends, settings.discount, settings.trace)
        returns = advantages + values
        explained = 1.0 - float(advantages.var() / returns.var().clamp(min=1e-12))
        flat, choices = inputs.flatten(0, 1), torch.from_numpy(rollout.choices).flatten(0, 1)
        white = masked_whiten(advantages, torch.ones_like(advantages))
        logp, _ = policy.log_prob(flat, choices)
        return _Data(flat, choices, logp, white.flatten(), returns.flatten()), explained

    def _next_values(self, rollout: Rollout, values: Tensor) -> Tensor:
        """(n, T): the value of what each step led to."""
        unseen = rollout.ends.copy()
        unseen[:, -1] = True
        final = torch.from_numpy(self.policy.normalise(rollout.final_observations[unseen]))
        following = torch.cat([values[:, 1:], values[:, :1]], 1)
        following[torch.from_numpy(unseen)] = self.policy.values(final)
        return following * ~torch.from_numpy(rollout.terminated)

    def _minibatches(self, size: int, epochs: int, rng: np.random.Generator) -> list[Tensor]:
        parts = max(1, round(size / self._settings.minibatch))
        orders = [torch.from_numpy(rng.permutation(size)) for _ in range(epochs)]
        return [rows for order in orders for rows in order.tensor_split(parts)]

    def _value_loss(self, data: _Data, rows: Tensor) -> Tensor:
        returns = data.returns[rows]
        return value_loss(self.policy.values(data.inputs[rows]), returns, returns).mean()

    def _update(self, data: _Data, rows: Tensor) -> list[float]:
        """One gradient step; policy loss, value loss, entropy, share of clipped ratios, KL(old || new)."""
        settings = self._settings
        logp, entropies = self.policy.log_prob(data.inputs[rows], data.choices[rows])
        advantages, mask = data.advantages[rows], torch.ones_like(logp)
        ratios = log_ratio(logp, data.logp[rows], mask)
        gain = (
            policy_gradient(logp, advantages)
            if settings.clip is None
            else clipped_surrogate(ratios, advantages, settings.clip)
        )
        policy_loss, values, entropy = masked_mean(gain, mask), self._value_loss(data, rows), entropies.mean()
        self._descend(policy_loss + settings.value_weight * values - settings.entropy * entropy)
        with torch.no_grad():
            clipped = (ratios.expm1().abs() > (settings.clip or float("inf"))).float().mean()
            kl = (ratios.expm1() - ratios).mean()
            return torch.stack([policy_loss, values, entropy, clipped, kl]).tolist()

    def _steer(self, kl: float) -> None:
        """Move the learning rate by a factor of 1.5 at most once a rollout, as far as a hundredth or tenfold."""
        target, group = self._settings.target_kl, self._optimizer.param_groups[0]
        if target is None:
            return
        factor = 1 / 1.5 if kl > 2 * target else 1.5 if kl < target / 2 else 1.0
        low, high = 0.01 * self._settings.learning_rate, 10 * self._settings.learning_rate
        group["lr"] = min(max(group["lr"] * factor, low), high)

    def _descend(self, loss: Tensor) -> None:
        self._optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self._parameters, self._settings.max_grad_norm, error_if_nonfinite=True)
        self._optimizer.step()


def _scale(discount: float) -> float:
    """Returns of white noise of std 1 have a std of 1 / sqrt(1 - discount^2): this undoes it."""
    return math.sqrt(1.0 - discount**2) or 1.0
