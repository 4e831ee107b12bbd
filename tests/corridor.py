"""A tiny world with chance and with moves that are not legal: a corridor whose ends cannot be walked through."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from prefrl.envs.control import GymnasiumTask
from prefrl.envs.fast.vectorised import Vectorised
from prefrl.types import Bools, Floats

LEFT, STAY, RIGHT = np.eye(3, dtype=np.float32)


@dataclass(frozen=True)
class Corridor:
    """Places 0 ... `length` - 1; the gold is the place. A move slips, and does nothing, with probability `slip`."""

    length: int = 4
    slip: float = 0.25

    def start(self, count: int, rng: np.random.Generator) -> Floats:
        return rng.integers(self.length, size=(count, 1)).astype(np.float64)

    def advance(self, states: Floats, actions: Floats, rng: np.random.Generator) -> tuple[Floats, Floats, Bools]:
        moves = (actions.argmax(1) - 1) * (rng.random(len(states)) >= self.slip)
        following = states + moves[:, None]
        return following, following[:, 0].copy(), np.zeros(len(states), bool)

    def observe(self, states: Floats) -> Floats:
        return states.astype(np.float32)

    def legal(self, states: Floats) -> Bools | None:
        place = states[:, 0]
        return np.stack([place > 0, np.ones(len(place), bool), place < self.length - 1], 1)

    def picture(self, state: Floats, size: int) -> np.ndarray | None:
        return None


def corridor(slip: float = 0.25) -> GymnasiumTask:
    return GymnasiumTask(
        name="Corridor",
        horizon=12,
        segment_steps=4,
        observation_size=1,
        action_size=3,
        action_bounds=None,
        fps=1.0,
        frame_size=16,
        make=lambda n: Vectorised(Corridor(slip=slip), n, 12),
    )
