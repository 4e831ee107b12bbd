"""Judgements in and out of files: the columns that the field uses, and a bundle that loses nothing."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from prefrl.files import read_lines, verify, whole_folder, write_file
from prefrl.graph import implied_pairs
from prefrl.label.formats import Which, read_judgements
from prefrl.log import StoreError
from prefrl.store import ANSWERS, Store
from prefrl.types import Response

COLUMNS = ("prompt", "chosen", "rejected")


@dataclass(frozen=True)
class Exported:
    """What a file got, and what it could not hold."""

    written: int
    ties: int = 0


@dataclass(frozen=True)
class Imported:
    """How many judgements a file held, and what was left out of it."""

    read: int
    notes: tuple[str, ...] = ()


def export_preferences(store: Store[Any], path: Path) -> Exported:
    """Write one JSON object a line with `prompt`, `chosen`, `rejected`: every decided pair that the judgements imply.

    Ties have no place in these columns; they are left out and counted. Raises `StoreError` for control segments.
    """
    lines, ties = [], 0
    for judged in store.judged():
        texts = judged.query.candidates
        if not isinstance(texts[0], Response):
            raise StoreError("preferences over control segments do not fit prompt/chosen/rejected; use --form bundle")
        for i, j, preference in implied_pairs(judged.judgement, len(texts)):
            ties += preference == 0.5
            if preference != 0.5:
                better, worse = (texts[i], texts[j]) if preference > 0.5 else (texts[j], texts[i])
                row = dict(zip(COLUMNS, (texts[0].prompt, better.text, worse.text), strict=True))
                lines.append(_line(row))
    write_file(path, "".join(lines).encode())
    return Exported(len(lines), ties)


def import_judgements(path: Path, store: Store[Any], which: Which | None = None) -> Imported:
    """Read a file of judgements (`read_judgements` says which), or a bundle, into a store, all or none.

    A second reading changes nothing. Raises `ValueError` for what is wrong in the file, and `StoreError` where the
    store holds another judgement of the same query by a labeler of the same name.
    """
    if path.is_dir():
        if which and (which.labelers or which.split):
            raise ValueError(f"{path}: a bundle is read whole; choose labelers when you fit")
        return Imported(import_bundle(path, store))
    read = read_judgements(path, which)
    standing = {(a.query, a.labeler): a for a in store.answers()}
    for judged in read.judged:
        given = judged.judgement
        if (there := standing.get((given.query, given.labeler), given)) != given:
            raise StoreError(f"{path}: {given.labeler!r} has judged query {given.query[:12]} otherwise before: {there}")
    store.ask([judged.query for judged in read.judged])
    store.answer([judged.judgement for judged in read.judged])
    return Imported(len(read.judged), read.notes)


def _line(row: dict[str, Any]) -> str:
    """One line of JSON, readable in any language; escaped where the text is no valid Unicode."""
    line = json.dumps(row, ensure_ascii=False)
    try:
        line.encode()
    except UnicodeEncodeError:
        line = json.dumps(row)
    return line + "\n"


def export_bundle(store: Store[Any], path: Path) -> Exported:
    """Write a folder with every event and every array, gold apart from the rest and left out. Loses nothing else."""
    events = list(store.events())
    with whole_folder(path) as work:
        lines = "".join(_line(event) for event in events)
        write_file(work / "events.jsonl", lines.encode())
        for blob in sorted((store.folder / "blobs").rglob("*.safetensors")):
            write_file(work / blob.relative_to(store.folder), blob.read_bytes())
    return Exported(sum(event["kind"] in ANSWERS for event in events))


def import_bundle(path: Path, store: Store[Any]) -> int:
    """Read a folder that `export_bundle` wrote, all or none; what the store has already is left alone."""
    verify(path)
    return store.merge(list(_events(path / "events.jsonl")), path / "blobs")


def _events(path: Path) -> Iterator[dict[str, Any]]:
    for number, line in enumerate(read_lines(path), 1):
        try:
            event = json.loads(line)
            yield {name: event[name] for name in ("id", "kind", "subject", "actor", "body", "at")}
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path}: row {number} is no event: {error!r}") from None
