"""Judgements ready to be read, wherever they lie: in the store of a folder, or in a file."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from prefrl.exchange.bundles import is_bundle
from prefrl.exchange.formats import read_judgements
from prefrl.exchange.layout import Which
from prefrl.exchange.ports import import_judgements
from prefrl.judgements import Demonstrated, Judged, person
from prefrl.kinds import kind_of
from prefrl.protocols import Judgements
from prefrl.storage.files import DamagedError
from prefrl.storage.projection import ANSWERS
from prefrl.store import Store
from prefrl.types import Floats, Json, Query


@dataclass(frozen=True)
class InMemory:
    """A `prefrl.protocols.Judgements` of a file: all of them there, and nothing beside them."""

    of_file: tuple[Judged, ...]

    @property
    def sequence(self) -> int:
        return len(self.of_file)

    def judged(self, upto: int | None = None) -> list[Judged]:
        return list(self.of_file[:upto])

    def demonstrations(self, upto: int | None = None) -> list[Demonstrated]:
        return []

    def open_queries(self, labeler: str = "") -> list[Query]:
        return []

    def gold(self, candidates: Sequence[Any]) -> list[Floats]:
        raise DamagedError("a file of judgements holds no gold") from FileNotFoundError()


class Opened(NamedTuple):
    """Judgements, ready to be read."""

    store: Judgements
    notes: tuple[str, ...]
    """What was left out of a file, for people."""


@contextmanager
def open_judgements(source: Path, task: Any, which: Which | None = None) -> Iterator[Opened]:
    """The store of a folder, or what a file holds; to be read only. A part of a store, or a bundle, gets a store of its
    own for the time.

    `which` leaves out the other labelers' judgements, and the other parts of a file. Raises `ValueError` where nothing
    is left, or where candidates do not fit the task.
    """
    with ExitStack() as stack:
        if source.is_dir() and not (which and (which.labelers or which.split)):
            opened = Opened(stack.enter_context(Store(source, write=False)), ())
        elif not source.is_dir() and not is_bundle(source):
            read = read_judgements(source, which)
            opened = Opened(InMemory(read.judged), read.notes)
        else:
            # Entered first, so removed last: the store in it is closed by then.
            scratch = Path(stack.enter_context(tempfile.TemporaryDirectory()))
            opened = _chosen(source, stack.enter_context(Store(scratch)), which)
        check_candidates(opened.store.judged(), task)
        yield opened


def _chosen(source: Path, store: Store, which: Which | None) -> Opened:
    """Fill an empty store with what is chosen of a folder's store or of a file."""
    if which is None or not source.is_dir():
        return Opened(store, import_judgements(source, store, which).notes)
    if which.split:
        raise ValueError(f"{source} is a store, which knows no split: give a file, or leave the split out")
    with Store(source, write=False) as whole:
        names = {e["actor"] for e in whole.events() if e["kind"] in ANSWERS}
        if not any(map(which.takes, names)):
            known = ", ".join(sorted(set(map(person, names)) - {""})) or "none"
            raise ValueError(f"{source}: no judgement by {', '.join(which.labelers)}; labelers there: {known}")
        store.merge(lambda: _events(whole, which), source / "blobs")
    return Opened(store, ())


def _events(store: Store, which: Which) -> Iterator[Json]:
    """What was asked, and what those have said of it who are wanted."""
    for one in store.events():
        said = one["kind"] in (*ANSWERS, "retract") and which.takes(one["actor"])
        if said or one["kind"] in ("candidate", "query"):
            yield one


def check_candidates(judged: Sequence[Judged], task: Any) -> None:
    """Raise `ValueError` unless all candidates are of the task's kind, and as its behaviours are."""
    for candidate in (c for one in judged for c in one.query.candidates):
        kind = kind_of(candidate)
        if kind.name != task.kind:
            raise ValueError(
                f"the judgements are of {kind.noun}s, but {task.name} is a task of kind {task.kind!r}: choose another "
                "config"
            )
        if misfit := kind.misfit(candidate, task):
            raise ValueError(f"{kind.noun} {candidate.id[:12]} {misfit}: choose another config")
