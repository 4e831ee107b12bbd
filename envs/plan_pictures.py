"""Floorplans as pictures: macros with their names, wires as stars, and red where wires crowd."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from prefrl.envs.bookshelf import BOARD
from prefrl.envs.chips import Chip
from prefrl.types import Floats, Integers

SHARP = 2
"""Pictures are drawn so many times larger, and made smaller for smooth edges."""
MARGIN = 0.03
"""Around the chip, as a share of the picture."""
PAPER, BOARD_INK, MACRO, NEWEST = (240, 240, 240), (255, 255, 255), (205, 221, 238), (250, 219, 178)
EDGE, WIRE, PAD, HOT = (60, 66, 74), (72, 120, 176, 70), (120, 120, 120), (201, 60, 50)
FULL = 0.55
"""How red the most crowded bins are."""

At: TypeAlias = Callable[[Floats], list[tuple[float, float]]]
"""(k, 2) in the unit of the netlist -> pixels, rows from above."""


def drawn(chip: Chip, cells: Integers, newest: int, crowded: float, size: int) -> np.ndarray:
    """(size, size, 3) uint8 of the macros that lie somewhere; the chip's lower left corner is the picture's.

    `cells` (M,), -1 where a macro does not lie anywhere yet; `newest` is the macro placed last, -1 for none. Bins that
    are much more crowded than `crowded` are as red as they get.
    """
    whole = size * SHARP
    scale = whole * (1 - 2 * MARGIN) / max(chip.width, chip.height)

    def at(places: Floats) -> list[tuple[float, float]]:
        x, y = whole * MARGIN + np.asarray(places).reshape(-1, 2).T * scale
        return [*zip(x.tolist(), (whole - y).tolist(), strict=True)]

    picture = Image.new("RGB", (whole, whole), PAPER)
    pen = ImageDraw.Draw(picture, "RGBA")
    (left, low), (right, high) = at(np.array([[0, 0], chip.extent]))
    pen.rectangle((left, high, right, low), fill=BOARD_INK, outline=EDGE)
    _macros(pen, chip, cells, newest, at)
    _heat(picture, chip, cells, crowded, (left, high, right, low))
    _wires(ImageDraw.Draw(picture, "RGBA"), chip, cells, at)
    return np.asarray(picture.resize((size, size), Image.Resampling.BOX))


def _macros(pen: ImageDraw.ImageDraw, chip: Chip, cells: Integers, newest: int, at: At) -> None:
    corners = chip.corners(cells) * chip.cell
    for macro in np.flatnonzero(cells >= 0).tolist():
        ends = np.stack([corners[macro], corners[macro] + chip.netlist.sizes[macro]])
        (left, low), (right, high) = at(ends)
        fill = NEWEST if macro == newest else MACRO
        pen.rectangle((left, high, right, low), fill=fill, outline=EDGE, width=SHARP)
        font = ImageFont.load_default(min(13 * SHARP, max(6 * SHARP, 0.3 * min(right - left, low - high))))
        pen.text(((left + right) / 2, (low + high) / 2), chip.netlist.macros[macro], EDGE, font, anchor="mm")


def _heat(
    picture: Image.Image, chip: Chip, cells: Integers, crowded: float, box: tuple[float, float, float, float]
) -> None:
    demand = chip.demand(chip.boxes(cells[None]))[0, ::-1]  # rows from above
    shade = Image.fromarray((255 * FULL * np.clip(demand / (1.6 * crowded), 0.0, 1.0) ** 1.5).astype(np.uint8))
    left, high, right, low = (round(one) for one in box)
    shade = shade.resize((right - left, low - high), Image.Resampling.BILINEAR)
    picture.paste(Image.new("RGB", shade.size, HOT), (left, high), shade)


def _wires(pen: ImageDraw.ImageDraw, chip: Chip, cells: Integers, at: At) -> None:
    """Each net as a star around the middle of its pins, of those that lie somewhere."""
    middles = chip.middles(cells[None])[0]
    for net in chip.netlist.nets:
        there = [pin for pin in net if pin.macro == BOARD or cells[pin.macro] >= 0]
        pins = np.array([(0.0 if pin.macro == BOARD else middles[pin.macro]) + np.array(pin[1:]) for pin in there])
        for pin, place in zip(there, at(pins), strict=True):
            if len(there) > 1:
                pen.line((*at(pins.mean(0))[0], *place), WIRE, SHARP)
            if pin.macro == BOARD:
                x, y = place
                pen.ellipse((x - 2 * SHARP, y - 2 * SHARP, x + 2 * SHARP, y + 2 * SHARP), PAD)
