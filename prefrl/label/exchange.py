"""Judgements in and out of files: the columns that the field uses, and a bundle that loses nothing."""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from prefrl.files import read_lines, verify, whole_folder, write_file
from prefrl.log import StoreError
from prefrl.store import Store
from prefrl.types import Comparison, Query, Response, implied_pairs

COLUMNS = ("prompt", "chosen", "rejected")
SHOWN_ERRORS = 20


@dataclass(frozen=True)
class Exported:
    """What a file got, and what it could not hold."""

    written: int
    ties: int = 0


def export_preferences(store: Store[Any], path: Path) -> Exported:
    """Write one JSON object a line with `prompt`, `chosen`, `rejected`: every decided pair that the judgements imply.

    Ties have no place in these columns; they are left out and counted. Raises `StoreError` for control segments.
    """
    lines, ties = [], 0
    for judged in store.judged():
        texts = judged.query.candidates
        if not isinstance(texts[0], Response):
            raise StoreError("preferences over control segments do not fit prompt/chosen/rejected; use --form bundle")
        for i, j, preference in implied_pairs(judged.judgement):
            ties += preference == 0.5
            if preference != 0.5:
                better, worse = (texts[i], texts[j]) if preference > 0.5 else (texts[j], texts[i])
                row = dict(zip(COLUMNS, (texts[0].prompt, better.text, worse.text), strict=True))
                lines.append(_line(row))
    write_file(path, "".join(lines).encode())
    return Exported(len(lines), ties)


def import_preferences(path: Path, store: Store[Response]) -> int:
    """Read `prompt`, `chosen`, `rejected` rows into a store, all or none; returns the number of rows.

    JSON lines, or a table that `datasets` reads: .csv or .parquet.
    Raises `ValueError` with the number of each bad row (the first 20). A pair that comes again, in this
    file or in another, is another judgement of the same query: contradictions are kept, not resolved. The labeler is
    named after the file's content, so reading the same file twice changes nothing.
    """
    rows, errors = [], []
    for number, row in enumerate(_rows(path), 1):
        try:
            rows.append(_parse(row))
        except ValueError as error:
            errors.append(f"row {number}: {error}")
    if errors:
        more = f"\n... and {len(errors) - SHOWN_ERRORS} more" if len(errors) > SHOWN_ERRORS else ""
        raise ValueError(f"{path}: nothing was imported\n" + "\n".join(errors[:SHOWN_ERRORS]) + more)
    if not rows:
        raise ValueError(f"{path}: expected at least one row of {', '.join(COLUMNS)}, got none")
    seen: Counter[str] = Counter()
    answers = []
    source = hashlib.sha256(path.read_bytes()).hexdigest()[:12]
    for query, chosen in rows:
        seen[query.id] += 1
        labeler = f"file:{source}" + (f"#{seen[query.id]}" if seen[query.id] > 1 else "")
        answers.append(Comparison(query.id, float(query.candidates[0].id == chosen), labeler))
    store.ask([query for query, _ in rows])
    store.answer(answers)
    return len(rows)


def _line(row: dict[str, Any]) -> str:
    """One line of JSON, readable in any language; escaped where the text is no valid Unicode."""
    line = json.dumps(row, ensure_ascii=False)
    try:
        line.encode()
    except UnicodeEncodeError:
        line = json.dumps(row)
    return line + "\n"


def _rows(path: Path) -> Iterator[Any]:
    """Lines of JSON, or the rows of a table as dicts."""
    if path.suffix not in (".csv", ".parquet"):
        yield from read_lines(path)
        return
    from datasets import Dataset

    with tempfile.TemporaryDirectory() as cache:
        read = Dataset.from_csv if path.suffix == ".csv" else Dataset.from_parquet
        yield from read(str(path), cache_dir=cache, keep_in_memory=True)


def _parse(row: Any) -> tuple[Query[Response], str]:
    """A row as a query and the id of the chosen response."""
    if isinstance(row, str):
        row = json.loads(row, parse_constant=_no_constant)
    if not isinstance(row, dict):
        raise ValueError(f"expected an object, got {type(row).__name__}")
    for name in COLUMNS:
        if name not in row:
            raise ValueError(f"column {name!r} is missing; there are: {', '.join(map(str, row))}")
        if not isinstance(row[name], str):
            raise ValueError(f"column {name!r}: expected a string, got {row[name]!r}")
    if row["chosen"] == row["rejected"]:
        raise ValueError("chosen and rejected are the same text")
    chosen, rejected = (Response(row["prompt"], row[name]) for name in ("chosen", "rejected"))
    return Query((chosen, rejected)), chosen.id


def _no_constant(name: str) -> float:
    raise ValueError(f"{name} is not a value")


def export_bundle(store: Store[Any], path: Path) -> Exported:
    """Write a folder with every event and every array, gold apart from the rest and left out. Loses nothing else."""
    events = list(store.events())
    with whole_folder(path) as work:
        lines = "".join(_line(event) for event in events)
        write_file(work / "events.jsonl", lines.encode())
        for blob in sorted((store.folder / "blobs").rglob("*.safetensors")):
            write_file(work / blob.relative_to(store.folder), blob.read_bytes())
    return Exported(sum(event["kind"] in ("comparison", "ranking", "skip") for event in events))


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
