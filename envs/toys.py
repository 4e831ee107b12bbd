"""Small tasks that are learned in seconds, for tests and for a first look."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from prefrl.components import ConfigError, Settings
from prefrl.envs.fast.vectorised import Vectorised
from prefrl.protocols import Environments
from prefrl.types import Bools, Floats, Segment

REACH = 1.5
"""How far from the middle the picture shows."""
INK, MARK = (34, 87, 150), (214, 116, 30)


@dataclass(frozen=True)
class Point:
    """A point in the plane that moves by up to 0.1 along each axis; the gold is minus its distance to the middle."""

    def start(self, count: int, rng: np.random.Generator) -> Floats:
        return rng.uniform(-1.0, 1.0, (count, 2))

    def advance(self, states: Floats, actions: Floats, rng: np.random.Generator) -> tuple[Floats, Floats, Bools]:
        following = np.clip(states + 0.1 * np.clip(actions, -1.0, 1.0), -REACH, REACH)
        return following, -np.linalg.norm(following, axis=1), np.zeros(len(states), bool)

    def observe(self, states: Floats) -> Floats:
        return states.astype(np.float32)

    def legal(self, states: Floats) -> Bools | None:
        return None

    def picture(self, state: Floats, size: int) -> np.ndarray:
        """The point in blue, the middle in orange."""
        axis = np.linspace(-REACH, REACH, size)
        grid = np.stack(np.meshgrid(axis, -axis), -1)
        picture = np.full((size, size, 3), 246, np.uint8)
        picture[np.linalg.norm(grid, axis=-1) < 0.08] = MARK
        picture[np.linalg.norm(grid - state, axis=-1) < 0.13] = INK
        return picture


class PointSettings(Settings):
    """A point in the plane that should go to the middle, and stay there."""

    kind: Literal["point"] = "point"
    horizon: int = Field(40, ge=2)
    """Steps of an episode."""
    segment_steps: int = Field(5, ge=1)
    """Steps of a judged segment."""
    frame_size: int = Field(120, ge=16, le=2048)
    """Height and width of drawn frames, in pixels."""

    def build(self) -> PointTask:
        if self.segment_steps > self.horizon:
            raise ConfigError(
                f"task: a segment of {self.segment_steps} steps is longer than an episode of {self.horizon}"
            )
        return PointTask(self.horizon, self.segment_steps, self.frame_size)


@dataclass(frozen=True)
class PointTask:
    """A `prefrl.protocols.ControlTask`."""

    horizon: int
    segment_steps: int
    frame_size: int
    name: str = "point"
    kind: str = "control"
    observation_size: int = 2
    action_size: int = 2
    fps: float = 10.0

    @property
    def action_bounds(self) -> tuple[Floats, Floats]:
        return -np.ones(2, np.float32), np.ones(2, np.float32)

    def environments(self, count: int) -> Environments:
        return Vectorised(Point(), count, self.horizon)

    def frames(self, segment: Segment) -> np.ndarray:
        """(T, frame_size, frame_size, 3). Raises `ValueError` where the segment keeps no states."""
        if segment.states is None:
            raise ValueError("a segment can only be drawn from its simulator states, and this one has none")
        return np.stack([Point().picture(state, self.frame_size) for state in segment.states])
