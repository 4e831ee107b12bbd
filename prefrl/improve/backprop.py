"""The gradient of the learned return, through the learned world, the learned reward and the policy.

Variant: SVG (Heess et al. 2015, section 4), whose stochastic values become the policy's own noise and a member drawn
for each branch, in a learned world as PILCO's (Deisenroth and Rasmussen 2011) and MAAC's (Clavera et al. 2020): n steps
of rewards, then a value that is fitted by TD on the same imagined steps. The idea is Werbos's (1988). What differs: the
world is an ensemble of deterministic members, noise of the policy is not learned, and the value at the end is a V where
MAAC has a Q. What is left out: gradients through whether an episode ends.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from prefrl.components import ConfigError, Settings
from prefrl.envs.learned import WorldSettings
from prefrl.improve.gradient import adam, descend
from prefrl.improve.grounded import Grounded
from prefrl.improve.player import Player
from prefrl.improve.through import Branch, follow, held, returns, traced_rewards
from prefrl.policies.acting import Actor, Memory, played
from prefrl.policies.mlp import MLPPolicySettings
from prefrl.protocols import ControlTask, RewardModel, Store, Task, TracedRewards, simulated
from prefrl.seeding import Device, device_of
from prefrl.types import Evaluation, Floats, Metrics, Segment, State, Steps


class BackpropSettings(Settings):
    """The gradient of the learned return through a learned world: few real steps, and few imagined ones."""

    kind: Literal["backprop"] = "backprop"
    world: WorldSettings = WorldSettings()
    """The ensemble of dynamics."""
    episodes: int = Field(2, ge=1)
    """Real episodes of a round after the first, which are asked about and learned from. In the first one the starting
    policy plays as many as its queries need."""
    steps: int = Field(20, ge=1)
    """Steps of a branch, which the gradient goes back through; fewer where the world cannot be trusted so far."""
    branches: int = Field(20, ge=1)
    """Branches of a gradient step, each from a real state; rounded up to as many for each member of the world."""
    updates: int = Field(100, ge=1)
    """Gradient steps of a round."""
    follow: Literal["member", "mean"] = "member"
    """What a branch follows: one of the world's members, or the mean of them all in each step."""
    noise: bool = True
    """Whether actions in branches are drawn, as in real episodes, or the policy's mode."""
    value: bool = True
    """Whether what follows a branch counts, by a value that is fitted on the same steps; else nothing follows."""
    learning_rate: float = Field(3e-3, gt=0)
    """Adam's step size; it falls to 0 in the second half of the run."""
    discount: float = Field(0.97, ge=0, lt=1)
    """What a reward a step later counts for."""
    max_grad_norm: float = Field(1.0, gt=0)
    """A gradient that is longer is shortened to this: through many steps one may grow without bounds."""
    policy: MLPPolicySettings = MLPPolicySettings(squash=True, initial_std=0.3)
    """The network that acts, and the one that values. Squashed: where an action is clipped it has no gradient."""

    evaluation_episodes: int = Field(20, ge=1)
    """Real episodes of an evaluation, with the policy's mode, in environments of their own."""
    device: Device = "auto"
    """Where the policy, the world and the reward model compute: `auto` is the GPU where there is one."""
    threads: int | None = Field(1, ge=1)
    """With how many threads torch and BLAS compute; null leaves it to them."""

    @model_validator(mode="after")
    def _plain_noise(self) -> BackpropSettings:
        if self.policy.sde:
            raise ValueError("policy.sde: no gradient goes through noise that is a function of features; leave it out")
        return self

    def shrunk(self) -> BackpropSettings:
        small = {"world": self.world.shrunk(), "episodes": 1, "updates": 2, "evaluation_episodes": 1}
        return self.model_copy(update=small)

    def with_evaluation_of(self, other: BackpropSettings) -> BackpropSettings:
        return self.model_copy(update={"evaluation_episodes": other.evaluation_episodes})

    def work(self) -> float:
        return float(self.updates * self.branches * self.steps)

    def real_work(self) -> float:
        return float(self.episodes)

    def build(self, task: Task, rng: np.random.Generator) -> Backprop:
        """Raises `ConfigError` for discrete actions."""
        found = simulated(task, f"learner kind {self.kind!r} plays real episodes of control")
        if found.action_bounds is None:
            raise ConfigError(
                f"learner.kind=backprop needs continuous actions, which a gradient can go through, and those of "
                f"{found.name} are discrete: use learner.kind=dyna, which learns in the same world"
            )
        return Backprop(self, found, rng)

    def formula(self) -> str:
        end = f" + {self.discount:g}^n V(s_n)" if self.value else ""
        lines = [
            f"maximise  mean[ sum over n = {self.steps} steps t of {self.discount:g}^t r(s_t, a_t){end} ]",
            f"s_t+1 = f(s_t, a_t) by the {'mean of members' if self.follow == 'mean' else 'member of the branch'},  "
            f"a_t = pi(s_t{', noise' if self.noise else ''}),  s_0 real",
        ]
        return "\n".join([*lines, *(["V: minimise mean[ (V(s_t) - r_t - ... - V(s_n))^2 ] / 2"] if self.value else [])])


class Backprop:
    """A `prefrl.protocols.Learner` of segments: real steps teach the world, its gradient the policy."""

    def __init__(self, settings: BackpropSettings, task: ControlTask, rng: np.random.Generator) -> None:
        self._settings, self._task, device = settings, task, device_of(settings.device)
        self.ground = Grounded(settings.world, task, device, rng)
        self.policy = settings.policy.build(task, rng)
        self.policy.to(device)
        self._optimizer = adam(self.policy.parameters(), settings.learning_rate)
        self._player = Player(task, settings.branches)
        self._imagined, self._span = 0, (0.0, 0.0)

    @property
    def steps(self) -> Steps:
        return self._player.steps.add(learn=self.ground.spent, imagined=self._imagined + self.ground.dreamt)

    def check_reward(self, reward: RewardModel[Any]) -> None:
        traced_rewards(reward)

    def sample(self, count: int, rng: np.random.Generator) -> list[Segment]:
        """Segments of real episodes of the policy as it is; the world learns from these as well."""
        if not self.ground.begun:
            self.ground.begin(count, played(self.actor(), rng), 64, rng)
        elif not self.ground.fresh:
            self._play(rng)
        return self.ground.segments(count, rng)

    def imagine(self, count: int, rng: np.random.Generator) -> list[Segment]:
        """Segments of imagined branches of the policy as it is."""
        return self.ground.imagine(count, self._settings.episodes, played(self.actor(), rng), rng)

    def improve(self, reward: RewardModel[Segment], store: Store[Segment], rng: np.random.Generator) -> Metrics:
        """Fit the world on all real steps, then take `updates` gradient steps through it.

        Metrics: those of the world's fit (`World.fit`); means over gradient steps of imagined_return (discounted, of a
        branch, without what follows it), value_loss and grad_norm (before it is shortened); and branch, the mean length
        of branches in steps. Where nothing can be imagined the policy stays as it is, and a note says so.
        """
        if not self.ground.fresh:
            self._play(rng)
        found, data = self.ground.learn(rng), self.ground.data
        length = min(self._settings.steps, self.ground.world.reach)
        if not length or data is None:
            return found | {"branch": 0.0}
        self.policy.observe(data.observations)
        seen = []
        with held([*self.ground.world.parameters(), *reward.parameters()]):
            for number in range(self._settings.updates):
                self._optimizer.param_groups[0]["lr"] = self._rate(number / self._settings.updates)
                seen.append(self._update(data.starts, traced_rewards(reward), length, rng))
        return {name: float(np.mean([one[name] for one in seen])) for name in seen[0]} | found

    def evaluate(self, reward: RewardModel[Segment], rng: np.random.Generator) -> Evaluation[Segment]:
        """The policy's mode in real episodes; and `imagined`, as Dyna has it."""
        act = played(self.actor(), None)
        found = self._player.evaluate(self._settings.evaluation_episodes, act, reward, rng)
        metrics = dict(found.metrics)
        if self.ground.world.fitted and reward.fitted:
            starts = np.stack([one.observations[0] for one in found.candidates])
            worth = self.ground.imagined_returns(starts, played(self.actor(), None), reward, rng)
            metrics["imagined"] = float(worth.mean())
        return replace(found, metrics=metrics, notes=(*found.notes, *self.ground.notes))

    def pace(self, begin: float, end: float) -> None:
        self._span = begin, end

    def actor(self) -> Actor:
        decide = self.policy.decide()

        def act(observations: Floats, rng: np.random.Generator | None, memory: Memory) -> tuple[Floats, Memory]:
            _, actions, memory = decide(observations, rng, None, memory)
            return actions, memory

        return act

    def save(self, path: Path) -> None:
        """As a zip of stable-baselines3's PPO. Raises ConfigError for a policy that squashes, as it has none such."""
        from prefrl.improve.to_sb3 import save_ppo  # stable-baselines3 takes a second to load

        save_ppo(self.policy, self._task, path)

    def state(self) -> State:
        parts = {"ground": self.ground.state(), "policy": self.policy.state(), "player": self._player.state()}
        return parts | {"optimizer": self._optimizer.state_dict(), "imagined": self._imagined}

    def load(self, state: State) -> None:
        self.ground.load(state["ground"])
        self.policy.load(state["policy"])
        self._player.load(state["player"])
        self._optimizer.load_state_dict(state["optimizer"])
        self._imagined = state["imagined"]

    def _play(self, rng: np.random.Generator) -> None:
        self.ground.play(self._settings.episodes, played(self.actor(), rng), rng)

    def _rate(self, done: float) -> float:
        """The learning rate when that share of the round is done."""
        begin, end = self._span
        return self._settings.learning_rate * min(1.0, 2 * (1 - begin - (end - begin) * done))

    def _update(self, starts: Floats, reward: TracedRewards, length: int, rng: np.random.Generator) -> Metrics:
        settings, world = self._settings, self.ground.world
        count = -(-settings.branches // world.members) * world.members
        begun = torch.from_numpy(starts[rng.integers(len(starts), size=count)]).to(world.device)
        drawn = rng.standard_normal((length, count, self._task.action_size), np.float32) if settings.noise else None
        noise = None if drawn is None else torch.from_numpy(drawn).to(world.device)
        found = follow(self.policy, world, begun, noise, length, settings.follow == "mean")
        self._imagined += count * length
        rewards = reward.traced(found.observations[:, :-1], found.actions) * math.sqrt(1 - settings.discount**2)
        return self._descend(found, rewards)

    def _descend(self, found: Branch, rewards: Tensor) -> Metrics:
        """A gradient step on branches and their rewards (n, h), which are scaled so that returns are of order one."""
        settings = self._settings
        end = self.policy.worth(found.observations[:, -1]) if settings.value else None
        worth = returns(rewards, found.going, end, settings.discount)
        loss, alone = -worth[:, 0].mean(), returns(rewards.detach(), found.going, None, settings.discount)
        unscaled = alone[:, 0].mean() / math.sqrt(1 - settings.discount**2)
        measured = {"imagined_return": unscaled, "branch": found.going[:, :-1].sum(1).mean()}
        if settings.value:
            off = self.policy.worth(found.observations[:, :-1].detach(), learns=True) - worth.detach()
            measured["value_loss"] = (off.square() * found.going[:, :-1]).mean() / 2
            loss = loss + measured["value_loss"]
        measured = {name: x.detach() for name, x in measured.items()}
        return descend(self.policy.parameters(), self._optimizer, [(loss, measured)], settings.max_grad_norm)


__all__ = ["Backprop", "BackpropSettings"]
