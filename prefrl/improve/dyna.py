"""Dyna: our own policy gradients inside a learned world, beside the learned reward, with real episodes between.

Variant: Sutton 1991, with the world of MBPO (Janner et al. 2019): branches begin in real states, are short where the
world cannot be trusted, and are learned from. What differs: the learner inside is `learner.kind=control` (PPO), where
MBPO has SAC; it learns from imagined steps alone, and rewards are the newest fit's, so nothing has to be relabelled.
Queries are about real episodes, and the world learns from those too: a round plays some once, before it asks. With
`select.imagined` they are about imagined ones, and a round plays before it learns.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from prefrl.components import Settings
from prefrl.envs.imagined import Dream, DreamtTask
from prefrl.envs.learned import WorldSettings
from prefrl.improve.control import ControlLearnerSettings
from prefrl.improve.grounded import Grounded
from prefrl.improve.player import Player
from prefrl.policies.acting import Actor, played
from prefrl.protocols import ControlTask, RewardModel, Store, Task, simulated
from prefrl.seeding import Device, device_of
from prefrl.types import Evaluation, Metrics, Segment, State, Steps

OUTSIDE = ("evaluation_episodes", "device", "threads")
"""Settings of the learner inside that are said outside of it."""


class DynaSettings(Settings):
    """Our own policy gradients inside a learned world, with real episodes between: few real steps."""

    kind: Literal["dyna"] = "dyna"
    inside: ControlLearnerSettings = ControlLearnerSettings(environments=64, steps_per_round=64_000, rollout_steps=100)
    """The learner: its environments and steps are imagined ones. It keeps no best policy (`rollback`): the evaluations
    that it would need are of the real world."""
    world: WorldSettings = WorldSettings()
    """The ensemble of dynamics."""
    episodes: int = Field(2, ge=1)
    """Real episodes of a round after the first, which are asked about and learned from. In the first one the starting
    policy plays as many as its queries need."""

    evaluation_episodes: int = Field(20, ge=1)
    """Real episodes of an evaluation, with the policy's mode, in environments of their own."""
    device: Device = "auto"
    """Where the policy, the world and the reward model compute: `auto` is the GPU where there is one."""
    threads: int | None = Field(1, ge=1)
    """With how many threads torch and BLAS compute; null leaves it to them."""

    @property
    def discount(self) -> float:
        return self.inside.discount

    @model_validator(mode="after")
    def _said_once(self) -> DynaSettings:
        usual = ControlLearnerSettings()
        for name in OUTSIDE:
            if getattr(self.inside, name) != getattr(usual, name):
                raise ValueError(f"inside.{name}: write it as learner.{name}; the learner inside plays nothing real")
        if self.inside.rollback not in (usual.rollback, None):
            raise ValueError(
                "inside.rollback: the learner inside keeps no best policy, since its evaluations would be of the real "
                "world; leave it out"
            )
        if self.inside.clone.on:
            raise ValueError(
                "inside.clone: demonstrations are cloned by learner.kind=control; give its run as learner.inside.start"
            )
        return self

    def shrunk(self) -> DynaSettings:
        inside = self.inside.shrunk().model_copy(update={"evaluation_episodes": self.inside.evaluation_episodes})
        small = {"inside": inside, "world": self.world.shrunk(), "episodes": 1, "evaluation_episodes": 1}
        return self.model_copy(update=small)

    def with_evaluation_of(self, other: DynaSettings) -> DynaSettings:
        return self.model_copy(update={"evaluation_episodes": other.evaluation_episodes})

    def work(self) -> float:
        return self.inside.work()

    def real_work(self) -> float:
        return float(self.episodes)

    def build(self, task: Task, rng: np.random.Generator) -> Dyna:
        """Raises `ConfigError` for a task that is not of control, and where not all actions are always legal."""
        return Dyna(self, simulated(task, f"learner kind {self.kind!r} plays real episodes of control"), rng)

    def formula(self) -> str:
        world = self.world
        lines = [
            f"world: {world.members} networks f, minimise mean[ ((s' - s - f(s,a)) / std)^2 ] over all real steps",
            f"branches from real states, cut where members' disagreement adds up to {world.tolerance:g} std, after at "
            f"most {world.longest} steps; inside them:",
        ]
        return "\n".join([*lines, self.inside.formula()])


class Dyna:
    """A `prefrl.protocols.Learner` of segments: real steps teach the world, imagined ones the policy."""

    def __init__(self, settings: DynaSettings, task: ControlTask, rng: np.random.Generator) -> None:
        self._settings, self._task = settings, task
        self.ground = Grounded(settings.world, task, device_of(settings.device), rng)
        self._dream = Dream(self.ground.world)
        inside = settings.inside.model_copy(update={"device": settings.device})
        self._inside = inside.build(DreamtTask(task, self._dream), rng)
        self._player = Player(task, settings.inside.environments)

    @property
    def steps(self) -> Steps:
        return self._player.steps.add(learn=self.ground.spent, imagined=self._inside.steps.learn + self.ground.dreamt)

    def sample(self, count: int, rng: np.random.Generator) -> list[Segment]:
        """Segments of real episodes of the policy as it is; the world learns from these as well.

        Where they hold fewer segments than that, the others are of the episodes before. Raises ValueError where there
        are none of that either.
        """
        if not self.ground.begun:
            self.ground.begin(count, played(self.actor(), rng), self._settings.inside.environments, rng)
        elif not self.ground.fresh:
            self._play(rng)
        return self.ground.segments(count, rng)

    def imagine(self, count: int, rng: np.random.Generator) -> list[Segment]:
        """Segments of imagined branches of the policy as it is."""
        return self.ground.imagine(count, self._settings.episodes, played(self.actor(), rng), rng)

    def improve(self, reward: RewardModel[Segment], store: Store[Segment], rng: np.random.Generator) -> Metrics:
        """Fit the world on all real steps, then let the policy learn in it.

        Metrics: those of the world's fit (`World.fit`), of the learner inside, and branch, the mean length of imagined
        branches in steps. Where nothing can be imagined the policy stays as it is, and a note says so.
        """
        if not self.ground.fresh:
            self._play(rng)
        found = self.ground.learn(rng)
        if not self.ground.world.reach or self.ground.data is None:
            return found | {"branch": 0.0}
        self._dream.starts = self.ground.data.starts
        self._dream.lengths.clear()
        inside = self._inside.improve(reward, store, rng)
        return inside | found | {"branch": float(np.mean(self._dream.lengths or [self.ground.world.reach]))}

    def evaluate(self, reward: RewardModel[Segment], rng: np.random.Generator) -> Evaluation[Segment]:
        """The policy's mode in real episodes; and `imagined`, what the same policy gets of the learned reward in the
        world, from the same first states, for as many steps: beside `learned`, which is the real one."""
        found = self._player.evaluate(self._settings.evaluation_episodes, played(self.actor(), None), reward, rng)
        metrics = dict(found.metrics)
        if self.ground.world.fitted and reward.fitted:
            starts = np.stack([one.observations[0] for one in found.candidates])
            worth = self.ground.imagined_returns(starts, played(self.actor(), None), reward, rng)
            metrics["imagined"] = float(worth.mean())
        return replace(found, metrics=metrics, notes=(*found.notes, *self.ground.notes))

    def pace(self, begin: float, end: float) -> None:
        self._inside.pace(begin, end)

    def actor(self) -> Actor:
        return self._inside.actor()

    def save(self, path: Path) -> None:
        """As a zip of stable-baselines3's PPO. Raises ConfigError for kinds of policies that it has not."""
        self._inside.save(path)

    def state(self) -> State:
        return {"ground": self.ground.state(), "inside": self._inside.state(), "player": self._player.state()}

    def load(self, state: State) -> None:
        self.ground.load(state["ground"])
        self._inside.load(state["inside"])
        self._player.load(state["player"])

    def _play(self, rng: np.random.Generator) -> None:
        self.ground.play(self._settings.episodes, played(self.actor(), rng), rng)


__all__ = ["Dyna", "DynaSettings"]
