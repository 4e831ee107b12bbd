"""Worlds with few states, each known by its number: what is learned there can be held against what is exact."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from pydantic import Field

from prefrl.components import ConfigError, Settings
from prefrl.envs import exact
from prefrl.envs.exact import MDP
from prefrl.envs.toys import INK, MARK, ToyTask
from prefrl.types import Bools, Floats

MOVES = ((-1, 0), (0, 1), (1, 0), (0, -1))
"""Actions: up, right, down, left, as rows and columns."""
WALL, OPEN, START, GOAL, PIT = "#", ".", "S", "G", "x"
WORTH = {GOAL: 1.0, PIT: -1.0}
"""The reward of a step from such a cell; from all others it is 0."""
ROWS = (
    "SSSSxS",
    "S##SSS",
    "SxS#SS",
    "SSSxSG",
)
PAPER, STONE, HOLE = (246, 246, 246), (60, 60, 60), (196, 66, 76)


@dataclass(frozen=True, eq=False)
class Tabular:
    """A `Dynamics` of an MDP. A state is a row of one number, its place in the tables, and is seen one-hot."""

    mdp: MDP
    grid: Grid | None = None
    """Where states lie, for those who draw them."""

    def start(self, count: int, rng: np.random.Generator) -> Floats:
        return rng.choice(len(self.mdp.start), size=(count, 1), p=self.mdp.start).astype(np.float64)

    def advance(self, states: Floats, actions: Floats, rng: np.random.Generator) -> tuple[Floats, Floats, Bools]:
        here, chosen = states[:, 0].astype(int), actions.argmax(1)
        below = self.mdp.transitions[here, chosen].cumsum(1)  # (n, S)
        # Times the last sum: where it rounds to less than 1 no draw may lead out of the tables.
        after = (rng.random((len(here), 1)) * below[:, -1:] >= below).sum(1)
        return after[:, None].astype(np.float64), self.mdp.rewards[here, chosen], np.zeros(len(here), bool)

    def observe(self, states: Floats) -> Floats:
        found: Floats = np.eye(len(self.mdp.start), dtype=np.float32)[states[:, 0].astype(int)]
        return found

    def legal(self, states: Floats) -> Bools | None:
        return None

    def picture(self, state: Floats, size: int) -> np.ndarray:
        """Raises `ValueError` where states have no places."""
        if self.grid is None:
            raise ValueError("the states of these tables have no places, and so cannot be drawn: give them a grid")
        return self.grid.picture(int(state[0]), size)


@dataclass(frozen=True)
class Grid:
    """Cells that a walker goes over; from a goal it begins anew. Raises `ValueError` for rows that are no grid."""

    rows: tuple[str, ...]
    slip: float = 0.1
    """How probable it is that a step goes to the side, to each half as often."""

    def __post_init__(self) -> None:
        text = "".join(self.rows)
        if not self.rows or len({len(row) for row in self.rows}) != 1 or not self.rows[0]:
            raise ValueError(f"expected rows of one length, got lengths {[len(row) for row in self.rows]}")
        if unknown := set(text) - {WALL, OPEN, START, GOAL, PIT}:
            raise ValueError(
                f"unknown cells {sorted(unknown)}: expected {WALL} (wall), {OPEN} (free), S, G and x (pit)"
            )
        if START not in text or GOAL not in text:
            raise ValueError("expected a cell S, where walkers start, and a cell G, where they should go")

    @cached_property
    def cells(self) -> dict[tuple[int, int], int]:
        """(row, column) -> number of the state."""
        found = [(i, j) for i, row in enumerate(self.rows) for j, cell in enumerate(row) if cell != WALL]
        return {place: number for number, place in enumerate(found)}

    def mdp(self, discount: float = 0.95) -> MDP:
        """The tables of this grid. The reward hangs on the cell that a step leaves, whatever the action."""
        kinds = [self.rows[i][j] for i, j in self.cells]
        start = np.array([kind == START for kind in kinds], float)
        start /= start.sum()
        transitions = np.zeros((len(kinds), len(MOVES), len(kinds)))
        for (place, number), kind in zip(self.cells.items(), kinds, strict=True):
            for action in range(len(MOVES)):
                if kind == GOAL:
                    transitions[number, action] = start
                else:
                    self._step(transitions[number, action], place, action)
        rewards = np.array([[WORTH.get(kind, 0.0)] * len(MOVES) for kind in kinds])
        return MDP(transitions, rewards, start, discount)

    def _step(self, row: Floats, place: tuple[int, int], action: int) -> None:
        for turn, chance in ((0, 1 - self.slip), (1, self.slip / 2), (-1, self.slip / 2)):
            down, right = MOVES[(action + turn) % len(MOVES)]
            after = place[0] + down, place[1] + right
            row[self.cells.get(after, self.cells[place])] += chance  # a wall, or the edge: it stays

    def spread(self, values: Floats) -> Floats:
        """(S,) -> (rows, columns), NaN where there is a wall."""
        found = np.full((len(self.rows), len(self.rows[0])), np.nan)
        for place, number in self.cells.items():
            found[place] = values[number]
        return found

    def picture(self, state: int, size: int) -> np.ndarray:
        """(size, size, 3): walls dark, goals orange, pits red, the walker blue."""
        inks = {WALL: STONE, GOAL: MARK, PIT: HOLE}
        colours = np.array([[inks.get(cell, PAPER) for cell in row] for row in self.rows], np.uint8)
        cell = max(1, size // max(colours.shape[:2]))
        drawn = colours.repeat(cell, 0).repeat(cell, 1)[:size, :size]
        picture = np.full((size, size, 3), PAPER, np.uint8)
        picture[: drawn.shape[0], : drawn.shape[1]] = drawn
        middle = (np.array(list(self.cells)[state]) + 0.5) * cell
        down, right = np.mgrid[:size, :size] + 0.5
        picture[np.hypot(down - middle[0], right - middle[1]) < 0.32 * cell] = INK
        return picture


class GridworldSettings(Settings):
    """A walker on a grid that should go to the goal again and again, around pits; all of it is known exactly."""

    kind: Literal["gridworld"] = "gridworld"
    rows: tuple[str, ...] = ROWS
    """The grid from above: # walls, . free cells, S where walkers start, G goals (1 for each visit), x pits (-1)."""
    slip: float = Field(0.1, ge=0, le=1)
    """How probable it is that a step goes to the side."""
    horizon: int = Field(60, ge=2)
    """Steps of an episode."""
    segment_steps: int = Field(5, ge=1)
    """Steps of a judged segment."""
    frame_size: int = Field(120, ge=16, le=2048)
    """Height and width of drawn frames, in pixels."""

    def build(self) -> ToyTask:
        world = self.world()
        size = len(world.mdp.start)
        parts = "gridworld", world, self.horizon, self.segment_steps, self.frame_size
        return ToyTask(*parts, action_size=len(MOVES), fps=4.0, observation_size=size)

    def world(self) -> Tabular:
        try:
            grid = Grid(self.rows, self.slip)
        except ValueError as error:
            raise ConfigError(f"task.rows: {error}") from error
        return Tabular(grid.mdp(), grid)


class Known(NamedTuple):
    """What is exact about a policy in a world, a number for each state."""

    regret: float
    gold: Floats
    visits: Floats
    worth: Floats


def known(mdp: MDP, policy: Floats) -> Known:
    """(S, A) of a policy -> its regret; the gold, how often it is in each state, and what it gets from there."""
    worth = exact.state_values(policy, exact.action_values(mdp, policy))
    visits = exact.occupancy(mdp, policy).sum(1)
    return Known(exact.regret(mdp, policy), mdp.rewards.mean(1), visits, worth)


def table(act: Callable[[Floats], Floats], states: int) -> Floats:
    """(S, A): what a policy does in each state of a `Tabular`, from observations (n, O) -> actions (n, A), one-hot."""
    found: Floats = act(np.eye(states, dtype=np.float32)).astype(np.float64)
    return found


__all__ = ["Grid", "GridworldSettings", "Known", "Tabular", "known", "table"]
