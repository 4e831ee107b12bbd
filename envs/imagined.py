"""Acting inside a learned world: imagined branches that begin in real states, as environments and as a task."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from prefrl.envs.learned import World
from prefrl.protocols import ControlTask, Environments, Transition
from prefrl.types import Bools, Floats, Segment


@dataclass
class Dream:
    """A learned world, and where one may begin in it."""

    world: World
    starts: Floats = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    """(N, O) float32: real observations."""
    lengths: list[int] = field(default_factory=list)
    """Of the branches that ended, in steps; for whoever wants to know, and clears them."""


class Branches:
    """n imagined branches side by side; implements `prefrl.protocols.Environments`.

    Each begins in a real state and follows one member of the ensemble. It is cut, as if time were up, after the world's
    `reach`, or where what the members disagree about has added up to its tolerance. There is no gold: it is NaN.
    """

    def __init__(self, dream: Dream, count: int, whole: int | None = None) -> None:
        """`whole`: nothing is cut before so many steps, and branch i begins in start i."""
        self._dream, self._count, self._whole = dream, count, whole
        self._rng = np.random.default_rng(0)
        self._observations: Floats = np.zeros((count, 0), np.float32)
        self._members = np.zeros(count, np.int64)
        self._parted, self._elapsed = np.zeros(count), np.zeros(count, np.int64)

    def reset(self, rng: np.random.Generator) -> Floats:
        self._rng = rng
        self._observations = self._starts(self._count)
        self._members = rng.integers(self._dream.world.members, size=self._count)
        self._parted[:], self._elapsed[:] = 0.0, 0
        return self._observations

    def step(self, actions: Floats) -> Transition:
        found = self._dream.world.imagine(self._observations, actions.astype(np.float32), self._members)
        self._parted += found.parted
        self._elapsed += 1
        truncated = self._over() & ~found.terminated
        ended = found.terminated | truncated
        observations = found.observations
        if ended.any():
            observations = self._begun(found.observations, ended)
        self._observations = observations
        gold = np.full(self._count, np.nan)
        return Transition(observations, gold, found.terminated, truncated, found.observations)

    def states(self) -> Floats | None:
        return None

    def legal(self) -> Bools | None:
        return None

    def _over(self) -> Bools:
        if self._whole is not None:
            over: Bools = self._elapsed >= self._whole
            return over
        world = self._dream.world
        cut: Bools = (self._elapsed >= world.reach) | (self._parted >= world.settings.tolerance)
        return cut

    def _begun(self, observations: Floats, ended: Bools) -> Floats:
        """The same, with new branches in place of those that have ended."""
        count = int(ended.sum())
        self._dream.lengths += self._elapsed[ended].tolist()
        found = observations.copy()
        found[ended] = self._starts(count) if self._whole is None else observations[ended]
        self._members[ended] = self._rng.integers(self._dream.world.members, size=count)
        self._parted[ended], self._elapsed[ended] = 0.0, 0
        return found

    def _starts(self, count: int) -> Floats:
        starts = self._dream.starts
        at = np.arange(count) if self._whole is not None else self._rng.integers(len(starts), size=count)
        found: Floats = starts[at]
        return found


@dataclass(frozen=True, eq=False)
class DreamtTask:
    """A `prefrl.protocols.ControlTask` as it is, but for its environments, which are branches of a dream."""

    real: ControlTask
    dream: Dream

    @property
    def name(self) -> str:
        return self.real.name

    @property
    def kind(self) -> str:
        return self.real.kind

    @property
    def horizon(self) -> int:
        return self.real.horizon

    @property
    def segment_steps(self) -> int:
        return self.real.segment_steps

    @property
    def observation_size(self) -> int:
        return self.real.observation_size

    @property
    def action_size(self) -> int:
        return self.real.action_size

    @property
    def action_bounds(self) -> tuple[Floats, Floats] | None:
        return self.real.action_bounds

    @property
    def fps(self) -> float:
        return self.real.fps

    def environments(self, count: int) -> Environments:
        return Branches(self.dream, count)

    def frames(self, segment: Segment) -> np.ndarray:
        return self.real.frames(segment)


__all__ = ["Branches", "Dream", "DreamtTask"]
