"""What the server reads from the store: questions for the desk, assignments, what was answered, what is shown."""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import sqlalchemy as sql
from sqlalchemy import Connection

from prefrl.page.api import HISTORY
from prefrl.page.desk import REMEMBERED
from prefrl.page.questions import BETWEEN, Given, Past, Question
from prefrl.page.security import Refused
from prefrl.storage.projection import ANSWERS, JUDGEMENTS, RETRACTED, bodies
from prefrl.storage.tables import assignment, event, query, setting, standing
from prefrl.types import Json

done = query.c.judged + query.c.incomparable
# Statements for each answer are built once: building one costs more than running it.
_DONE = sql.select(done).where(query.c.id == sql.bindparam("b_id"))
_GIVEN = sql.select(assignment).where(assignment.c.id == sql.bindparam("b_id"))


def enough(overlap: int) -> sql.ColumnElement[bool]:
    """Whether a query has all the answers it needs."""
    return done >= overlap


def questions(connection: Connection, overlap: int, after: int = 0) -> list[Question]:
    """Open queries and all check questions that were asked after an event, with who has seen each, oldest first."""
    wanted = (query.c.seq > after) & ((query.c.purpose == "check") | ~enough(overlap))
    return _questions(connection, wanted)


def question(connection: Connection, id: str) -> Question:
    """One query, open or not."""
    return _questions(connection, query.c.id == id)[0]


def _questions(connection: Connection, wanted: sql.ColumnElement[bool]) -> list[Question]:
    seen: dict[str, set[str]] = defaultdict(set)
    given = sql.select(assignment.c.query, assignment.c.annotator).join(query, query.c.id == assignment.c.query)
    waits = assignment.c.answered.is_(None)  # who has answered has said a word
    for id, name in connection.execute(given.where(wanted, waits, assignment.c.purpose != "repeat")).all():
        seen[id].add(name)
    silent, skipped = _silent(connection)
    # Of a million words, one text of names for each query, all from the index, takes a fifth of the time of the rows.
    all_names = sql.func.aggregate_strings(standing.c.labeler, BETWEEN)
    names = sql.select(all_names).where(standing.c.query == query.c.id).scalar_subquery()
    columns = *(query.c[name] for name in ("id", "seq", "batch", "size", "purpose")), done, sql.func.coalesce(names, "")
    found = [Question(*row) for row in connection.execute(sql.select(*columns).where(wanted).order_by(query.c.seq))]
    for one in found:
        if one.id in skipped:
            one.skipped = frozenset(skipped[one.id])
        if one.id in silent or one.id in seen:
            one.names = BETWEEN.join(({*one.names.split(BETWEEN)} - silent[one.id]) | seen[one.id])
    return found


def _silent(connection: Connection) -> tuple[dict[str, set[str]], dict[str, set[str]]]:
    """Of each query those whose word there says nothing (it was taken back, or nobody could be asked), and who skipped.

    Both are rare: they are found by the log's index of kinds.
    """
    silent, skipped = defaultdict[str, set[str]](set), defaultdict[str, set[str]](set)
    said = (standing.c.query == event.c.subject) & (standing.c.labeler == event.c.actor)
    columns = standing.c.query, standing.c.labeler, standing.c.kind
    some = sql.select(*columns).join(event, said & (standing.c.seq == event.c.seq))
    rare = event.c.kind.in_(("skip", "retract")), standing.c.kind.not_in((*JUDGEMENTS, "incomparable"))
    for id, name, kind in connection.execute(some.where(*rare)).all():
        (skipped if kind == "skip" else silent)[id].add(name)
    return silent, skipped


def closed(connection: Connection, overlap: int) -> int:
    """How many queries have all the answers they need."""
    return _count(connection, (query.c.purpose == "label") & enough(overlap))


def sizes(connection: Connection) -> list[int]:
    """How many candidates the queries that nobody has answered have, each number once."""
    waiting = sql.select(query.c.size).where(query.c.purpose == "label", done == 0)
    return sorted(connection.scalars(waiting.distinct()))


def judged(connection: Connection) -> tuple[int, int]:
    """How many queries were asked, and how many of them have any answer but a skip."""
    asked = query.c.purpose == "label"
    return _count(connection, asked), _count(connection, asked & (done > 0))


def answers_to(connection: Connection, id: str) -> int:
    """How many answers to a query stand, skips not among them."""
    return int(connection.scalar(_DONE, {"b_id": id}) or 0)


def unanswered(connection: Connection) -> list[Given]:
    """What was given to people and never answered, oldest first."""
    some = sql.select(assignment).where(assignment.c.answered.is_(None)).order_by(assignment.c.seq)
    return [_given(row) for row in connection.execute(some)]


def taken_back(connection: Connection) -> list[Given]:
    """Assignments whose answers were taken back, and that wait for others: the last that was taken back comes last.

    Not repetitions, of which the first answer stands until there is another.
    """
    word = (standing.c.query == assignment.c.query) & (standing.c.labeler == assignment.c.annotator)
    some = sql.select(assignment).join(standing, word & (standing.c.kind == RETRACTED))
    waiting = assignment.c.answered.is_(None), assignment.c.purpose != "repeat"
    return [_given(row) for row in connection.execute(some.where(*waiting).order_by(standing.c.seq))]


def given(connection: Connection, id: str) -> tuple[Given, int | None] | None:
    """An assignment, and the number of its answer's event if it has one."""
    row = connection.execute(_GIVEN, {"b_id": id}).first()
    return None if row is None else (_given(row), row.answered)


def own(connection: Connection, name: str, id: str) -> tuple[Given, int | None]:
    """The same of somebody's own assignment. Raises `Refused` where there is none, and where it is another's."""
    found = given(connection, id)
    if found is None:
        raise Refused(404, "there is no such assignment")
    if found[0].annotator != name:
        raise Refused(409, "this question was given to somebody else")
    return found


def past(connection: Connection, annotator: str) -> Past:
    """What a person has done so far."""
    mine = assignment.c.annotator == annotator
    count = sql.select(sql.func.count(), sql.func.count(assignment.c.answered)).where(mine)
    total, answered = connection.execute(count).one()
    some = sql.select(assignment).where(mine, assignment.c.answered.is_not(None), assignment.c.purpose == "label")
    recent = connection.execute(some.order_by(assignment.c.answered.desc()).limit(REMEMBERED)).all()
    repeats = sql.select(assignment.c.query).where(mine, assignment.c.purpose == "repeat")
    return Past(total, answered, [_given(row) for row in reversed(recent)], set(connection.scalars(repeats)))


def last_answers(connection: Connection, annotator: str) -> list[tuple[Given, Json, str]]:
    """A person's last answers, newest first: what was given, how it was answered, and when."""
    mine = (assignment.c.annotator == annotator) & assignment.c.answered.is_not(None)
    joined = sql.select(assignment, event.c.body, event.c.at).join(event, event.c.seq == assignment.c.answered)
    rows = connection.execute(joined.where(mine).order_by(assignment.c.answered.desc()).limit(HISTORY))
    return [(_given(row), as_sent(row.body), row.at) for row in rows]


def last_answer(connection: Connection, one: Given) -> Json:
    """How an assignment was answered last, whether that stands or was taken back; {} where it never was."""
    spoke = (event.c.subject == one.query) & (event.c.actor == one.annotator)
    kinds = ("repeat",) if one.purpose == "repeat" else ANSWERS
    newest = sql.select(event.c.body).where(spoke, event.c.kind.in_(kinds)).order_by(event.c.seq.desc()).limit(1)
    body = connection.scalar(newest)
    return {} if body is None else as_sent(body)


def as_sent(body: Json) -> Json:
    """An answer as the page sent it, in the order of the slots."""
    about = body.get("about") or {}
    return {name: about.get(name) for name in ("outcome", "strength", "ranking", "shown", "comment", "flags")}


def candidates(connection: Connection, queries: Sequence[str]) -> dict[str, list[Json]]:
    """Of each query its candidates as the log describes them, each with its `id`."""
    asked = {id: body["candidates"] for id, body in bodies(connection, queries).items()}
    described = bodies(connection, [c for ids in asked.values() for c in ids])
    return {id: [described[c] | {"id": c} for c in ids] for id, ids in asked.items()}


def settings(connection: Connection) -> Json:
    """What was changed while people labelled."""
    return {row.key: json.loads(row.value) for row in connection.execute(sql.select(setting))}


def store_id(connection: Connection) -> str:
    """The beginning of the first event's hash, which no other store has but a copy; "" where there is none."""
    return str(connection.scalar(sql.select(event.c.hash).order_by(event.c.seq).limit(1)) or "")[:12]


def newest(connection: Connection) -> int:
    """The number of the newest event."""
    return int(connection.scalar(sql.select(sql.func.max(event.c.seq))) or 0)


def open_queries(connection: Connection) -> list[str]:
    """The ids of queries without any answer but a skip, oldest first."""
    return list(
        connection.scalars(sql.select(query.c.id).where(query.c.purpose == "label", done == 0).order_by(query.c.seq))
    )


def first_queries(connection: Connection, overlap: int, limit: int) -> list[str]:
    """The ids of open queries in the order in which they are given out; see `Question.key`."""
    wanted = sql.select(query.c.id).where(query.c.purpose == "label", ~enough(overlap))
    return list(connection.scalars(wanted.order_by(query.c.batch.desc(), query.c.seq, query.c.id).limit(limit)))


def queries_after(connection: Connection, seq: int, limit: int) -> list[tuple[int, str]]:
    """Number and id of the queries that were asked after an event, oldest first; checks not among them."""
    asked = (query.c.seq > seq) & (query.c.purpose == "label")
    some = sql.select(query.c.seq, query.c.id).where(asked).order_by(query.c.seq).limit(limit)
    return [(row.seq, row.id) for row in connection.execute(some)]


def judgements_after(connection: Connection, seq: int, limit: int) -> list[Json]:
    """Answers and retractions after an event, oldest first, for a trainer in another process; checks not among them."""
    columns = [event.c[name] for name in ("seq", "kind", "subject", "actor", "body", "at")]
    trains = sql.exists().where(query.c.id == event.c.subject, query.c.purpose == "label")
    some = sql.select(*columns).where(event.c.seq > seq, event.c.kind.in_((*ANSWERS, "retract")), trains)
    return [dict(row._mapping) for row in connection.execute(some.order_by(event.c.seq).limit(limit))]


def _count(connection: Connection, wanted: sql.ColumnElement[bool]) -> int:
    return int(connection.scalar(sql.select(sql.func.count()).select_from(query).where(wanted)) or 0)


def _given(row: sql.Row[Any]) -> Given:
    shown = tuple(json.loads(row.shown))
    return Given(row.id, row.query, row.annotator, row.purpose, shown, row.guideline)
