"""From the log to the derived tables: the one place that says what an event means for them.

The same function follows the log as it grows and writes the tables again from its start, so they cannot disagree.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import cache
from typing import Any

import sqlalchemy as sql
from sqlalchemy import Connection
from sqlalchemy.dialects import postgresql, sqlite

from prefrl.storage.tables import (
    DERIVED,
    annotator,
    assignment,
    canonical,
    event,
    query,
    setting,
    standing,
    submission,
    token,
)
from prefrl.types import Fields, Json

JUDGEMENTS = ("comparison", "ranking", "choice", "rating")
OPINIONS = (*JUDGEMENTS, "skip")
"""Answers that say something of the candidates asked about, or that nothing can be said."""
ANSWERS = (*JUDGEMENTS, "demonstration", "skip")
RETRACTED = "retracted"
CHUNK = 400
"""Keys in one statement: databases limit the number of parameters."""
Event = Fields
# Statements are built once: building one costs more than running it.
_WORD = sql.select(standing).where(
    standing.c.query == sql.bindparam("b_query"), standing.c.labeler == sql.bindparam("b_labeler")
)
_COUNT = (
    sql.update(query)
    .where(query.c.id == sql.bindparam("b_id"))
    .values({name: query.c[name] + sql.bindparam(f"b_{name}") for name in ("judged", "incomparable", "skipped")})
)
_ANSWERED = (
    sql.update(assignment).where(assignment.c.id == sql.bindparam("b_id")).values(answered=sql.bindparam("b_seq"))
)


def project(connection: Connection, events: Sequence[Event]) -> None:
    """Bring the derived tables up to date with events that were just appended, oldest first."""
    # Kind by kind, for the sake of few statements: assignments and queries first, since answers are noted at them.
    for one in events:
        if one["kind"] not in (*ANSWERS, "retract", "candidate", "query"):
            _OTHERS[one["kind"]](connection, one)
    asked = [_asked(one) for one in events if one["kind"] == "query"]
    if asked:
        connection.execute(sql.insert(query), asked)
    _answer(connection, [one for one in events if one["kind"] in (*ANSWERS, "retract")])
    sent = [(one, one["body"].get("about") or {}) for one in events if one["kind"] not in ("candidate", "query")]
    submitted = [
        {"id": about["submission"], "seq": one["seq"], "digest": about.get("digest", "")}
        for one, about in sent
        if "submission" in about
    ]
    if submitted:
        _upsert(connection, submission, submitted)


def rebuild(connection: Connection) -> None:
    """Drop the derived tables, and write them again from the log."""
    for table in DERIVED:
        table.drop(connection, checkfirst=True)
        table.create(connection)
    for some in chunks(all_events(connection), 5000):
        project(connection, some)


def dump(connection: Connection) -> Iterator[str]:
    """Every row of the derived tables as one line of JSON each, in the order of their keys."""
    plain = connection.dialect.name == "postgresql"  # its order of texts hangs on the server's language otherwise
    for table in DERIVED:
        keys = [sql.collate(column, "C") if plain else column for column in table.primary_key]
        for row in connection.execute(sql.select(table).order_by(*keys)):
            yield canonical([table.name, *row])


def all_events(connection: Connection, after: int = 0) -> Iterator[Json]:
    """The events after a number, oldest first, a few thousand in memory at a time."""
    while True:
        # By number: an offset would count through all the rows before it, each time.
        some = sql.select(event).where(event.c.seq > after).order_by(event.c.seq).limit(5000)
        found = [dict(row._mapping) for row in connection.execute(some)]
        if not found:
            return
        yield from found
        after = found[-1]["seq"]


def chunks(items: Iterable[Any], size: int) -> Iterator[list[Any]]:
    """Lists of at most `size`."""
    some: list[Any] = []
    for item in items:
        some.append(item)
        if len(some) == size:
            yield some
            some = []
    if some:
        yield some


def bodies(connection: Connection, ids: Iterable[str]) -> dict[str, Json]:
    """What was said of queries and candidates when they were asked, by id; those that nobody asked are missing."""
    found: dict[str, Json] = {}
    for some in chunks(dict.fromkeys(ids), CHUNK):
        chosen = event.c.id.in_(some) & event.c.kind.in_(("query", "candidate"))
        found |= {one.id: one.body for one in connection.execute(sql.select(event.c.id, event.c.body).where(chosen))}
    return found


def words(connection: Connection, keys: Iterable[tuple[str, str]]) -> dict[tuple[str, str], Json]:
    """(query, labeler) -> the newest word there, for those that have said any."""
    found: dict[tuple[str, str], Json] = {}
    for some in chunks(dict.fromkeys(keys), CHUNK):
        if len(some) == 1:
            rows = connection.execute(_WORD, {"b_query": some[0][0], "b_labeler": some[0][1]})
        else:
            pairs = sql.tuple_(standing.c.query, standing.c.labeler)
            rows = connection.execute(sql.select(standing).where(pairs.in_(some)))
        found |= {(row.query, row.labeler): dict(row._mapping) for row in rows}
    return found


def _asked(one: Event) -> Json:
    body = one["body"]
    return {
        "id": one["id"],
        "seq": one["seq"],
        "batch": body.get("batch", 0),
        "size": len(body["candidates"]),
        "purpose": body.get("purpose", "label"),
        "expected": body.get("expected"),
        "judged": 0,
        "incomparable": 0,
        "skipped": 0,
    }


def _answer(connection: Connection, events: Sequence[Event]) -> None:
    """Answers and retractions: whose word stands, how many there are on each query, which assignments are done."""
    if not events:
        return
    there = words(connection, ((one["subject"], one["actor"]) for one in events))
    counts: dict[str, Json] = {}
    for one in events:
        key = one["subject"], one["actor"]
        old = there.get(key)
        kind = RETRACTED if one["kind"] == "retract" else _sort(one)
        revision = (old["revision"] if old else 0) + (one["kind"] == "retract")
        # Several words on one query may come together: the next one must see what this one left.
        there[key] = {"query": key[0], "labeler": key[1], "seq": one["seq"], "kind": kind, "revision": revision}
        change = counts.setdefault(key[0], {"b_id": key[0], "b_judged": 0, "b_incomparable": 0, "b_skipped": 0})
        for column, by in ((_column(old["kind"]) if old else None, -1), (_column(kind), 1)):
            if column:
                change[f"b_{column}"] += by
        _mark(connection, one, None if one["kind"] == "retract" else one["seq"])
    _upsert(connection, standing, list(there.values()))
    connection.execute(_COUNT, list(counts.values()))


def _sort(one: Event) -> str:
    """A judgement's kind, or the reason of a skip."""
    return str(one["body"].get("reason", "skip")) if one["kind"] == "skip" else str(one["kind"])


def _column(kind: str) -> str | None:
    """The count that an answer of a kind stands in."""
    if kind in JUDGEMENTS or kind == "demonstration":
        return "judged"
    return {"skip": "skipped", "incomparable": "incomparable"}.get(kind)


def _mark(connection: Connection, one: Event, seq: int | None) -> None:
    """Note at the assignment, if there is one, that it is answered, or open again."""
    id = (one["body"].get("about") or {}).get("assignment")
    if id is not None:
        connection.execute(_ANSWERED, {"b_id": id, "b_seq": seq})


def _assign(connection: Connection, one: Event) -> None:
    body = one["body"]
    given = {"id": one["id"], "seq": one["seq"], "query": one["subject"], "annotator": one["actor"]}
    how = {"purpose": body["purpose"], "shown": canonical(body["shown"]), "guideline": body.get("guideline", "")}
    connection.execute(sql.insert(assignment), [given | how | {"answered": None}])


def _repeat(connection: Connection, one: Event) -> None:
    _mark(connection, one, one["seq"])


def _person(connection: Connection, one: Event) -> None:
    row = {"name": one["actor"], "role": one["body"]["role"], "state": "active", "seq": one["seq"]}
    _upsert(connection, annotator, [row])


def _state(connection: Connection, one: Event) -> None:
    state = one["body"]["state"]
    connection.execute(sql.update(annotator).where(annotator.c.name == one["actor"]).values(state=state))
    if state == "revoked":
        connection.execute(sql.update(token).where(token.c.annotator == one["actor"]).values(revoked=True))


def _token(connection: Connection, one: Event) -> None:
    row = {"hash": one["id"].removeprefix("token:"), "annotator": one["actor"], "use": one["body"]["use"]}
    connection.execute(sql.insert(token), [row | {"revoked": False}])


def _revoke(connection: Connection, one: Event) -> None:
    connection.execute(sql.update(token).where(token.c.hash == one["subject"]).values(revoked=True))


def _set(connection: Connection, one: Event) -> None:
    values = one["body"] if one["kind"] == "project" else {"guideline": one["body"]["text"]}
    _upsert(connection, setting, [{"key": key, "value": canonical(value)} for key, value in values.items()])


def _nothing(connection: Connection, one: Event) -> None:
    """Kept in the log, and derived to nothing."""


_OTHERS: dict[str, Callable[[Connection, Event], None]] = {
    "assign": _assign,
    "repeat": _repeat,
    "annotator": _person,
    "state": _state,
    "token": _token,
    "revoke": _revoke,
    "guideline": _set,
    "project": _set,
    "flag": _nothing,
}
KINDS = ("candidate", "query", *ANSWERS, "retract", *_OTHERS)
"""Every kind of event."""


def _upsert(connection: Connection, table: sql.Table, rows: list[Json]) -> None:
    """Insert rows, or replace those of the same key."""
    connection.execute(_upsertion(connection.dialect.name, table), rows)


@cache
def _upsertion(dialect: str, table: sql.Table) -> sql.Insert:
    insert: Any = (postgresql if dialect == "postgresql" else sqlite).insert(table)
    keys = [column.name for column in table.primary_key]
    fresh = {column.name: insert.excluded[column.name] for column in table.columns if column.name not in keys}
    made: sql.Insert = insert.on_conflict_do_update(index_elements=keys, set_=fresh)
    return made
