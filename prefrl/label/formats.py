"""Files of judgements, read whole or not at all: judged responses to prompts, and judged pairs of segments."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

from prefrl.types import Judged

SHOWN_ERRORS = 20
HUMAN, SCRIPT = "human", "script"


class Row(NamedTuple):
    """One judgement of a file."""

    judged: Judged[Any]
    """Its labeler is "" where the file names none."""
    split: str
    """The part of the data that the file puts it into; "" where it says nothing."""


Parts: TypeAlias = Iterable[tuple[str, Callable[[], Sequence[Row | str]]]]
"""(place, parse): where a part of a file stands, and what reads it: judgements, and reasons for leaving some out."""


@dataclass(frozen=True)
class Which:
    """Which judgements of a source count."""

    labelers: tuple[str, ...] = ()
    """By whom; everybody when empty."""
    split: str = ""
    """Of which part of a file, "train" or "eval" say; all when empty."""

    @classmethod
    def of(cls, labelers: str, split: str) -> Which:
        """From names that are separated by commas."""
        return cls(tuple(name.strip() for name in labelers.split(",") if name.strip()), split)

    def takes(self, labeler: str) -> bool:
        """Whether a labeler's judgements count; "human#2" gave the second judgement of "human" on the same query."""
        return not self.labelers or labeler.partition("#")[0] in self.labelers


@dataclass(frozen=True)
class Read:
    """What a file holds."""

    judged: tuple[Judged[Any], ...]
    notes: tuple[str, ...] = ()
    """What was left out, for people."""


def read_judgements(path: Path, which: Which | None = None) -> Read:
    """The judgements in a file of JSON lines (.gz or not), in a table (.csv, .parquet) or in an .npz of segment pairs.

    All or none: raises `ValueError` with the place of each mistake (the first 20), also in parts that `which` leaves
    out. A query that is judged again is another judgement, by "NAME#2": contradictions are kept, not resolved. Where a
    file names no labeler it is called after the content, so that reading it twice changes nothing. Labels of a
    "script" beside a human's are left out, and said to be, unless `which` asks for them.
    """
    rows, left_out = _parse(path)
    if not rows:
        reasons = "".join(f"; {note}" for note in _told(left_out))
        raise ValueError(f"{path}: expected at least one row with a judgement, got none{reasons}")
    which, named = which or Which(), _numbered(rows, f"file:{_digest(path)}")
    labelers = {_name(row) for row in named}
    if not which.labelers and {HUMAN, SCRIPT} <= labelers:
        which = replace(which, labelers=tuple(labelers - {SCRIPT}))
        left_out["label by a script (--labelers script reads it)"] = sum(
            _name(row) == SCRIPT and which.split in ("", row.split) for row in named
        )
    chosen = [row.judged for row in named if which.takes(_name(row)) and which.split in ("", row.split)]
    if not chosen:
        raise ValueError(f"{path}: {_nothing(named, which)}")
    return Read(tuple(chosen), _told(left_out))


def _parse(path: Path) -> tuple[list[Row], Counter[str]]:
    """Every row of a file, and how many were left out for which reason."""
    rows: list[Row] = []
    left_out: Counter[str] = Counter()
    errors = []
    for place, parse in _parts(path):
        try:
            found = parse()
        except ValueError as error:
            errors.append(f"{place}: {error}")
        else:
            rows += [one for one in found if isinstance(one, Row)]
            left_out.update(one for one in found if isinstance(one, str))
    if errors:
        more = f"\n... and {len(errors) - SHOWN_ERRORS} more" if len(errors) > SHOWN_ERRORS else ""
        raise ValueError(f"{path}: nothing was read\n" + "\n".join(errors[:SHOWN_ERRORS]) + more)
    return rows, left_out


def _parts(path: Path) -> Parts:
    if path.suffix == ".npz":
        from prefrl.label.segment_pairs import segment_pairs

        return segment_pairs(path)
    from prefrl.label.text_rows import text_rows

    return text_rows(path)


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:12]


def _numbered(rows: Sequence[Row], default: str) -> list[Row]:
    """Every judgement with a labeler; one's second judgement of a query is by "NAME#2": a store keeps one a name."""
    seen: Counter[tuple[str, str]] = Counter()
    found = []
    for row in rows:
        query, judgement = row.judged.query, row.judged.judgement
        who = judgement.labeler or default
        seen[query.id, who] += 1
        name = f"{who}#{again}" if (again := seen[query.id, who]) > 1 else who
        found.append(row._replace(judged=Judged(query, replace(judgement, labeler=name))))
    return found


def _name(row: Row) -> str:
    """The labeler, whichever of its judgements this is."""
    return row.judged.judgement.labeler.partition("#")[0]


def _nothing(rows: Sequence[Row], which: Which) -> str:
    """Why nothing was chosen, and what there is to choose from."""
    wanted = " and ".join([*which.labelers, *([f"split {which.split!r}"] if which.split else [])])
    labelers = ", ".join(sorted({_name(row) for row in rows}))
    splits = ", ".join(sorted({row.split for row in rows} - {""})) or "none"
    return f"no judgement by or in {wanted}; labelers there: {labelers}; splits there: {splits}"


def _told(left_out: Counter[str]) -> tuple[str, ...]:
    return tuple(f"left out: {count} x {reason}" for reason, count in left_out.items())
