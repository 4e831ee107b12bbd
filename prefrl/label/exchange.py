"""Judgements in and out of files: the forms that the field uses, and a bundle that loses nothing."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

import sqlalchemy as sql

from prefrl.blobs import write_arrays
from prefrl.events import PORTABLE, describe, read_answer
from prefrl.files import MANIFEST, verify, whole_folder, write_file
from prefrl.label.exports.dataset import export_dataset
from prefrl.label.exports.given import Exported, json_text, whole_file
from prefrl.label.exports.minari import export_minari
from prefrl.label.exports.rows import export_judgements, export_preferences, export_unpaired
from prefrl.label.exports.table import export_csv
from prefrl.label.exports.tools import export_arena, export_argilla, export_label_studio
from prefrl.label.formats import Layout, Row, Which, check_file
from prefrl.label.reading import parse_json, read_lines, refuse_links
from prefrl.log import StoreError, Transaction, row
from prefrl.projection import ANSWERS, CHUNK, RETRACTED, chunks, words
from prefrl.store import Store
from prefrl.tables import event
from prefrl.types import Candidate, Segment

EVENTS = "events.jsonl"
FIELDS = ("id", "kind", "subject", "actor", "body", "at")
"""What of an event goes from store to store; its number and its hash are each store's own."""


@dataclass(frozen=True)
class Imported:
    """How many answers a file held, and what was left out of it."""

    read: int
    notes: tuple[str, ...] = ()


# --- out ----------------------------------------------------------------------------------------------------------


def export_bundle(store: Store[Any], path: Path) -> Exported:
    """Write a folder with every event and every array; the same store gives the same bytes.

    Gold stays out, and so do names of people who have not answered, their access, and settings of the project.
    """
    left, answers = 0, 0
    with whole_folder(path) as work:
        with whole_file(work / EVENTS) as file:
            for one in store.events():
                left += one["kind"] not in PORTABLE
                answers += one["kind"] in ANSWERS
                if one["kind"] in PORTABLE:
                    file.write(f"{_event_text(one)}\n".encode())
        for blob in sorted((store.folder / "blobs").rglob("*.safetensors")):
            write_file(work / blob.relative_to(store.folder), blob.read_bytes())
    note = "the gold stays where it is, and so do secrets that let people in"
    return Exported(answers, {"event about people's access or the project's settings": left} if left else {}, (note,))


def _event_text(one: Mapping[str, Any]) -> str:
    body = json.loads(json.dumps(one["body"], sort_keys=True))
    return json_text({name: body if name == "body" else one[name] for name in FIELDS})


EXPORTS: Mapping[str, Callable[[Store[Any], Path, str], Exported]] = {
    "preferences": lambda store, path, ties: export_preferences(store, path, ties),
    "conversational": lambda store, path, ties: export_preferences(store, path, ties, conversational=True),
    "unpaired": lambda store, path, _: export_unpaired(store, path),
    "unpaired-conversational": lambda store, path, _: export_unpaired(store, path, conversational=True),
    "judgements": lambda store, path, _: export_judgements(store, path),
    "dataset": lambda store, path, _: export_dataset(store, path),
    "argilla": lambda store, path, _: export_argilla(store, path),
    "label-studio": lambda store, path, _: export_label_studio(store, path),
    "arena": lambda store, path, _: export_arena(store, path),
    "csv": lambda store, path, _: export_csv(store, path),
    "minari": lambda store, path, _: export_minari(store, path),
    "bundle": lambda store, path, _: export_bundle(store, path),
}
"""What writes each form; the text says what becomes of ties, where a form has none: "drop" or "both"."""


def export(store: Store[Any], path: Path, form: str = "preferences", ties: str = "drop") -> Exported:
    """Write the answers of a store to a file or a folder, whole or not at all."""
    if ties != "drop" and form not in ("preferences", "conversational"):
        raise ValueError(f"ties={ties!r} is for preferences and conversational; the form {form!r} has its own way")
    return EXPORTS[form](store, path, ties)


# --- in -----------------------------------------------------------------------------------------------------------


def is_bundle(path: Path) -> bool:
    """Whether a folder holds the events of a store."""
    return path.is_dir() and (path / EVENTS).exists()


def import_judgements(
    path: Path, store: Store[Any], which: Which | None = None, layout: Layout | None = None
) -> Imported:
    """Read a file of judgements (`read_judgements` says which), or a bundle, into a store, all or none.

    A second reading changes nothing. Raises `ValueError` for what is wrong in the file, and `StoreError` where the
    store holds another judgement of the same query by a labeler of the same name.
    """
    if is_bundle(path):
        _refuse_choice(path, which)
        return Imported(import_bundle(path, store))
    checked, count = check_file(path, which, layout), 0
    with store.log.transaction() as tx:
        for some in chunks(checked.rows(), CHUNK):
            _check(path, store, tx.connection, some)
            _put(store, tx, some)
            count += len(some)
    return Imported(count, checked.notes)


def try_import(
    path: Path, store: Store[Any] | None, which: Which | None = None, layout: Layout | None = None
) -> Imported:
    """What `import_judgements` would do, by the same checks, with nothing written. A store may be open for reading."""
    if is_bundle(path):
        _refuse_choice(path, which)
        with tempfile.TemporaryDirectory() as scratch, Store[Any](Path(scratch)) as empty:
            return Imported(import_bundle(path, empty))
    checked, count = check_file(path, which, layout), 0
    for some in chunks(checked.rows(), CHUNK):
        if store is not None:
            with store.log.reading() as connection:
                _check(path, store, connection, some)
        count += len(some)
    return Imported(count, checked.notes)


def _refuse_choice(path: Path, which: Which | None) -> None:
    if which and (which.labelers or which.split):
        raise ValueError(f"{path}: a bundle is read whole; choose labelers when you fit")


def _check(path: Path, store: Store[Any], connection: sql.Connection, some: Sequence[Row]) -> None:
    """Raise `StoreError` where answers do not fit what a store holds."""
    held = connection.scalar(sql.select(event.c.body).where(event.c.kind == "candidate").limit(1))
    if held is not None and (kind := describe(some[0].query.candidates[0])["type"]) != held["type"]:
        raise StoreError(f"{store.folder} holds {held['type']}s, and cannot hold the {kind}s of {path}")
    answers = {(one.answer.query, one.answer.labeler): one.answer for one in some}
    there = {word["seq"] for word in words(connection, answers).values() if word["kind"] != RETRACTED}
    for one in connection.execute(sql.select(event).where(event.c.seq.in_(there))):
        stands = read_answer(one.kind, one.subject, one.actor, one.body)
        if answers[one.subject, one.actor] != stands:
            who = f"{one.actor!r} has judged query {one.subject[:12]} otherwise before: {stands}"
            raise StoreError(f"{path}: {who}")


def _put(store: Store[Any], tx: Transaction, some: Sequence[Row]) -> None:
    """Write answers with their queries in a transaction; arrays first, since a file cannot be undone but be unused."""
    candidates: dict[str, Candidate] = {c.id: c for one in some for c in one.query.candidates}
    for id, candidate in candidates.items():
        if isinstance(candidate, Segment):
            arrays = {"observations": candidate.observations, "actions": candidate.actions, "states": candidate.states}
            write_arrays(store.folder / "blobs", id, {k: v for k, v in arrays.items() if v is not None})
    tx.extend([row(id, "candidate", body=describe(candidate)) for id, candidate in candidates.items()])
    asked = {one.query.id: [c.id for c in one.query.candidates] for one in some}
    tx.extend([row(id, "query", body={"candidates": ids, "batch": tx.seq}) for id, ids in asked.items()])
    store.put_all(tx, [one.answer for one in some])


def import_bundle(path: Path, store: Store[Any]) -> int:
    """Read a folder that `export_bundle` wrote, all or none; what the store has already is left alone."""
    refuse_links(path)
    _check_names(path)
    verify(path)
    return store.merge(_events(path / EVENTS), path / "blobs")


def _check_names(path: Path) -> None:
    """Raise `ValueError` unless the manifest names the events, and nothing outside the folder."""
    try:
        names = json.loads((path / MANIFEST).read_text())
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} is no whole bundle: {MANIFEST} cannot be read: {error}") from None
    if not isinstance(names, dict) or EVENTS not in names:
        raise ValueError(f"{path} is no whole bundle: {MANIFEST} does not name {EVENTS}")
    for name in names:
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts or "\\" in name:
            raise ValueError(f"{path}: {MANIFEST} names {name!r}, which lies outside: refused")


def _events(path: Path) -> Iterator[dict[str, Any]]:
    for number, line in enumerate(read_lines(path), 1):
        try:
            one = parse_json(line)
            yield {name: one[name] for name in FIELDS}
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path}: row {number} is no event: {error!r}") from None


__all__ = [
    "EXPORTS",
    "Exported",
    "Imported",
    "export",
    "export_bundle",
    "export_preferences",
    "import_bundle",
    "import_judgements",
    "is_bundle",
    "try_import",
]
