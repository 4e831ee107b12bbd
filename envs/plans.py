"""Floorplans as a world: macros are placed one after another on a grid, and every step is vectorised over plans."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from prefrl.envs.chips import Chip, Places
from prefrl.envs.plan_pictures import drawn
from prefrl.types import Bools, Floats, Integers

AGE, WIRE, CONGESTION, ADDED_WIRE, ADDED_CONGESTION = range(5)
CELLS = 5
"""A state is its age, the two totals, what the last step added to each, and from here on the cell of each macro's lower
left corner, or -1."""
MAPS = ("wire", "x", "y", "x squared", "y squared", "x y", "edges")


@dataclass(frozen=True)
class Units:
    """What a random plan has, on average."""

    wire: float = 1.0
    congestion: float = 1.0


@dataclass(frozen=True, eq=False)
class Floorplan:
    """A `Dynamics`: one macro a step, from the largest to the smallest, and a last step in which the plan is whole.

    Actions are cells: of a macro's lower left corner. Only where it fits, and in the last step the first one alone, is
    legal. Where a macro fits nowhere it is left out, by the first action, and counts as much as a random plan has.
    """

    chip: Chip
    units: Units = Units()
    weights: tuple[float, float] = (1.0, 0.5)
    """Of wire length and congestion in the gold, which is minus what a step adds to them."""

    @property
    def _sizes(self) -> Floats:
        return self.chip.netlist.sizes

    @property
    def horizon(self) -> int:
        return self.chip.macros + 1

    @property
    def actions(self) -> int:
        return self.chip.grid**2

    @property
    def observation_size(self) -> int:
        return 4 + self.horizon + 3 * self.chip.macros

    def start(self, count: int, rng: np.random.Generator) -> Floats:
        states = np.full((count, CELLS + self.chip.macros), -1.0)
        states[:, :CELLS] = 0.0
        boxes = self.chip.boxes(states[:1, CELLS:].astype(np.int64))
        states[:, [WIRE, CONGESTION]] = [self._totals(boxes)[:, 0]]
        return states

    def advance(self, states: Floats, actions: Floats, rng: np.random.Generator) -> tuple[Floats, Floats, Bools]:
        following = states.copy()
        ages, chosen = states[:, AGE].astype(np.int64), actions.argmax(1)
        placed = ages < self.chip.macros
        rows = np.flatnonzero(placed)
        fits = np.zeros(len(states), bool)
        fits[rows] = self._fits(states)[rows]
        following[rows[fits[rows]], CELLS + ages[rows[fits[rows]]]] = chosen[rows[fits[rows]]]
        totals = self._totals(self.chip.boxes(following[:, CELLS:].astype(np.int64)))
        lost = placed & ~fits
        following[:, [ADDED_WIRE, ADDED_CONGESTION]] = totals.T - states[:, [WIRE, CONGESTION]] + lost[:, None]
        following[:, [WIRE, CONGESTION]] = totals.T
        following[:, AGE] += 1
        gold = -following[:, [ADDED_WIRE, ADDED_CONGESTION]] @ np.array(self.weights)
        # An end, not a time limit: nothing is placed after it.
        return following, gold, following[:, AGE] >= self.horizon

    def observe(self, states: Floats) -> Floats:
        """(n, O): what the last step added, the totals, the next macro one-hot, and of each macro whether it lies
        somewhere, and where its middle is, from -1 to 1."""
        cells = states[:, CELLS:].astype(np.int64)
        ages = states[:, AGE].astype(np.int64)
        there = cells >= 0
        middles = np.where(there[..., None], self.chip.middles(cells) / self.chip.extent * 2 - 1, 0.0)
        numbers = states[:, [ADDED_WIRE, ADDED_CONGESTION, WIRE, CONGESTION]]
        turn = np.eye(self.horizon + 1)[ages][:, : self.horizon]
        parts = numbers, turn, there, middles.reshape(len(states), -1)
        found: Floats = np.concatenate(parts, 1).astype(np.float32)
        return found

    def seen(self, observations: Floats) -> Floats:
        """(n, O) -> (n, S): the states that are seen like this."""
        macros = self.chip.macros
        numbers, turn, there, middles = np.split(
            observations.astype(np.float64), np.cumsum([4, self.horizon, macros]), 1
        )
        at = (middles.reshape(-1, macros, 2) + 1) / 2 * self.chip.extent - self._sizes / 2
        corner = np.rint(at / self.chip.cell)
        cells = np.where(there > 0.5, corner[..., 1] * self.chip.grid + corner[..., 0], -1.0)
        ages = np.where(turn.any(1), turn.argmax(1), self.horizon)
        return np.concatenate([ages[:, None], numbers[:, [2, 3, 0, 1]], cells], 1)

    def legal(self, states: Floats) -> Bools:
        found = np.zeros((len(states), self.actions), bool)
        for macro, rows, cells in self._turns(states):
            found[rows] = self.chip.free(macro, cells).reshape(len(rows), -1)
        found[~found.any(1), 0] = True
        return found

    def maps(self, states: Floats) -> Floats:
        """(n, A, F) float32 of `MAPS`: what a macro at each cell would add to the wire, more than at the best
        legal one; where the macro's middle would be, from -1 to 1; and how many of its sides lie at the chip's edge."""
        grid = self.chip.grid
        found = np.zeros((len(states), grid, grid, len(MAPS)), np.float32)
        for macro, rows, cells in self._turns(states):
            # In units of what a macro of a random plan adds.
            added = self.chip.added(macro, self.chip.boxes(cells)) * (self.chip.macros / self.units.wire)
            free = self.chip.free(macro, cells)
            least = np.where(free, added, np.inf).min((1, 2), keepdims=True)
            found[rows, ..., 0] = added - np.where(np.isfinite(least), least, 0.0)
            found[rows, ..., 1:] = self._shape(macro)
        return found.reshape(len(states), self.actions, len(MAPS))

    def _shape(self, macro: int) -> Floats:
        """(G, G, F - 1): the maps that are the same in every plan."""
        at = np.arange(self.chip.grid)
        middle = (at[:, None] * self.chip.cell + self._sizes[macro] / 2) / self.chip.extent * 2 - 1
        y, x = np.meshgrid(middle[:, 1], middle[:, 0], indexing="ij")
        last = self.chip.grid - self.chip.spans[macro]
        side = 1.0 * (at[:, None] == 0) + (at[:, None] == last)  # (G, 2)
        return np.stack([x, y, x * x, y * y, x * y, side[:, 1, None] + side[None, :, 0]], -1)

    def _turns(self, states: Floats) -> Iterator[tuple[int, Integers, Integers]]:
        """The macros that are to be placed now: each with its rows, and the cells (k, M) there."""
        ages = states[:, AGE].astype(np.int64)
        for macro in np.unique(ages[ages < self.chip.macros]).tolist():
            rows = np.flatnonzero(ages == macro)
            yield macro, rows, states[rows, CELLS:].astype(np.int64)

    def _fits(self, states: Floats) -> Bools:
        """(n,) whether the macro that comes next fits anywhere."""
        found = np.zeros(len(states), bool)
        for macro, rows, cells in self._turns(states):
            found[rows] = self.chip.free(macro, cells).any((1, 2))
        return found

    def _totals(self, boxes: Places) -> Floats:
        """(2, n) wire length and congestion, in units of a random plan's."""
        return np.stack([self.chip.wire(boxes) / self.units.wire, self.chip.congestion(boxes) / self.units.congestion])

    def picture(self, state: Floats, size: int) -> np.ndarray:
        """Of what lies there; the macro that was placed last stands out until the plan is whole."""
        age = int(state[AGE])
        newest = age - 1 if age < self.chip.macros else -1
        return drawn(self.chip, state[CELLS:].astype(np.int64), newest, self.units.congestion, size)


def random_plans(world: Floorplan, count: int, rng: np.random.Generator) -> Floats:
    """(n, S): whole plans, each step drawn evenly from what is legal."""
    states = world.start(count, rng)
    for _ in range(world.chip.macros):
        chosen = (rng.random((count, world.actions)) * world.legal(states)).argmax(1)
        states, _, _ = world.advance(states, np.eye(world.actions, dtype=np.float32)[chosen], rng)
    return states


def greedy_plans(world: Floorplan, count: int, rng: np.random.Generator) -> Floats:
    """(n, S): whole plans, each macro where it adds least to the wire length, ties broken by chance."""
    states = world.start(count, rng)
    for _ in range(world.chip.macros):
        added = world.maps(states)[..., 0].astype(np.float64)
        least = np.where(world.legal(states), added, np.inf) - 1e-6 * rng.random(added.shape)
        states, _, _ = world.advance(states, np.eye(world.actions, dtype=np.float32)[least.argmin(1)], rng)
    return states


__all__ = ["MAPS", "Floorplan", "Units", "greedy_plans", "random_plans"]
