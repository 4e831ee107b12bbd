"""Whether a person looks: how many check questions they answered as expected."""

from __future__ import annotations

import sqlalchemy as sql
from sqlalchemy import Connection

from prefrl.page.ledger import best
from prefrl.page.tallies import shortfall
from prefrl.stats.intervals import Measured, share
from prefrl.storage.events import read_answer
from prefrl.storage.tables import assignment, event, query
from prefrl.types import Skip


def failing(connection: Connection, name: str, least: float) -> str:
    """Why a person is to be paused: they surely answer a smaller share of checks as expected; "" where they may not."""
    return shortfall("checks", attention(connection, name), least)


def attention(connection: Connection, name: str) -> Measured:
    """The share of check questions that a person answered as expected since they were last let in; skips apart."""
    states = sql.select(sql.func.max(event.c.seq)).where(event.c.kind == "state", event.c.actor == name)
    since = connection.scalar(states) or 0
    mine = (assignment.c.annotator == name) & (assignment.c.purpose == "check") & (assignment.c.answered > since)
    columns = *(event.c[column] for column in ("kind", "subject", "actor", "body")), query.c.expected
    answered = sql.join(assignment, event, event.c.seq == assignment.c.answered)
    joined = answered.join(query, query.c.id == assignment.c.query)
    answers = [
        (read_answer(row.kind, row.subject, row.actor, row.body), row.expected)
        for row in connection.execute(sql.select(*columns).select_from(joined).where(mine))
    ]
    hits = [
        best(answer) == expected
        for answer, expected in answers
        if not (isinstance(answer, Skip) and answer.reason == "skip")
    ]
    return share(sum(hits), len(hits), "no check question was answered")
