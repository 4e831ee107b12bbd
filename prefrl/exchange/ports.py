"""Judgements in and out of files: the forms that the field uses, and a bundle that loses nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import sqlalchemy as sql

from prefrl.exchange.bundles import export_bundle, import_bundle, is_bundle, try_bundle
from prefrl.exchange.exports.behaviour import export_behaviour
from prefrl.exchange.exports.dataset import export_dataset
from prefrl.exchange.exports.given import Exported
from prefrl.exchange.exports.minari import export_minari
from prefrl.exchange.exports.pickapic import export_pickapic
from prefrl.exchange.exports.rows import (
    export_demonstrations,
    export_judgements,
    export_preferences,
    export_unpaired,
)
from prefrl.exchange.exports.table import export_csv
from prefrl.exchange.exports.tools import export_arena, export_argilla, export_label_studio
from prefrl.exchange.formats import check_file
from prefrl.exchange.layout import Layout, Row, Which
from prefrl.exchange.recognition import recognised
from prefrl.judgements import Answer
from prefrl.kinds import logged
from prefrl.storage.arrivals import Against, otherwise
from prefrl.storage.events import describe, read_answer, write_candidate
from prefrl.storage.log import StoreError, Transaction, row
from prefrl.storage.projection import CHUNK, RETRACTED, chunks, words
from prefrl.storage.tables import event
from prefrl.store import Store
from prefrl.types import Candidate


@dataclass(frozen=True)
class Imported:
    """How many answers a file held, and what was left out of it."""

    read: int
    notes: tuple[str, ...] = ()
    known: int = 0
    """How many of them the store had already."""


# --- out ----------------------------------------------------------------------------------------------------------


EXPORTS: Mapping[str, Callable[[Store, Path, str], Exported]] = {
    "preferences": lambda store, path, ties: export_preferences(store, path, ties),
    "conversational": lambda store, path, ties: export_preferences(store, path, ties, conversational=True),
    "unpaired": lambda store, path, _: export_unpaired(store, path),
    "unpaired-conversational": lambda store, path, _: export_unpaired(store, path, conversational=True),
    "demonstrations": lambda store, path, _: _export_shown(store, path),
    "judgements": lambda store, path, _: export_judgements(store, path),
    "dataset": lambda store, path, _: export_dataset(store, path),
    "argilla": lambda store, path, _: export_argilla(store, path),
    "label-studio": lambda store, path, _: export_label_studio(store, path),
    "arena": lambda store, path, _: export_arena(store, path),
    "csv": lambda store, path, _: export_csv(store, path),
    "minari": lambda store, path, _: export_minari(store, path),
    "pick-a-pic": lambda store, path, _: export_pickapic(store, path),
    "bundle": lambda store, path, _: export_bundle(store, path),
}
"""What writes each form; the text says what becomes of ties, where a form has none: "drop" or "both"."""


def export(store: Store, path: Path, form: str = "preferences", ties: str = "drop") -> Exported:
    """Write the answers of a store to a file or a folder, whole or not at all."""
    if ties != "drop" and form not in ("preferences", "conversational"):
        raise ValueError(f"ties={ties!r} is for preferences and conversational; the form {form!r} has its own way")
    return EXPORTS[form](store, path, ties)


def _export_shown(store: Store, path: Path) -> Exported:
    """Behaviour that goes step by step is arrays, and any other is rows."""
    steps = bool(store.holds) and logged(store.holds).stepwise
    return export_behaviour(store, path) if steps else export_demonstrations(store, path)


# --- in -----------------------------------------------------------------------------------------------------------


def import_judgements(path: Path, store: Store, which: Which | None = None, layout: Layout | None = None) -> Imported:
    """Read a file of answers (`read_judgements` says which), or a bundle, into a store, all or none.

    A second reading changes nothing. Raises `ValueError` for what is wrong in the file, and `StoreError` where the
    store holds another judgement of the same query by a labeler of the same name.
    """
    if is_bundle(path):
        _refuse_choice(path, which, layout)
        read, known = import_bundle(path, store)
        return Imported(read, (), known)
    checked, arrived = check_file(path, which, layout), _Arrived(path, store)
    with store.log.transaction() as tx:
        for some in chunks(checked.rows(), CHUNK):
            new = arrived.compare(tx.connection, some)
            if not arrived.against.count:
                _put(store, tx, new)
        arrived.against.refuse(path)
    return Imported(arrived.read, checked.notes, arrived.known)


def try_import(path: Path, store: Store | None, which: Which | None = None, layout: Layout | None = None) -> Imported:
    """What `import_judgements` would do, by the same checks, with nothing written. A store may be open for reading."""
    if is_bundle(path):
        _refuse_choice(path, which, layout)
        read, known = try_bundle(path, store)
        return Imported(read, (), known)
    checked = check_file(path, which, layout)
    if store is None:
        return Imported(sum(1 for _ in checked.rows()), checked.notes)
    arrived = _Arrived(path, store)
    with store.log.reading() as connection:
        for some in chunks(checked.rows(), CHUNK):
            arrived.compare(connection, some)
    arrived.against.refuse(path)
    return Imported(arrived.read, checked.notes, arrived.known)


def _refuse_choice(path: Path, which: Which | None, layout: Layout | None) -> None:
    """A bundle is read whole, or not at all."""
    if which and (which.labelers or which.split):
        raise ValueError(f"{path}: a bundle is read whole; choose labelers when you fit")
    if layout and layout != Layout():
        raise ValueError(f"{path}: a bundle is read whole, as it is: --form, --map and --skip-bad are for other files")


class _Arrived:
    """Rows of a file beside what a store holds."""

    def __init__(self, path: Path, store: Store) -> None:
        self.path, self.store = path, store
        self.read = self.known = 0
        self.against = Against()

    def compare(self, connection: sql.Connection, some: Sequence[Row]) -> list[Row]:
        """The rows as answers to the store's own queries where they come from these."""
        self._check_kind(connection, some[0])
        found = recognised(connection, some, self.store.folder / "blobs")
        answers = {(one.answer.query, one.answer.labeler): one.answer for one in found}
        there = list(_standing(connection, answers))
        self.against.add(otherwise(answers[stands.query, stands.labeler], stands) for stands in there)
        self.read, self.known = self.read + len(found), self.known + len(there)
        return found

    def _check_kind(self, connection: sql.Connection, first: Row) -> None:
        """Raise `StoreError` where the store's candidates are of another kind."""
        held = connection.scalar(sql.select(event.c.body).where(event.c.kind == "candidate").limit(1))
        if held is not None and (kind := describe(first.query.candidates[0])["type"]) != held["type"]:
            raise StoreError(f"{self.store.folder} holds {held['type']}s, and cannot hold the {kind}s of {self.path}")


def _standing(connection: sql.Connection, answers: Mapping[tuple[str, str], Answer]) -> Iterator[Answer]:
    """What stands in a store of the same labelers on the same queries."""
    there = {word["seq"] for word in words(connection, answers).values() if word["kind"] != RETRACTED}
    for one in connection.execute(sql.select(event).where(event.c.seq.in_(there))):
        yield read_answer(one.kind, one.subject, one.actor, one.body)


def _put(store: Store, tx: Transaction, some: Sequence[Row]) -> None:
    """Write answers with their queries in a transaction; arrays first, since a file cannot be undone but be unused."""
    candidates: dict[str, Candidate] = {c.id: c for one in some for c in one.query.candidates}
    for candidate in candidates.values():
        write_candidate(candidate, store.folder / "blobs")
    tx.extend([row(id, "candidate", body=describe(candidate)) for id, candidate in candidates.items()])
    asked = {one.query.id: [c.id for c in one.query.candidates] for one in some}
    tx.extend([row(id, "query", body={"candidates": ids, "batch": tx.seq}) for id, ids in asked.items()])
    store.put_all(tx, [one.answer for one in some])


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
