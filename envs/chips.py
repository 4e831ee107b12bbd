"""A chip with a grid on it: where macros fit, and what a plan's wires come to, of many plans at once.

A plan's wire length is the half perimeter of each net's bounding box, added up (HPWL). Its congestion is RUDY's
(Spindler and Johannes 2007): a net's wire is spread evenly over its box, and the mean of the fullest tenth of the bins
counts, as in Mirhoseini et al. 2021. What a macro adds to the wire length at every place is the wire mask of MaskPlace
(Lai et al. 2022), and where it fits is its position mask.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from prefrl.envs.bookshelf import BOARD, Netlist
from prefrl.types import Bools, Floats, Integers

FULLEST = 0.1
"""The share of bins whose mean is the congestion."""


class Places(NamedTuple):
    """What the pins of n plans lie at; infinite where a net has none yet."""

    low: Floats
    """(n, 2, N)."""
    high: Floats
    """(n, 2, N)."""


@dataclass(frozen=True, eq=False)
class Chip:
    """A chip with a grid on it, and the macros that are to be placed there, in order.

    Raises `ValueError` for a macro that is larger than the chip.
    """

    netlist: Netlist
    width: float
    height: float
    grid: int
    bins: int = 16
    """Of the congestion, to a side."""

    def __post_init__(self) -> None:
        for name, size in zip(self.netlist.macros, self.netlist.sizes, strict=True):
            if (size > self.extent).any():
                raise ValueError(
                    f"macro {name} is {size[0]:g} x {size[1]:g}, and the chip {self.width:g} x {self.height:g}: make "
                    "the chip larger, or leave that macro out"
                )

    @property
    def macros(self) -> int:
        return len(self.netlist.macros)

    @property
    def extent(self) -> Floats:
        return np.array([self.width, self.height])

    @cached_property
    def cell(self) -> Floats:
        """(2,) width and height of a cell."""
        found: Floats = self.extent / self.grid
        return found

    @cached_property
    def spans(self) -> Integers:
        """(M, 2) how many cells each macro takes, columns and rows; a part of one is all of it."""
        found: Integers = np.ceil(self.netlist.sizes / self.cell - 1e-9).astype(np.int64)
        return found

    @cached_property
    def _pins(self) -> tuple[Integers, Integers, Floats]:
        return self.netlist.pins()

    @cached_property
    def _heads(self) -> Integers:
        """(N,) the first pin of each net."""
        found: Integers = np.flatnonzero(np.diff(self._pins[0], prepend=-1))
        return found

    def corners(self, cells: Integers) -> Integers:
        """(..., M) cells -> (..., M, 2) column and row of each."""
        return np.stack([cells % self.grid, cells // self.grid], -1)

    def middles(self, cells: Integers) -> Floats:
        """(n, M) -> (n, M, 2), in the unit of the netlist."""
        found: Floats = self.corners(cells) * self.cell + self.netlist.sizes / 2
        return found

    def boxes(self, cells: Integers) -> Places:
        """Around the pins of each net that lie somewhere."""
        _, macros, offsets = self._pins
        middles = self.middles(cells)
        there = (macros == BOARD) | (cells[:, macros] >= 0)  # (n, P)
        # Pins last, in a row in memory: it takes a third of the time.
        at = np.where(macros == BOARD, 0.0, middles.transpose(0, 2, 1)[:, :, macros]) + offsets.T  # (n, 2, P)
        low = np.minimum.reduceat(np.where(there[:, None], at, np.inf), self._heads, 2)
        high = np.maximum.reduceat(np.where(there[:, None], at, -np.inf), self._heads, 2)
        return Places(low, high)

    def wire(self, boxes: Places) -> Floats:
        """(n,) half perimeters, added up; a net of which nothing lies anywhere has none."""
        found: Floats = np.maximum(boxes.high - boxes.low, 0.0).sum((1, 2))
        return found

    def demand(self, boxes: Places) -> Floats:
        """(n, bins, bins) rows and columns: how much wire there is for the width of a bin, if it is spread evenly."""
        size = (self.extent / self.bins).astype(np.float32)[:, None]
        lies = np.isfinite(boxes.low[:, 0])
        low, high = (np.where(lies[:, None], side, 0.0).astype(np.float32) for side in boxes)
        length = (high - low).sum(1)  # (n, N)
        # A straight wire has no area: it runs through one bin's width.
        middle, half = (low + high) / 2, np.maximum(high - low, size) / 2
        low, high = middle - half, middle + half
        edges = (np.arange(self.bins, dtype=np.float32) * size)[:, None]  # (2, 1, bins)
        share = np.minimum(high[..., None], edges + size[:, None])
        share -= np.maximum(low[..., None], edges)
        share = np.maximum(share, 0.0, out=share) / size[:, None]
        # (n, N): the wire in a bin that the box covers.
        weight = length / ((high - low) / size).prod(1) / size.mean()
        columns, rows = share[:, 0], share[:, 1]  # (n, N, bins)
        found: Floats = rows.transpose(0, 2, 1) @ (columns * weight[..., None])
        return found

    def congestion(self, boxes: Places) -> Floats:
        """(n,) the mean of the fullest bins."""
        flat = self.demand(boxes).reshape(len(boxes.low), -1)
        most = max(1, round(FULLEST * flat.shape[1]))
        found: Floats = np.partition(flat, -most, 1)[:, -most:].mean(1)
        return found

    def added(self, macro: int, boxes: Places) -> Floats:
        """(n, G, G), rows and columns: what a macro would add to the wire length at each cell.

        The wire mask of Lai et al. 2022, section 3.2; the two axes add up, so that it is two rows of numbers.
        """
        nets, macros, offsets = self._pins
        mine = macros == macro
        corner = np.arange(self.grid) * self.cell[:, None, None]  # (2, 1, G)
        # Several pins of one net on a macro: the box grows by the farthest on either side.
        own, heads = np.unique(nets[mine], return_index=True)
        if not len(own):
            return np.zeros((len(boxes.low), self.grid, self.grid))
        ends = offsets[mine] + self.netlist.sizes[macro] / 2
        least, most = (f.reduceat(ends, heads, 0).T[..., None] for f in (np.minimum, np.maximum))  # (2, K, 1)
        low, high = boxes.low[:, :, own, None], boxes.high[:, :, own, None]  # (n, 2, K, 1)
        grown = (np.maximum(high, corner + most) - np.minimum(low, corner + least)).sum(2)
        grown -= np.maximum(high - low, 0.0).sum(2)
        columns, rows = grown[:, 0], grown[:, 1]  # (n, G)
        found: Floats = rows[:, :, None] + columns[:, None, :]
        return found

    def free(self, macro: int, cells: Integers) -> Bools:
        """(n, G, G), rows and columns: where a macro fits beside those that lie there (its position mask)."""
        corners = self.corners(cells)  # (n, M, 2)
        at = np.arange(self.grid)
        reach = (at > (corners - self.spans[macro])[..., None]) & (at < (corners + self.spans)[..., None])
        reach &= (cells >= 0)[..., None, None]  # (n, M, 2, G)
        columns, rows = reach[:, :, 0].astype(np.float32), reach[:, :, 1].astype(np.float32)
        inside = at[:, None] <= self.grid - self.spans[macro]  # (G, 2)
        found: Bools = ((rows.transpose(0, 2, 1) @ columns) == 0) & inside[:, 1, None] & inside[None, :, 0]
        return found


__all__ = ["Chip", "Places"]
