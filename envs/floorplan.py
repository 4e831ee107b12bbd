"""Macros placed one after another on a chip: discrete control, with a mask of the places that are free.

An episode is a plan, from the largest macro to the smallest, and ends with a look at the whole; a segment is an
episode. The gold, which nobody who learns sees, is minus the wire length and the congestion that a plan has, weighed,
in units of what random plans have: each step's is what it adds. Left out: rotations, and blocks whose shape is free.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field, model_validator

from prefrl.components import ConfigError, Settings
from prefrl.envs.bookshelf import BOARD, Netlist, Pin, read
from prefrl.envs.chips import Chip
from prefrl.envs.fast.vectorised import Vectorised
from prefrl.envs.plans import CELLS, CONGESTION, MAPS, WIRE, Floorplan, Units, random_plans
from prefrl.protocols import Environments
from prefrl.types import Bools, Floats, Segment

TRIED = 64
"""Random plans that say what is usual, and whether all macros find a place."""
TIGHT = 0.1
"""A chip is too small where in more of these plans a macro finds none."""
MACROS = 8
"""Of the generated netlist, unless more are asked for."""
CLIP_SECONDS = 4.0
"""How long it takes to show a plan being made, about."""
Positive = Annotated[float, Field(gt=0)]


class FloorplanSettings(Settings):
    """Macros placed one after another on a chip; a segment is a whole plan."""

    kind: Literal["floorplan"] = "floorplan"
    netlist: Path | None = None
    """A Bookshelf file NAME.blocks or NAME.hardblocks, with NAME.nets and perhaps NAME.pl beside it, from the working
    directory where it is relative; a generated netlist when left out."""
    macros: int = Field(MACROS, ge=4, le=200)
    """Of the generated netlist, how many there are."""
    chip: tuple[Positive, Positive] | None = None
    """Width and height, in the unit of the netlist; what its terminals lie around when left out, or a square of which
    macros cover half."""
    grid: int = Field(32, ge=4, le=128)
    """Cells to a side: macros lie with their lower left corners on them."""
    wire_weight: float = Field(1.0, ge=0)
    """Of the wire length in the gold."""
    congestion_weight: float = Field(0.5, ge=0)
    """Of the congestion in the gold."""
    frame_size: int = Field(320, ge=16, le=2048)
    """Height and width of drawn frames, in pixels."""

    @model_validator(mode="after")
    def _one_netlist(self) -> FloorplanSettings:
        if self.netlist is not None and "macros" in self.model_fields_set and self.macros != MACROS:
            raise ValueError("macros is of the generated netlist, and netlist names another: leave one of them out")
        return self

    def build(self) -> FloorplanTask:
        """Raises `ConfigError` for files that cannot be read, a macro larger than the chip, and where macros find no
        place in random plans."""
        try:
            netlist = (generated(self.macros) if self.netlist is None else read(self.netlist)).by_size()
            chip = Chip(netlist, *self._extent(netlist), self.grid)
        except ValueError as error:
            raise ConfigError(f"task.{'chip' if self.netlist is None else 'netlist'}: {error}") from error
        world = Floorplan(chip, weights=(self.wire_weight, self.congestion_weight))
        tried = random_plans(world, TRIED, np.random.default_rng(0))
        notes = (*netlist.notes, *_without_place(tried, chip))
        usual = tried[:, [WIRE, CONGESTION]].mean(0)
        if not usual.all():
            raise ConfigError(f"task.netlist: the nets of {netlist.name} have no length in any plan: nothing to learn")
        return FloorplanTask(replace(world, units=Units(*usual.tolist())), self.frame_size, notes)

    def _extent(self, netlist: Netlist) -> tuple[float, float]:
        side = math.sqrt(2 * netlist.area)
        return self.chip or netlist.outline or (side, side)


def _without_place(plans: Floats, chip: Chip) -> Iterator[str]:
    """What to say where a macro lies nowhere in some of these whole plans. Raises `ConfigError` where it is in many."""
    missing = plans[:, CELLS:] < 0
    count = int(missing.any(1).sum())
    if not count:
        return
    said = (
        f"in {count} of {len(plans)} random plans there is no legal move left for a macro, the largest of them "
        f"{chip.netlist.macros[int(missing.any(0).argmax())]}: the macros cover "
        f"{chip.spans.prod(1).sum() / chip.grid**2:.0%} of the cells"
    )
    if count > TIGHT * len(plans):
        raise ConfigError(f"task.chip: {said}; make the chip larger (task.chip), or the grid finer (task.grid)")
    yield f"{said}; such a plan leaves it out, and counts as so much worse"


@dataclass(frozen=True, eq=False)
class FloorplanTask:
    """A `prefrl.protocols.ControlTask` that is `prefrl.protocols.Mapped`."""

    world: Floorplan
    frame_size: int
    notes: tuple[str, ...] = ()
    action_bounds: None = None
    kind: str = "control"

    @property
    def name(self) -> str:
        return f"floorplan {self.world.chip.netlist.name}"

    @property
    def horizon(self) -> int:
        return self.world.horizon

    @property
    def segment_steps(self) -> int:
        return self.world.horizon

    @property
    def observation_size(self) -> int:
        return self.world.observation_size

    @property
    def action_size(self) -> int:
        return self.world.actions

    @property
    def fps(self) -> float:
        return max(2.0, self.horizon / CLIP_SECONDS)

    @property
    def maps(self) -> tuple[str, ...]:
        return MAPS

    def environments(self, count: int) -> Environments:
        return Vectorised(self.world, count, self.horizon)

    def told(self, observations: Floats) -> Floats:
        return self.world.maps(self.world.seen(observations))

    def legal(self, observations: Floats) -> Bools:
        return self.world.legal(self.world.seen(observations))

    def frames(self, segment: Segment) -> np.ndarray:
        """(T, frame_size, frame_size, 3), drawn from what was seen; the last one is the whole plan."""
        return np.stack([self.world.picture(one, self.frame_size) for one in self.world.seen(segment.observations)])


def generated(macros: int) -> Netlist:
    """A netlist that is always the same for a number of macros: blocks of several sizes, and terminals all around.

    Macros lie on a circle in a hidden order, and nets join those that are near each other on it.
    """
    rng = np.random.default_rng(macros)
    sizes = np.round(rng.uniform(60.0, 200.0, (macros, 2)))
    side = math.sqrt(3.5 * sizes.prod(1).sum())
    nets = []
    for _ in range(8 * macros):
        first = int(rng.integers(macros))
        near = {first, (first + 1 + int(rng.geometric(0.5)) % (macros - 1)) % macros}
        pins = [Pin(at, *(rng.uniform(-0.5, 0.5, 2) * sizes[at]).round().tolist()) for at in sorted(near)]
        if rng.random() < 0.4:
            turn = 2 * math.pi * (first + rng.uniform()) / macros
            pins.append(Pin(BOARD, *_on_edge(turn, side)))
        nets.append(tuple(pins))
    return Netlist(f"of {macros} macros", tuple(f"m{i}" for i in range(macros)), sizes, tuple(nets))


def _on_edge(turn: float, side: float) -> tuple[float, float]:
    """Where a ray from the middle of a square meets its edge."""
    x, y = math.cos(turn), math.sin(turn)
    reach = side / 2 / max(abs(x), abs(y))
    return round(side / 2 + reach * x), round(side / 2 + reach * y)
