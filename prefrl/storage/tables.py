"""The tables of a store: the log of events, which is the truth, and what is derived from it for quick reading."""

from __future__ import annotations

import hashlib
import json
from typing import Any

import numpy as np
import sqlalchemy as sql

from prefrl.types import Json

SCHEMA = 2
metadata = sql.MetaData()


class CanonicalJSON(sql.types.TypeDecorator[Any]):
    """JSON as one text only: sorted keys, no spaces, ASCII, no NaN. The chain hashes that text."""

    impl = sql.Text
    cache_ok = True

    def process_bind_param(self, value: Any, dialect: object) -> str:
        return canonical(value)

    def process_result_value(self, value: str | None, dialect: object) -> Any:
        return None if value is None else json.loads(value)


def canonical(value: Any) -> str:
    """The one text of a JSON value, NumPy's numbers included. Raises `ValueError` for NaN and infinities."""
    return json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False, default=plain)


event = sql.Table(
    "event",
    metadata,
    sql.Column("seq", sql.Integer, primary_key=True, autoincrement=False),
    sql.Column("id", sql.Text, unique=True, nullable=False),
    sql.Column("kind", sql.Text, nullable=False),
    sql.Column("subject", sql.Text, nullable=False),
    sql.Column("actor", sql.Text, nullable=False),
    sql.Column("body", CanonicalJSON, nullable=False),
    sql.Column("at", sql.Text, nullable=False),
    sql.Column("hash", sql.Text, nullable=False),
    sql.Index("event_subject", "subject", "actor", "seq"),
    sql.Index("event_kind", "kind", "seq"),
)
meta = sql.Table(
    "meta", metadata, sql.Column("key", sql.Text, primary_key=True), sql.Column("value", sql.Text, nullable=False)
)
"""`schema`: which tables these are. `head`: number and hash of the newest event."""
version = sql.Table("alembic_version", metadata, sql.Column("version_num", sql.String(32), primary_key=True))

# --- derived: `prefrl.storage.projection` writes them, and can write them again from the log ---------------------

query = sql.Table(
    "query",
    metadata,
    sql.Column("id", sql.Text, primary_key=True),
    sql.Column("seq", sql.Integer, nullable=False),
    sql.Column("batch", sql.Integer, nullable=False),
    sql.Column("size", sql.Integer, nullable=False),
    sql.Column("purpose", sql.Text, nullable=False),
    sql.Column("expected", sql.Integer),
    sql.Column("judged", sql.Integer, nullable=False),
    sql.Column("incomparable", sql.Integer, nullable=False),
    sql.Column("skipped", sql.Integer, nullable=False),
    sql.Index("query_open", "purpose", "judged"),
)
"""What was asked, in which batch, and how many answers of each sort stand; `judged` counts demonstrations as well."""
standing = sql.Table(
    "standing",
    metadata,
    sql.Column("query", sql.Text, primary_key=True),
    sql.Column("labeler", sql.Text, primary_key=True),
    sql.Column("seq", sql.Integer, nullable=False),
    sql.Column("kind", sql.Text, nullable=False),
    sql.Column("revision", sql.Integer, nullable=False),
    sql.Index("standing_labeler", "labeler", "seq"),
)
"""A labeler's newest word on a query: its kind (a skip's reason for skips, "retracted"), and how often it was
retracted before."""
submission = sql.Table(
    "submission",
    metadata,
    sql.Column("id", sql.Text, primary_key=True),
    sql.Column("seq", sql.Integer, nullable=False),
    sql.Column("digest", sql.Text, nullable=False),
)
"""What clients sent, so that sending it again is sending it once."""
assignment = sql.Table(
    "assignment",
    metadata,
    sql.Column("id", sql.Text, primary_key=True),
    sql.Column("seq", sql.Integer, nullable=False),
    sql.Column("query", sql.Text, nullable=False),
    sql.Column("annotator", sql.Text, nullable=False),
    sql.Column("purpose", sql.Text, nullable=False),
    sql.Column("shown", sql.Text, nullable=False),
    sql.Column("guideline", sql.Text, nullable=False),
    sql.Column("answered", sql.Integer),
    sql.Index("assignment_annotator", "annotator", "answered"),
)
"""Which question was put to whom, in which order; `answered` is the number of the answer's event."""
_waits = assignment.c.answered.is_(None)
sql.Index("assignment_waits", assignment.c.seq, sqlite_where=_waits, postgresql_where=_waits)
annotator = sql.Table(
    "annotator",
    metadata,
    sql.Column("name", sql.Text, primary_key=True),
    sql.Column("role", sql.Text, nullable=False),
    sql.Column("state", sql.Text, nullable=False),
    sql.Column("seq", sql.Integer, nullable=False),
)
token = sql.Table(
    "token",
    metadata,
    sql.Column("hash", sql.Text, primary_key=True),
    sql.Column("annotator", sql.Text, nullable=False),
    sql.Column("use", sql.Text, nullable=False),
    sql.Column("revoked", sql.Boolean, nullable=False),
)
"""sha256 of the secrets that let people in. The secrets themselves are nowhere."""
setting = sql.Table(
    "setting", metadata, sql.Column("key", sql.Text, primary_key=True), sql.Column("value", sql.Text, nullable=False)
)
"""What was changed while people labelled: the newest value, as JSON."""
DERIVED = (query, standing, submission, assignment, annotator, token, setting)

REFUSAL = "the event log is append-only"
for change in ("UPDATE", "DELETE"):
    sqlite = (
        f"CREATE TRIGGER event_no_{change.lower()} BEFORE {change} ON event BEGIN SELECT RAISE(ABORT, '{REFUSAL}'); END"
    )
    sql.event.listen(event, "after_create", sql.DDL(sqlite).execute_if(dialect="sqlite"))  # type: ignore[no-untyped-call]
for statement in (
    "CREATE OR REPLACE FUNCTION event_refuse() RETURNS trigger LANGUAGE plpgsql AS "
    f"$$ BEGIN RAISE EXCEPTION '{REFUSAL}'; END $$",
    "CREATE TRIGGER event_append_only BEFORE UPDATE OR DELETE OR TRUNCATE ON event "
    "FOR EACH STATEMENT EXECUTE FUNCTION event_refuse()",
):
    sql.event.listen(event, "after_create", sql.DDL(statement).execute_if(dialect="postgresql"))  # type: ignore[no-untyped-call]


def chained(before: str, row: Json) -> str:
    """The hash of an event: sha256 over the hash before it and all that it says. "" is before the first."""
    fields = [row[name] for name in ("seq", "id", "kind", "subject", "actor", "at")]
    body = row["body"] if isinstance(row["body"], str) else canonical(row["body"])
    # A JSON list keeps fields apart: joined as they are, the end of one could pass for the beginning of the next.
    return hashlib.sha256(json.dumps([before, *fields, body]).encode()).hexdigest()


def plain(value: Any) -> Any:
    """NumPy's numbers as Python's, for JSON. Raises `TypeError` for anything else."""
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} cannot be written as JSON: {value!r:.200}")
