"""Events of another store: whether they may be believed, and whether they agree with what a store holds already.

They are read one after another. Of each no more is kept than what later ones speak of, so that a store of any size can
be looked through.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import sqlalchemy as sql
from sqlalchemy import Connection

from prefrl.judgements import Answer, Demonstration, same
from prefrl.storage.engines import StoreError
from prefrl.storage.events import (
    check_answer,
    check_assignment,
    check_event,
    check_purpose,
    load_foreign,
    read_answer,
)
from prefrl.storage.projection import ANSWERS, CHUNK, chunks
from prefrl.storage.tables import event
from prefrl.types import Fields, Query

SHOWN = 20
"""How many contradictions are told."""
WRONG = (ValueError, KeyError, TypeError, AttributeError, OverflowError)
"""What comes of an event that is not as events are."""
Event = Fields


class Merged(NamedTuple):
    """What of another store's answers is new."""

    read: int
    """How many answers it holds, those among them that were taken back."""
    known: int = 0
    """How many of them were here already."""


class _Candidate(NamedTuple):
    """What a query asks of a candidate."""

    id: str
    context: bytes


@dataclass
class _Arrivals:
    """What the events so far have said."""

    blobs: Path
    kind: str = ""
    """What the candidates are, once there is one."""
    candidates: dict[str, _Candidate] = field(default_factory=dict)
    sizes: dict[str, int] = field(default_factory=dict)
    """Query -> how many candidates it has."""
    contexts: dict[str, bytes] = field(default_factory=dict)
    """The same of those that have one, which a demonstration may answer -> the context of that one."""
    words: dict[bytes, int] = field(default_factory=dict)
    """(query, labeler) -> answers and retractions so far, which take turns."""

    def take(self, one: Event) -> None:
        """Check the next event against those before it. Raises one of `WRONG` for one that cannot be believed."""
        check_event(one)
        body, kind = one["body"], one["kind"]
        if kind == "candidate":
            self._candidate(one)
        elif kind == "query":
            self.sizes[one["id"]] = self._query(one["id"], body)
        elif kind == "guideline" or (kind == "flag" and not one["subject"]):
            return
        elif one["subject"] not in self.sizes:
            raise StoreError(f"it speaks of query {one['subject'][:12]}, which is not there")
        elif kind == "assign":
            check_assignment(body, self.sizes[one["subject"]])
        elif kind == "repeat":
            said = {name: value for name, value in body["answer"].items() if name != "kind"}
            check_answer(_answer(one, body["answer"]["kind"], said), self.sizes[one["subject"]])
        elif kind != "flag":
            self._word(one)

    def _candidate(self, one: Event) -> None:
        loaded = load_foreign(one["id"], one["body"], self.blobs)
        self.kind = self.kind or one["body"]["type"]
        if one["body"]["type"] != self.kind:
            raise StoreError(f"a store that holds {self.kind}s cannot hold a {one['body']['type']} beside them")
        # A digest in place of a prompt, of which there may be millions; JSON can bring in halves of surrogate pairs.
        context = hashlib.sha256(loaded.context.encode("utf-8", "surrogatepass")).digest()
        self.candidates[one["id"]] = _Candidate(one["id"], context)

    def _context(self, id: str) -> bytes:
        if id not in self.candidates:
            raise StoreError(f"it shows candidate {id[:12]}, which is not there")
        return self.candidates[id].context

    def _query(self, id: str, body: Event) -> int:
        """How many candidates it has; they must be there, and make up its id."""
        query = Query[Any](tuple(self.candidates[c] for c in body["candidates"]))
        if query.id != id or [c.id for c in query.candidates] != body["candidates"]:
            raise StoreError(f"query {id[:12]} does not have the sha256 of its candidates")
        check_purpose(body, len(query.candidates))
        if len(query.candidates) == 1:
            self.contexts[id] = query.candidates[0].context
        return len(query.candidates)

    def _word(self, one: Event) -> None:
        """An answer, or one that was taken back: its id says how many came before it."""
        who = f"{one['subject']}:{one['actor']}"
        key = hashlib.sha256(who.encode()).digest()[:16]
        count = self.words.get(key, 0)
        expected = f"{who}:{count // 2}" + (":retract" if count % 2 else "")
        if one["id"] != expected or (one["kind"] == "retract") != bool(count % 2):
            raise StoreError(f"its id {one['id'][:20]} is not that of this labeler's next word on its query")
        if one["kind"] in ANSWERS:
            answer = _answer(one, one["kind"], one["body"])
            check_answer(answer, self.sizes[one["subject"]])
            if isinstance(answer, Demonstration) and self._context(answer.like) != self.contexts[answer.query]:
                raise StoreError(f"it answers query {answer.query[:12]} with a behaviour of another context")
        self.words[key] = count + 1


@dataclass
class Against:
    """What contradicts a store."""

    count: int = 0
    told: list[str] = field(default_factory=list)

    def add(self, faults: Iterable[str]) -> None:
        """Note faults; "" is none."""
        for fault in filter(None, faults):
            self.count += 1
            self.told += [fault] * (self.count <= SHOWN)

    def refuse(self, where: Path) -> None:
        """Raise `StoreError` where anything was noted: all is read, or nothing."""
        if self.count:
            more = [f"... and {self.count - SHOWN} more"] if self.count > SHOWN else []
            says = f"{where}: nothing was read, since it contradicts the store {self.count} times:"
            raise StoreError("\n".join([says, *self.told, *more]))


def check_arrivals(events: Iterable[Event], blobs: Path, connection: Connection | None = None) -> Merged:
    """Check another store's events, and their arrays, against each other and against what a store holds.

    Raises `ValueError` naming the first bad event, and `StoreError` with all that contradicts the store.
    """
    arrivals = _Arrivals(blobs, _kind(connection))
    against = Against()
    read = known = 0
    for some in chunks(enumerate(events, 1), CHUNK):
        for number, one in some:
            try:
                arrivals.take(one)
            except WRONG as error:
                raise ValueError(f"event {number} cannot be merged: {_words(error)}") from error
            read += one["kind"] in ANSWERS
        there = list(_known(connection, [one for _, one in some]))
        known += sum(one["kind"] in ANSWERS for one, _ in there)
        against.add(contradiction(one, here) for one, here in there)
    against.refuse(blobs.parent)
    return Merged(read, known)


def contradiction(one: Event, here: Event) -> str:
    """How an event differs from the one of the same id in the store, in what matters; "" where it does not."""
    if one["kind"] in ANSWERS and here["kind"] in ANSWERS:
        return otherwise(*(_answer(e, e["kind"], e["body"]) for e in (one, here)))
    if one["kind"] == here["kind"] == "query":
        purposes = [(e["body"].get("purpose", "label"), e["body"].get("expected")) for e in (one, here)]
        return "" if len(set(purposes)) == 1 else f"query {one['id'][:12]} is a check question on one side alone"
    if one["kind"] == here["kind"] and one["kind"] in ("candidate", "retract"):
        return ""  # their ids say all there is
    alike = all(one[name] == here[name] for name in ("kind", "subject", "actor", "body"))
    return "" if alike else f"event {one['id'][:40]!r} says something else than the one of this id in the store"


def otherwise(answer: Answer, stands: Answer) -> str:
    """That a labeler has judged a query otherwise before; "" where an answer says what stands, or less."""
    answer = answer if answer.shown else replace(answer, shown=stands.shown)
    if same(answer, stands):
        return ""
    return f"{stands.labeler!r} has judged query {stands.query[:12]} otherwise before: {stands}"


def _answer(one: Event, kind: str, body: Event) -> Answer:
    return read_answer(kind, one["subject"], one["actor"], dict(body))


def _words(error: Exception) -> str:
    return f"{error.args[0]!r} is missing" if isinstance(error, KeyError) and error.args else str(error)


def _kind(connection: Connection | None) -> str:
    """What the candidates of a store are; "" where it has none."""
    if connection is None:
        return ""
    some = connection.scalar(sql.select(event.c.body).where(event.c.kind == "candidate").limit(1))
    return str(some["type"]) if some else ""


def _known(connection: Connection | None, some: list[Event]) -> Iterable[tuple[Event, Event]]:
    """The events whose ids a store has, each with the one there."""
    if connection is None:
        return
    by_id = {one["id"]: one for one in some}
    columns = [event.c[name] for name in ("id", "kind", "subject", "actor", "body")]
    for here in connection.execute(sql.select(*columns).where(event.c.id.in_(list(by_id)))):
        yield by_id[here.id], dict(here._mapping)
