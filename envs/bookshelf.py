"""Netlists of chips, and a reader for the Bookshelf files of GSRC and MCNC.

Variant: hard rectangles as they are; a soft block gets the shape nearest to a square that it may have. Left out: blocks
that are no rectangles, and what `.pl` says of blocks, which are to be placed.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from prefrl.types import Floats, Integers

_HEADER = re.compile(r"UC(LA|SC)\b", re.IGNORECASE)
"""How a file of this form begins, after the university that wrote it."""

PERCENT = 100.0
BOARD = -1
"""In the place of a macro: a pin that stays where it is."""


class Pin(NamedTuple):
    """One end of a net."""

    macro: int
    """Which macro it is on, or `BOARD`."""
    x: float
    """From the middle of the macro, or from the chip's lower left corner."""
    y: float


@dataclass(frozen=True, eq=False)
class Netlist:
    """Macros that are to be placed, and the nets that join them. Lengths are in the unit of the file.

    Raises `ValueError` for a net of fewer than two pins, and for macros without a width or height.
    """

    name: str
    macros: tuple[str, ...]
    sizes: Floats
    """(M, 2) widths and heights."""
    nets: tuple[tuple[Pin, ...], ...]
    notes: tuple[str, ...] = ()
    """Whole sentences about what was left out."""

    def __post_init__(self) -> None:
        for number, net in enumerate(self.nets, 1):
            if len(net) < 2:
                raise ValueError(
                    f"net {number} of {self.name} has {len(net)} pin: expected at least two, or no such net"
                )
        if not self.macros or not (self.sizes > 0).all():
            raise ValueError(f"{self.name}: expected at least one macro, each with a width and a height above 0")

    @property
    def area(self) -> float:
        return float(self.sizes.prod(1).sum())

    @property
    def outline(self) -> tuple[float, float] | None:
        """Width and height of what the terminals lie around; None where none of them has a position."""
        fixed = [(pin.x, pin.y) for net in self.nets for pin in net if pin.macro == BOARD]
        if not fixed:
            return None
        width, height = np.max(fixed, 0).tolist()
        return (width, height) if width > 0 and height > 0 else None

    def by_size(self) -> Netlist:
        """The same with the largest macros first, in which order they are placed."""
        order = np.argsort(-self.sizes.prod(1), kind="stable")
        place = np.argsort(order)
        nets = tuple(
            tuple(pin if pin.macro == BOARD else pin._replace(macro=int(place[pin.macro])) for pin in net)
            for net in self.nets
        )
        return Netlist(self.name, tuple(self.macros[i] for i in order), self.sizes[order], nets, self.notes)

    def pins(self) -> tuple[Integers, Integers, Floats]:
        """(P,) the net of each pin, in order, (P,) its macro or `BOARD`, and (P, 2) where it is on it."""
        rows = [(number, pin) for number, net in enumerate(self.nets) for pin in net]
        nets, macros = (np.array(column, np.int64) for column in ([n for n, _ in rows], [p.macro for _, p in rows]))
        return nets, macros, np.array([(pin.x, pin.y) for _, pin in rows])


class _Line(NamedTuple):
    path: Path
    number: int
    text: str

    def error(self, expected: str) -> ValueError:
        return ValueError(f"{self.path}, line {self.number}: expected {expected}, got {self.text!r:.80}")


def read(path: Path) -> Netlist:
    """The netlist of NAME.blocks or NAME.hardblocks, with NAME.nets and, where it is there, NAME.pl beside it.

    A terminal has a position where the `.pl` names it; all others are left out of the nets, and so are nets that then
    join less than two pins: `notes` says how many. Raises `ValueError`, with file and line, for what cannot be read.
    """
    if path.suffix not in (".blocks", ".hardblocks"):
        raise ValueError(f"{path}: expected a Bookshelf file NAME.blocks or NAME.hardblocks, with NAME.nets beside it")
    nets, places = path.with_suffix(".nets"), path.with_suffix(".pl")
    for file in (path, nets):
        if not file.is_file():
            raise ValueError(f"{file}: there is no such file; a netlist has {path.name} and {nets.name}")
    sizes, terminals = _blocks(path)
    positions = _places(places) if places.is_file() else {}
    # GSRC's blocks' files leave terminals out, and name them in the .pl alone.
    known = dict.fromkeys(terminals) | {name: place for name, place in positions.items() if name not in sizes}
    joined = [_joined(net, list(sizes), np.array([*sizes.values()]), known) for net in _nets(nets)]
    kept = [net for net in joined if len(net) > 1]
    return Netlist(
        path.stem, tuple(sizes), np.array([*sizes.values()]), tuple(kept), tuple(_notes(known, len(joined) - len(kept)))
    )


def _notes(terminals: Mapping[str, tuple[float, float] | None], dropped: int) -> Iterator[str]:
    lost = sum(place is None for place in terminals.values())
    if lost:
        left = f", and {dropped} nets with them, which join nothing else" if dropped else ""
        yield f"{lost} of {len(terminals)} terminals have no position, and are left out of the wire length{left}"


def _lines(path: Path) -> Iterator[_Line]:
    """Those that say something: no comments, and no header."""
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: expected a text file, got bytes that are no UTF-8 ({error.reason})") from error
    for number, line in enumerate(text.splitlines(), 1):
        said = line.split("#")[0].strip()
        if said and not _HEADER.match(said):
            yield _Line(path, number, said)


# --- blocks ---------------------------------------------------------------------------------------------------------


def _blocks(path: Path) -> tuple[dict[str, tuple[float, float]], list[str]]:
    sizes: dict[str, tuple[float, float]] = {}
    terminals: list[str] = []
    for line in _lines(path):
        name, *more = line.text.split(None, 1)
        rest = " ".join(more)
        if _is_count(line.text):
            continue
        if name in sizes or name in terminals:
            raise line.error(f"names that differ, and {name} is there already")
        if rest.strip() == "terminal":
            terminals.append(name)
        elif rest.startswith("hardrectilinear"):
            sizes[name] = _hard(line, rest)
        elif rest.startswith("softrectangular"):
            sizes[name] = _soft(line, rest)
        else:
            raise line.error("NAME hardrectilinear ..., NAME softrectangular AREA LEAST MOST or NAME terminal")
    if not sizes:
        raise ValueError(f"{path}: expected at least one block, got none")
    return sizes, terminals


def _hard(line: _Line, rest: str) -> tuple[float, float]:
    corners = np.array(re.findall(r"\(\s*([-+.\deE]+)\s*,\s*([-+.\deE]+)\s*\)", rest), float).reshape(-1, 2)
    if len(corners) != 4:
        raise line.error("a rectangle, of four corners (x, y)")
    width, height = np.ptp(corners, 0).tolist()
    if len({tuple(corner) for corner in corners.tolist()}) != 4 or not width or not height:
        raise line.error("a rectangle with a width and a height")
    return width, height


def _soft(line: _Line, rest: str) -> tuple[float, float]:
    numbers = _numbers(line, rest.split()[1:], 3, "an area, and the least and most of width / height")
    area, least, most = numbers
    if area <= 0 or not 0 < least <= most:
        raise line.error("an area above 0, and the least and most of width / height, in order")
    shape = min(max(1.0, least), most)
    return math.sqrt(area * shape), math.sqrt(area / shape)


def _is_count(text: str) -> bool:
    """Such as "NumTerminals : 69"; MCNC's have the number alone."""
    return text.startswith("Num") or text.isdigit()


def _numbers(line: _Line, words: Sequence[str], count: int, what: str) -> list[float]:
    try:
        found = [float(word) for word in words]
    except ValueError as error:
        raise line.error(what) from error
    if len(found) != count or not np.isfinite(found).all():
        raise line.error(what)
    return found


# --- nets and places ------------------------------------------------------------------------------------------------


class _End(NamedTuple):
    line: _Line
    name: str
    share: tuple[float, float]
    """From the middle, in shares of width and height."""


def _nets(path: Path) -> list[list[_End]]:
    nets: list[list[_End]] = []
    heads: list[tuple[_Line, int]] = []
    for line in _lines(path):
        if line.text.startswith("NetDegree"):
            heads.append((line, _degree(line)))
            nets.append([])
        elif not _is_count(line.text):
            if not nets:
                raise line.error("NetDegree : COUNT before the first pin")
            nets[-1].append(_end(line))
    for (line, degree), net in zip(heads, nets, strict=True):
        if len(net) != degree:
            raise line.error(f"as many pins as follow, which are {len(net)}")
    if not nets:
        raise ValueError(f"{path}: expected at least one net, got none")
    return nets


def _degree(line: _Line) -> int:
    (found,) = _numbers(line, line.text.partition(":")[2].split()[:1], 1, "NetDegree : COUNT")
    if found < 2 or found != int(found):
        raise line.error("a net of at least two pins")
    return int(found)


def _end(line: _Line) -> _End:
    name, _, where = line.text.partition(":")
    words = [word.removeprefix("%") for word in where.split()]
    x, y = _numbers(line, words, 2, "NAME [B] [: %X %Y]") if words else (0.0, 0.0)
    return _End(line, name.split()[0], (x / PERCENT, y / PERCENT))


def _places(path: Path) -> dict[str, tuple[float, float]]:
    found = {}
    for line in _lines(path):
        name, *words = line.text.split()
        x, y = _numbers(line, words[:2], 2, "NAME X Y")
        found[name] = x, y
    return found


def _joined(
    net: Sequence[_End], macros: list[str], sizes: Floats, terminals: Mapping[str, tuple[float, float] | None]
) -> tuple[Pin, ...]:
    """Without the terminals that have no position."""
    pins = []
    for end in net:
        if end.name in terminals:
            place = terminals[end.name]
            if place is not None:
                pins.append(Pin(BOARD, *place))
        elif end.name in macros:
            at = macros.index(end.name)
            pins.append(Pin(at, *(float(s) for s in sizes[at] * end.share)))
        else:
            raise end.line.error("a block or a terminal that the blocks' file has")
    return tuple(pins)


__all__ = ["BOARD", "Netlist", "Pin", "read"]
