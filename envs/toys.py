"""Small tasks that are learned in seconds, for tests and for a first look."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from pydantic import Field

from prefrl.components import ConfigError, Settings
from prefrl.envs.fast.retold import Retell, retelling
from prefrl.envs.fast.vectorised import Vectorised
from prefrl.protocols import Dynamics, Environments
from prefrl.types import Bools, Floats, Segment

REACH = 1.5
"""How far from the middle the picture shows."""
TURNS = ("on", "left", "right")
DISC, GOAL, GOAL_SIZE = 0.6, np.array([0.0, 1.0]), 0.15
"""Of the fork: the radius of what stands in the middle, and where to go."""
INK, MARK, GREY = (34, 87, 150), (214, 116, 30), (150, 150, 150)


class Drawn(Dynamics, Protocol):
    """A world of which each state can be drawn."""

    def picture(self, state: Floats, size: int) -> np.ndarray: ...


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

    def recognise(self, observations: Floats) -> Floats:
        return observations.astype(np.float64)

    def legal(self, states: Floats) -> Bools | None:
        return None

    def picture(self, state: Floats, size: int) -> np.ndarray:
        """The point in blue, the middle in orange."""
        return _dots(size, (np.zeros(2), 0.08, MARK), (state, 0.13, INK))


@dataclass(frozen=True)
class TMaze:
    """A corridor that ends in two arms, and a sign at its start that says which one is right; then it is out of sight.

    Variant: the passive T-maze of Ni et al. 2023 (section 5.1) after Bakker 2001: whoever goes straight on is at the
    junction for the last of `length` steps. The gold is 1 for the right arm, and minus 1 / `length` for each step that
    does not lead on. So who remembers gets 1, and who does not can get 0.5 on average.

    A state is (place, side of the right arm, arm that was taken, age); actions are `TURNS`.
    """

    length: int

    def start(self, count: int, rng: np.random.Generator) -> Floats:
        states = np.zeros((count, 4))
        states[:, 1] = rng.choice([-1.0, 1.0], count)
        return states

    def advance(self, states: Floats, actions: Floats, rng: np.random.Generator) -> tuple[Floats, Floats, Bools]:
        place, side, arm, age = states.T
        move = actions.argmax(1)
        junction, on = place >= self.length - 1, move == 0
        turns = junction & (arm == 0) & ~on
        taken = np.where(turns, np.where(move == 1, -1.0, 1.0), arm)
        following = np.stack([place + (on & ~junction), side, taken, age + 1], 1)
        idle = np.where(junction, on & (arm == 0), ~on)
        # An end, not a time limit: what follows the last step looks like the junction, and a critic would value it so.
        return following, 1.0 * (turns & (taken == side)) - idle / self.length, age + 1 >= self.length

    def observe(self, states: Floats) -> Floats:
        """(n, 2): the sign, -1 or 1, at the first step and 0 later; and whether this is the junction."""
        place, side, _, age = states.T
        return np.stack([np.where(age == 0, side, 0.0), place >= self.length - 1], 1).astype(np.float32)

    def legal(self, states: Floats) -> Bools | None:
        return None

    def picture(self, state: Floats, size: int) -> np.ndarray:
        """From above: the corridor from left to right, the right arm in orange, the walker in blue."""
        picture = np.full((size, size, 3), 60, np.uint8)
        cell = max(1, size // (self.length + 1))
        middle, last = size // 2, (self.length - 1) * cell
        picture[middle : middle + cell, : last + cell] = 246
        picture[middle - 2 * cell : middle + 3 * cell, last : last + cell] = 246
        place, side, arm, _ = state
        for row, column, ink in ((2 * side, last, MARK), (2 * arm, int(place) * cell, INK)):
            top = middle + int(row) * cell
            picture[top : top + cell, column : column + cell] = ink
        return picture


@dataclass(frozen=True)
class Fork:
    """A point that has to pass a disc in the middle, on its left or on its right, to a goal beyond it.

    It moves by up to 0.1 along each axis, and stays where it hits the disc or reaches the goal. The gold is 1 in the
    step that reaches the goal, by the `side` that is wanted, and 0 else: that of an episode says whether it got there.
    It starts so near the disc that who cannot tell the side at once, as the mean of both ways cannot, often hits it.

    A state is (x, y, 1 where it got there or -1 where it hit, side on which it was abreast of the disc).
    """

    side: Literal["either", "left", "right"] = "either"

    def start(self, count: int, rng: np.random.Generator) -> Floats:
        states = np.zeros((count, 4))
        states[:, 0], states[:, 1] = rng.uniform(-0.05, 0.05, count), -0.8
        return states

    def advance(self, states: Floats, actions: Floats, rng: np.random.Generator) -> tuple[Floats, Floats, Bools]:
        moves = (states[:, 2] == 0)[:, None]
        at = np.where(moves, np.clip(states[:, :2] + 0.1 * np.clip(actions, -1.0, 1.0), -REACH, REACH), states[:, :2])
        passed = np.where((states[:, 1] < 0) & (at[:, 1] >= 0), np.sign(at[:, 0]), states[:, 3])
        hit, there = np.linalg.norm(at, axis=1) < DISC, np.linalg.norm(at - GOAL, axis=1) < GOAL_SIZE
        ended = np.where(moves[:, 0], 1.0 * there - hit, states[:, 2])
        wanted = {"either": True, "left": passed < 0, "right": passed > 0}[self.side]
        gold = 1.0 * (moves[:, 0] & there & wanted)
        return np.column_stack([at, ended, passed]), gold, np.zeros(len(states), bool)

    def observe(self, states: Floats) -> Floats:
        """(n, 2): where it is."""
        return states[:, :2].astype(np.float32)

    def legal(self, states: Floats) -> Bools | None:
        return None

    def picture(self, state: Floats, size: int) -> np.ndarray:
        """The disc in grey, the goal in orange, the point in blue."""
        return _dots(size, (np.zeros(2), DISC, GREY), (GOAL, GOAL_SIZE, MARK), (state[:2], 0.08, INK))


class ForkSettings(Settings):
    """A point that has to pass a disc on either side to a goal: whoever averages both ways runs into the disc."""

    kind: Literal["fork"] = "fork"
    side: Literal["either", "left", "right"] = "either"
    """On which side it has to pass for the gold; on either by default."""
    horizon: int = Field(40, ge=2)
    """Steps of an episode; about 25 lead to the goal."""
    segment_steps: int | None = Field(None, ge=1)
    """Steps of a judged segment; whole episodes when left out, since only they show whether it got there."""
    frame_size: int = Field(120, ge=16, le=2048)
    """Height and width of drawn frames, in pixels."""

    def build(self) -> ToyTask:
        bounds = -np.ones(2, np.float32), np.ones(2, np.float32)
        parts = "fork", Fork(self.side), self.horizon, self.segment_steps or self.horizon, self.frame_size
        return ToyTask(*parts, action_size=2, fps=10.0, action_bounds=bounds)


def _dots(size: int, *dots: tuple[Floats, float, tuple[int, int, int]]) -> np.ndarray:
    """A picture of the plane with discs on it: middle, radius and colour of each, the last one on top."""
    axis = np.linspace(-REACH, REACH, size)
    plane = np.stack(np.meshgrid(axis, -axis), -1)
    picture = np.full((size, size, 3), 246, np.uint8)
    for middle, radius, ink in dots:
        picture[np.linalg.norm(plane - middle, axis=-1) < radius] = ink
    return picture


class TMazeSettings(Settings):
    """A corridor with a sign at its start, and at its end two arms, of which the sign said which one is right."""

    kind: Literal["tmaze"] = "tmaze"
    length: int = Field(20, ge=2)
    """Steps of an episode: the last one turns left or right, if those before led straight on."""
    segment_steps: int | None = Field(None, ge=1)
    """Steps of a judged segment; whole episodes when left out, since only they show both the sign and the turn."""
    frame_size: int = Field(120, ge=16, le=2048)
    """Height and width of drawn frames, in pixels."""

    def build(self) -> ToyTask:
        steps = self.segment_steps or self.length
        parts = "tmaze", TMaze(self.length), self.length, steps, self.frame_size
        return ToyTask(*parts, action_size=3, fps=5.0, action_names=TURNS)


class PointSettings(Settings):
    """A point in the plane that should go to the middle, and stay there."""

    kind: Literal["point"] = "point"
    horizon: int = Field(40, ge=2)
    """Steps of an episode."""
    segment_steps: int = Field(5, ge=1)
    """Steps of a judged segment."""
    frame_size: int = Field(120, ge=16, le=2048)
    """Height and width of drawn frames, in pixels."""

    def build(self) -> ToyTask:
        bounds = -np.ones(2, np.float32), np.ones(2, np.float32)
        parts = "point", Point(), self.horizon, self.segment_steps, self.frame_size
        return ToyTask(*parts, action_size=2, fps=10.0, action_bounds=bounds, action_names=("right", "up"))


@dataclass(frozen=True, eq=False)
class ToyTask:
    """A `prefrl.protocols.ControlTask` of a small world that draws itself.

    Raises `ConfigError` for segments that are longer than an episode.
    """

    name: str
    world: Drawn
    horizon: int
    segment_steps: int
    frame_size: int
    action_size: int
    fps: float
    action_bounds: tuple[Floats, Floats] | None = None
    observation_size: int = 2
    action_names: tuple[str, ...] = ()
    kind: str = "control"

    def __post_init__(self) -> None:
        if self.segment_steps > self.horizon:
            raise ConfigError(
                f"task: a segment of {self.segment_steps} steps is longer than an episode of {self.horizon}"
            )

    @property
    def retell(self) -> Retell | None:
        return retelling(self.world)

    def environments(self, count: int) -> Environments:
        return Vectorised(self.world, count, self.horizon)

    def frames(self, segment: Segment) -> np.ndarray:
        """(T, frame_size, frame_size, 3). Raises `ValueError` where the segment keeps no states."""
        if segment.states is None:
            raise ValueError("a segment can only be drawn from its simulator states, and this one has none")
        return np.stack([self.world.picture(state, self.frame_size) for state in segment.states])
