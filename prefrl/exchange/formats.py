"""Files of answers, read whole or not at all: judged responses to prompts, judged pairs of segments, demonstrations.

What goes into a store is read twice: once to find every mistake, and once for its judgements, so that none of it need
be kept. What is wanted in memory is read once, and kept.
"""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from prefrl.exchange.behaviour import behaviour_rows, is_behaviour
from prefrl.exchange.layout import Layout, Parts, Row, Which
from prefrl.exchange.reading import TABLES, list_files
from prefrl.judgements import Judged, person

SHOWN_ERRORS = 20
SHOWN_REPEATS = 5
HUMAN, SCRIPT = "human", "script"


@dataclass(frozen=True)
class Read:
    """What a file holds."""

    judged: tuple[Judged, ...]
    notes: tuple[str, ...] = ()
    """What was left out, for people."""


def read_judgements(path: Path, which: Which | None = None, layout: Layout | None = None) -> Read:
    """The judgements in a file of JSON lines (.gz or not), in a table (.csv, .parquet) or in an .npz of segment pairs.

    All or none: raises `ValueError` with the place of each mistake (the first 20), also in parts that `which` leaves
    out. A query that is judged again is another judgement, by "NAME#2": contradictions are kept, not resolved. Where a
    file names no labeler it is called after the content, so that reading it twice changes nothing. Labels of a
    "script" beside a human's are left out, and said to be, unless `which` asks for them.
    """
    checked = check_file(path, which, layout, keep=True)
    return Read(tuple(row.judged for row in checked.rows() if row.answer.reason is None), checked.notes)


@dataclass(frozen=True)
class Checked:
    """A file, or a folder of files, that was read through, and found whole."""

    path: Path
    which: Which
    layout: Layout
    default: str
    """Whom its judgements are by where it names nobody."""
    notes: tuple[str, ...]
    kept: tuple[Row, ...] | None = None
    """Its rows as they were read, where they were to be kept."""

    def rows(self) -> Iterator[Row]:
        """The answers that count, each with a labeler; read from the file again, unless they were kept."""
        seen: Counter[bytes] = Counter()
        for row in (_numbered(one, self.default, seen) for one in self._again()):
            if self.which.takes(row.answer.labeler) and self.which.split in ("", row.split):
                yield row

    def _again(self) -> Iterator[Row]:
        if self.kept is not None:
            yield from self.kept
            return
        for _, parse in _parts(self.path, self.layout):
            try:
                found = parse()
            except ValueError:
                if not self.layout.skip_bad:
                    raise
                continue
            yield from (one for one in found if isinstance(one, Row))


def check_file(path: Path, which: Which | None = None, layout: Layout | None = None, keep: bool = False) -> Checked:
    """Read through a file, or a folder of files; raises as `read_judgements` does. `keep`: the rows, in memory."""
    layout, which, found = layout or Layout(), which or Which(), _Found(keep)
    for place, parse in _parts(path, layout):
        try:
            parsed = parse()
        except ValueError as error:
            found.mistake(f"{place}: {error}")
        else:
            found.take(place, parsed)
    notes = found.told(path, layout.skip_bad)
    # Only a file that leaves a labeler out is hashed: that goes through all of it once more.
    default = f"file:{_digest(path)}" if found.nameless else ""
    found.name(default)
    if is_behaviour(path):
        count = sum(found.counts.values())
        notes = (f"recorded behaviour, read as demonstrations: {count} by {default}", *notes)
    labelers = {person(who) for who, _ in found.counts}
    if not which.labelers and {HUMAN, SCRIPT} <= labelers:
        which = replace(which, labelers=tuple(labelers - {SCRIPT}))
        scripted = sum(
            n for (who, split), n in found.counts.items() if person(who) == SCRIPT and which.split in ("", split)
        )
        notes += _told(Counter({"label by a script (--labelers script reads it)": scripted}))
    if not any(which.takes(who) and which.split in ("", split) for who, split in found.counts):
        raise ValueError(f"{path}: {_nothing(found.counts, which)}")
    return Checked(path, which, layout, default, notes, tuple(found.rows) if keep else None)


@dataclass
class _Found:
    """What a first reading of a file comes to: counts, and a few bytes for each row."""

    keep: bool
    rows: list[Row] = field(default_factory=list)
    counts: Counter[tuple[str, str]] = field(default_factory=Counter)
    """(labeler, split) -> answers; "" for a labeler who is not named."""
    left_out: Counter[str] = field(default_factory=Counter)
    errors: list[str] = field(default_factory=list)
    mistakes: int = 0
    seen: Counter[bytes] = field(default_factory=Counter)
    first: dict[bytes, str] = field(default_factory=dict)
    """Where a labeler first judged a query."""
    repeats: list[str] = field(default_factory=list)
    repeated: int = 0

    def mistake(self, error: str) -> None:
        self.mistakes += 1
        self.errors += [error] * (len(self.errors) < SHOWN_ERRORS)

    def take(self, place: str, parsed: Sequence[Row | str]) -> None:
        self.left_out.update(one for one in parsed if isinstance(one, str))
        for row in (one for one in parsed if isinstance(one, Row)):
            self.rows += [row] * self.keep
            self.counts[row.answer.labeler, row.split] += 1
            key = _key(row, "")
            self.seen[key] += 1
            if self.seen[key] > 1:
                self.repeated += 1
                self.repeats += [f"{place} repeats {self.first[key]}"] * (len(self.repeats) < SHOWN_REPEATS)
            self.first.setdefault(key, place)

    @property
    def nameless(self) -> bool:
        """Whether a row names no labeler."""
        return any(not who for who, _ in self.counts)

    def name(self, default: str) -> None:
        """Call whoever is not named so."""
        named: Counter[tuple[str, str]] = Counter()
        for (who, split), count in self.counts.items():
            named[who or default, split] += count
        self.counts = named

    def told(self, path: Path, skip_bad: bool) -> tuple[str, ...]:
        """Notes for people. Raises `ValueError` for mistakes that may not be left out, and where nothing was found."""
        more = f"\n... and {self.mistakes - SHOWN_ERRORS} more" if self.mistakes > SHOWN_ERRORS else ""
        listed = "\n".join(self.errors) + more
        if self.mistakes and not skip_bad:
            raise ValueError(f"{path}: nothing was read\n{listed}")
        notes = _told(self.left_out)
        if self.mistakes:
            notes += (f"left out: {self.mistakes} x bad row\n{listed}",)
        if self.repeated:
            shown = "; ".join(self.repeats) + ("; ..." if self.repeated > SHOWN_REPEATS else "")
            again = "another judgement of the same query by the same labeler, kept as NAME#2"
            notes += (f"{self.repeated} x {again}: {shown}",)
        if not self.counts:
            reasons = "".join(f"; {note}" for note in notes)
            raise ValueError(f"{path}: expected at least one judgement or demonstration, got none{reasons}")
        return notes


def _parts(path: Path, layout: Layout) -> Parts:
    if is_behaviour(path):
        return behaviour_rows(path, layout)
    if path.suffix == ".npz":
        from prefrl.exchange.segment_pairs import segment_pairs

        _check_default(path, layout)
        return segment_pairs(path)
    if path.is_dir():
        from prefrl.exchange.dataset_folders import folder_rows
        from prefrl.exchange.minari_folders import is_minari, minari_rows

        if not is_minari(path):
            return folder_rows(path, layout)
        _check_default(path, layout)
        return minari_rows(path)
    from prefrl.exchange.text_rows import text_rows

    return text_rows(path, layout)


def _check_default(path: Path, layout: Layout) -> None:
    if layout.columns or layout.form != "auto":
        raise ValueError(f"{path} holds judged segments: --map and --form are for rows, leave them out")


def _digest(path: Path) -> str:
    if path.is_dir():
        files = list_files(path, [f"*{suffix}*" for suffix in (*TABLES, ".json", ".hdf5")])
        return hashlib.sha256("".join(_digest(file) for file in files).encode()).hexdigest()[:12]
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:12]


def _key(row: Row, default: str) -> bytes:
    return _digested(f"{row.query.id}:{row.answer.labeler or default}")


def _digested(text: str) -> bytes:
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).digest()


def _numbered(row: Row, default: str, seen: Counter[bytes]) -> Row:
    """A row with a labeler; one's second judgement of a query is by "NAME#2": a store keeps one a name."""
    who = row.answer.labeler or default
    there = _name(who, _digested(f"{row.named} {who}"), seen) if row.named else ""
    return row._replace(answer=replace(row.answer, labeler=_name(who, _key(row, default), seen)), there=there)


def _name(who: str, key: bytes, seen: Counter[bytes]) -> str:
    seen[key] += 1
    return f"{who}#{seen[key]}" if seen[key] > 1 else who


def _nothing(counts: Iterable[tuple[str, str]], which: Which) -> str:
    """Why nothing was chosen, and what there is to choose from."""
    wanted = " and ".join([*which.labelers, *([f"split {which.split!r}"] if which.split else [])])
    labelers = ", ".join(sorted({person(who) for who, _ in counts}))
    splits = ", ".join(sorted({split for _, split in counts} - {""})) or "none"
    return f"no judgement by or in {wanted}; labelers there: {labelers}; splits there: {splits}"


def _told(left_out: Counter[str]) -> tuple[str, ...]:
    return tuple(f"left out: {count} x {reason}" for reason, count in left_out.items())
