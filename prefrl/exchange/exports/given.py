"""The answers of a store, one after another, and a tally of what a form cannot hold of them."""

from __future__ import annotations

import gzip
import json
import os
import uuid
from collections import Counter
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, NamedTuple

import sqlalchemy as sql

from prefrl.judgements import Answer, columns, is_pairwise, is_soft
from prefrl.kinds import kind_of, only
from prefrl.storage.events import load_candidate, read_answer
from prefrl.storage.files import make_folder, sync_folder
from prefrl.storage.log import StoreError
from prefrl.storage.projection import CHUNK, OPINIONS, all_events, bodies, chunks, words
from prefrl.storage.tables import event, standing
from prefrl.storage.tables import query as asked
from prefrl.store import Store
from prefrl.types import Fields, Json, Query, Response

LABELER = "annotator's name"
ORDER = "order in which candidates were shown"
TIME = "time of an answer"
WEIGHT = "weight of a judgement, other than 1"
STRENGTH = "strength of a preference"
ABOUT = "note on how an answer came about"
TIE = "tie"
INCOMPARABLE = "query called incomparable"
SKIP = "skipped query"
WHOLE = "ranking, choice or rating as a whole (its pairs are written)"
TOKENS = "response's tokens"
OF_EVENTS = {
    "demonstration": "demonstration",
    "retract": "answer that was taken back",
    "assign": "assignment",
    "repeat": "repeated answer",
    "flag": "report of a problem",
    "guideline": "guideline",
}
"""Events that are no judgements and no skips, as they are called in a tally."""
CHECK = "check question"


class Given(NamedTuple):
    """An answer that stands, with what was asked."""

    at: str
    answer: Answer
    query: Query
    about: Fields


@dataclass(frozen=True)
class Exported:
    """What a file got, and what it could not hold."""

    written: int
    dropped: Mapping[str, int] = field(default_factory=dict)
    """What was left out, and how often."""
    notes: tuple[str, ...] = ()
    """What else to know of the file, for people."""


def each_answer(store: Store) -> Iterator[Given]:
    """Every judgement and skip that stands, oldest first, those to check questions not; few in memory at a time."""
    with store.log.reading() as connection:
        for some in _standing(connection):
            queries = stored_queries(connection, {e["subject"] for e in some}, store.folder / "blobs")
            for e in some:
                answer = read_answer(e["kind"], e["subject"], e["actor"], e["body"])
                yield Given(e["at"], answer, queries[e["subject"]], e["body"].get("about") or {})


def each_query(store: Store) -> Iterator[list[Given]]:
    """The answers to each query that stand, in the order in which the queries were first answered; few in memory."""
    seen = set[str]()
    with store.log.reading() as connection:
        for some in _standing(connection):
            new = [id for id in dict.fromkeys(e["subject"] for e in some) if id not in seen]
            seen.update(new)
            queries = stored_queries(connection, new, store.folder / "blobs")
            found: dict[str, list[Given]] = {id: [] for id in new}
            for e in _answers_to(connection, new):
                answer = read_answer(e.kind, e.subject, e.actor, e.body)
                found[e.subject].append(Given(e.at, answer, queries[e.subject], e.body.get("about") or {}))
            yield from found.values()


def _answers_to(connection: sql.Connection, ids: Collection[str]) -> Iterator[sql.Row[Any]]:
    """The events of the answers to some queries that stand, oldest first."""
    some = sql.select(event).join(standing, standing.c.seq == event.c.seq).where(standing.c.query.in_(ids))
    yield from connection.execute(some.where(event.c.kind.in_(OPINIONS)).order_by(event.c.seq))


def knows_strengths(store: Store) -> bool:
    """Whether any preference is neither a tie nor a certainty."""
    with store.log.reading() as connection:
        found = (e for some in _standing(connection) for e in some)
        return any(is_soft(read_answer(e["kind"], e["subject"], e["actor"], e["body"])) for e in found)


def _standing(connection: sql.Connection) -> Iterator[list[Json]]:
    """The events of answers that stand, some at a time."""
    for some in chunks((e for e in all_events(connection) if e["kind"] in OPINIONS), CHUNK):
        newest = words(connection, [(e["subject"], e["actor"]) for e in some])
        label = sql.select(asked.c.id).where(asked.c.id.in_({e["subject"] for e in some}), asked.c.purpose == "label")
        labels = set(connection.scalars(label))
        yield [e for e in some if newest[e["subject"], e["actor"]]["seq"] == e["seq"] and e["subject"] in labels]


def stored_queries(connection: sql.Connection, ids: Collection[str], blobs: Path) -> dict[str, Query]:
    """Queries by id. Not the store's own, which keeps all that it was ever asked for."""
    queries = bodies(connection, ids)
    found = bodies(connection, {c for body in queries.values() for c in body["candidates"]})
    candidates = {id: load_candidate(id, body, blobs) for id, body in found.items()}
    return {id: Query(tuple(candidates[c] for c in body["candidates"])) for id, body in queries.items()}


def refuse_segments(given: Given, form: str) -> None:
    """Raise `StoreError` where a form for texts would have to hold segments, or pictures."""
    kind = kind_of(given.query.candidates[0])
    forms = " or ".join(kind.exports)
    error = StoreError(f"judgements of {kind.noun}s do not fit the form {form!r}; use --form {forms}")
    only(Response, given.query.candidates, error)


@dataclass
class Tally:
    """What a form leaves out, counted."""

    holds: Collection[str] = ()
    """What the form holds of an answer."""
    dropped: Counter[str] = field(default_factory=Counter)

    def note(self, given: Given) -> None:
        """Count what of an answer has no place in the form."""
        answer = given.answer
        weight = answer.weight if answer.reason is None else 1.0
        has = {
            LABELER: bool(answer.labeler),
            ORDER: bool(answer.shown),
            TIME: True,
            WEIGHT: weight != 1.0,
            STRENGTH: is_soft(answer),
            ABOUT: bool(given.about),
            TOKENS: any(kind_of(c).tokens(c) for c in given.query.candidates),
            WHOLE: not is_pairwise(answer),
        }
        self.dropped.update(name for name, there in has.items() if there and name not in self.holds)

    def skip(self, reason: str) -> None:
        """Count a skip that has no place in the form."""
        self.dropped[INCOMPARABLE if reason == "incomparable" else SKIP] += 1

    def done(self, store: Store, written: int, *notes: str) -> Exported:
        """The tally, with what the store holds beside answers."""
        with store.log.reading() as connection:
            kinds = sql.select(event.c.kind, sql.func.count()).where(event.c.kind.in_(OF_EVENTS)).group_by(event.c.kind)
            for kind, count in connection.execute(kinds):
                self.dropped[OF_EVENTS[kind]] += count
            checks = sql.select(sql.func.count()).where(asked.c.purpose == "check")
            self.dropped[CHECK] += connection.scalar(checks) or 0
        return Exported(written, {name: count for name, count in self.dropped.items() if count}, notes)


def told(given: Given) -> Json:
    """The answer, and by whom, when and how it was given, as columns of a row."""
    answer = given.answer
    weight = {"weight": answer.weight} if answer.reason is None else {}
    return columns(answer) | {"labeler": answer.labeler, "shown": list(answer.shown)} | weight | {"at": given.at}


def json_text(value: Any) -> str:
    """JSON on one line, readable in any language; escaped where the text is no valid Unicode."""
    text = json.dumps(value, ensure_ascii=False, allow_nan=False)
    try:
        text.encode()
    except UnicodeEncodeError:
        text = json.dumps(value, allow_nan=False)
    return text


@contextmanager
def whole_file(path: Path) -> Iterator[IO[bytes]]:
    """A file to be written piece by piece, .gz or not, that takes its name when all is there, or never."""
    make_folder(path.parent)
    work = path.parent / f".{path.name}-{uuid.uuid4().hex[:12]}"
    try:
        with os.fdopen(os.open(work, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666), "wb") as file:
            if path.suffix == ".gz":
                with gzip.GzipFile("", "wb", fileobj=file, mtime=0) as packed:
                    yield packed  # type: ignore[misc]
            else:
                yield file
            file.flush()
            os.fsync(file.fileno())
        os.replace(work, path)
    except BaseException:
        work.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def write_lines(path: Path, rows: Iterator[Fields]) -> int:
    """Write one JSON object a line; returns how many."""
    count = 0
    with whole_file(path) as file:
        for row in rows:
            file.write(f"{json_text(row)}\n".encode())
            count += 1
    return count


def write_list(path: Path, rows: Iterator[Fields]) -> int:
    """Write one JSON list, an element a line; returns how many."""
    count = 0
    with whole_file(path) as file:
        file.write(b"[")
        for row in rows:
            file.write(f"{',' if count else ''}\n{json_text(row)}".encode())
            count += 1
        file.write(b"\n]\n")
    return count
