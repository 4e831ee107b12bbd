"""Answers that a store's own file brings back: a file loses tokens and simulator states, so its candidates have other
ids than those they came from. Files of ours name each query, and so it can be found again.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import sqlalchemy as sql

from prefrl.exchange.exports.given import stored_queries
from prefrl.exchange.layout import Row
from prefrl.judgements import moved
from prefrl.kinds import kind_of
from prefrl.storage.tables import query as asked
from prefrl.types import Candidate, Query

QUERY = re.compile("[0-9a-f]{64}")


def recognised(connection: sql.Connection, rows: Sequence[Row], blobs: Path) -> list[Row]:
    """The rows, as answers to the queries that they name where a store has these with the same content."""
    named = {row.named for row in rows if QUERY.fullmatch(row.named) and row.named != row.query.id}
    if not named:
        return list(rows)
    wanted = sql.select(asked.c.id).where(asked.c.id.in_(named), asked.c.purpose == "label")
    there = stored_queries(connection, set(connection.scalars(wanted)), blobs)
    return [_placed(row, there[row.named]) if row.named in there else row for row in rows]


def _placed(row: Row, query: Query[Any]) -> Row:
    """A row as an answer to the query that it names; as it is where the candidates are others."""
    places = {_bare(candidate): at for at, candidate in enumerate(query.candidates)}
    own = [_bare(candidate) for candidate in row.query.candidates]
    # Two candidates that differ only in what a file loses cannot be told apart, so the row is left as it is.
    if len(places) < len(query.candidates) or set(own) != set(places):
        return row
    answer = moved(row.answer, [places[id] for id in own])
    return row._replace(query=query, answer=replace(answer, query=query.id, labeler=row.there))


def _bare(candidate: Candidate) -> str:
    """The id that a candidate has where a file has lost what it could not hold."""
    plain: Candidate = kind_of(candidate).plain(candidate)
    return plain.id
