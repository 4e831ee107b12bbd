"""A tiny control task, and stand-ins for reward models, that tests of learners share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from prefrl.envs.control import GymnasiumTask
from prefrl.envs.fast.vectorised import Vectorised
from prefrl.protocols import Environments, Transition
from prefrl.types import Bools, Floats, Segment, State


@dataclass(frozen=True)
class Point:
    """A point on a line, pushed left and right: stay at 0. Discrete: pushed by -1 or +1."""

    def start(self, count: int, rng: np.random.Generator) -> Floats:
        return rng.uniform(-1.0, 1.0, (count, 1))

    def advance(self, states: Floats, actions: Floats, rng: np.random.Generator) -> tuple[Floats, Floats, Bools]:
        push = actions[:, 0] if actions.shape[1] == 1 else actions @ np.array([-1.0, 1.0])
        moved = np.clip(states[:, 0] + 0.2 * push, -2.0, 2.0)
        return moved[:, None], -np.abs(moved), np.zeros(len(states), bool)

    def observe(self, states: Floats) -> Floats:
        return states.astype(np.float32)

    def legal(self, states: Floats) -> Bools | None:
        return None

    def picture(self, state: Floats, size: int) -> np.ndarray | None:
        return None


@dataclass
class Watched:
    """Environments that count every step, and may hide the gold."""

    inner: Environments
    count: int
    spent: list[int]
    hide: bool

    def reset(self, rng: np.random.Generator) -> Floats:
        return self.inner.reset(rng)

    def states(self) -> Floats | None:
        return self.inner.states()

    def legal(self) -> Bools | None:
        return self.inner.legal()

    def step(self, actions: Floats) -> Transition:
        self.spent.append(self.count)
        step = self.inner.step(actions)
        return step._replace(rewards=np.full_like(step.rewards, np.nan)) if self.hide else step


@dataclass(frozen=True)
class Known:
    """A reward model that was told the reward: a function of observations and actions."""

    function: Callable[[Any, Any], Any] = field(default=lambda o, a: 1.0 - 2.0 * abs(o[..., 0]))
    members: int = 1
    fitted: bool = True
    memory: int = 1
    traceable: bool = True

    def traced(self, observations: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """Of functions that take tensors, as the default does."""
        rewards: torch.Tensor = self.function(observations, actions)
        return rewards

    def rewards(self, observations: Floats, actions: Floats, begins: np.ndarray | None = None) -> Floats:
        rewards: Floats = self.function(observations, actions).astype(np.float32)
        return rewards

    def stack(self, candidates: Sequence[Segment]) -> Mapping[str, torch.Tensor]:
        raise NotImplementedError

    def scores(self, stacked: Mapping[str, torch.Tensor]) -> torch.Tensor:
        raise NotImplementedError

    def parameters(self) -> Iterable[torch.nn.Parameter]:
        return []

    def to(self, device: torch.device) -> None: ...

    def settle(self, stacked: Mapping[str, torch.Tensor], loss: object) -> torch.Tensor:
        raise NotImplementedError

    def calibrate(self, temperature: float) -> None: ...

    def raw_member_scores(self, candidates: Sequence[Segment]) -> Floats:
        return self.member_scores(candidates)

    def member_scores(self, candidates: Sequence[Segment]) -> Floats:
        return np.stack([[self.rewards(c.observations, c.actions).sum() for c in candidates]])

    def score(self, candidates: Sequence[Segment]) -> Floats:
        scores: Floats = self.member_scores(candidates)[0]
        return scores

    def features(self, candidates: Sequence[Segment]) -> Floats:
        raise NotImplementedError

    def state(self) -> State:
        return {}

    def load(self, state: State) -> None: ...


def _ages(observations: Floats, actions: Floats, begins: np.ndarray | None) -> Floats:
    """For each step, how many steps of its episode can be seen, itself counted."""
    seen: Floats = np.zeros(observations.shape[:2])
    for t in range(observations.shape[1]):
        before = seen[:, t - 1] if t else 0
        seen[:, t] = 1 + (before if begins is None else np.where(begins[:, t], 0, before))
    return seen


class Ageing:
    """A reward model that looks back over `memory` steps, and pays for how many it sees."""

    fitted, members, memory = True, 1, 4

    def rewards(self, observations: Floats, actions: Floats, begins: np.ndarray | None = None) -> Floats:
        return np.minimum(_ages(observations, actions, begins), self.memory).astype(np.float32)


def point(discrete: bool = False, spent: list[int] | None = None, hide_gold: bool = False) -> GymnasiumTask:
    """The task; `spent` grows by the number of environments with each step."""
    kept: list[int] = [] if spent is None else spent
    return GymnasiumTask(
        name="Point",
        horizon=20,
        segment_steps=5,
        observation_size=1,
        action_size=2 if discrete else 1,
        action_bounds=None if discrete else (np.array([-1.0], np.float32), np.array([1.0], np.float32)),
        fps=5.0,
        frame_size=64,
        make=lambda n: Watched(Vectorised(Point(), n, 20), n, kept, hide_gold),
    )
