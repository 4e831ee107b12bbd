"""Events are chained by sha256 and keep their JSON in one form. Derived tables are written anew afterwards."""

import hashlib
import json
from typing import Any

import sqlalchemy as sql
from alembic import op

revision = "2"
down_revision = "1"
NAMES = ("seq", "id", "kind", "subject", "actor", "body", "at")


def upgrade() -> None:
    connection = op.get_bind()
    op.rename_table("event", "event_1")
    table = op.create_table(
        "event",
        sql.Column("seq", sql.Integer, primary_key=True, autoincrement=False),
        *(sql.Column(name, sql.Text, unique=name == "id", nullable=False) for name in (*NAMES[1:], "hash")),
    )
    hash, seq = "", 0
    old = sql.table("event_1", *(sql.column(name) for name in NAMES))
    for row in connection.execute(sql.select(old).order_by(old.c.seq)).all():
        one: dict[str, Any] = dict(row._mapping)
        body = json.loads(one["body"]) if isinstance(one["body"], str) else one["body"]
        seq = one["seq"]
        one["body"] = json.dumps(body, sort_keys=True, separators=(",", ":"), allow_nan=False)
        fields = [one[name] for name in ("seq", "id", "kind", "subject", "actor", "at")]
        hash = hashlib.sha256(json.dumps([hash, *fields, one["body"]]).encode()).hexdigest()
        connection.execute(sql.insert(table), one | {"hash": hash})
    op.drop_table("event_1")  # its triggers go with it
    if connection.dialect.name == "sqlite":
        op.execute("DELETE FROM sqlite_sequence")
    for name, columns in (("event_subject", ["subject", "actor", "seq"]), ("event_kind", ["kind", "seq"])):
        op.create_index(name, "event", columns)
    _refuse_changes(connection.dialect.name)
    meta = sql.table("meta", sql.column("key"), sql.column("value"))
    connection.execute(sql.update(meta).where(meta.c.key == "schema").values(value="2"))
    if seq:
        connection.execute(sql.insert(meta).values(key="head", value=f"{seq}:{hash}"))


def _refuse_changes(dialect: str) -> None:
    if dialect == "sqlite":
        for change in ("UPDATE", "DELETE"):
            op.execute(
                f"CREATE TRIGGER event_no_{change.lower()} BEFORE {change} ON event "
                "BEGIN SELECT RAISE(ABORT, 'the event log is append-only'); END"
            )
    else:
        op.execute(
            "CREATE OR REPLACE FUNCTION event_refuse() RETURNS trigger LANGUAGE plpgsql AS "
            "$$ BEGIN RAISE EXCEPTION 'the event log is append-only'; END $$"
        )
        op.execute(
            "CREATE TRIGGER event_append_only BEFORE UPDATE OR DELETE OR TRUNCATE ON event "
            "FOR EACH STATEMENT EXECUTE FUNCTION event_refuse()"
        )
