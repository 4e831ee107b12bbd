"""An append-only log of events in a database: SQLite by default, any SQLAlchemy URL otherwise."""

from __future__ import annotations

import json
import os
import socket
import sqlite3
from collections.abc import Iterable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import sqlalchemy as sql
from filelock import FileLock, Timeout
from sqlalchemy.exc import DatabaseError

from prefrl.files import write_file

SCHEMA = 1
metadata = sql.MetaData()
event = sql.Table(
    "event",
    metadata,
    sql.Column("seq", sql.Integer, primary_key=True),
    sql.Column("id", sql.Text, unique=True, nullable=False),
    sql.Column("kind", sql.Text, nullable=False),
    sql.Column("subject", sql.Text, nullable=False),
    sql.Column("actor", sql.Text, nullable=False),
    sql.Column("body", sql.JSON, nullable=False),
    sql.Column("at", sql.Text, nullable=False),
    sqlite_autoincrement=True,
)
meta = sql.Table(
    "meta", metadata, sql.Column("key", sql.Text, primary_key=True), sql.Column("value", sql.Text, nullable=False)
)
for change in ("UPDATE", "DELETE"):
    trigger = f"CREATE TRIGGER event_no_{change.lower()} BEFORE {change} ON event "
    refusal = sql.DDL(trigger + "BEGIN SELECT RAISE(ABORT, 'the event log is append-only'); END")  # type: ignore[no-untyped-call]
    sql.event.listen(event, "after_create", refusal.execute_if(dialect="sqlite"))


class StoreError(ValueError):
    """A store cannot be opened, or does not hold what was asked for."""


def row(id: str, kind: str, subject: str = "", actor: str = "", body: dict[str, Any] | None = None) -> dict[str, Any]:
    """One event: `id` makes it idempotent, `subject` is the query it speaks of, `actor` who speaks."""
    now = datetime.now(UTC).isoformat(timespec="milliseconds")
    return {"id": id, "kind": kind, "subject": subject, "actor": actor, "body": body or {}, "at": now}


class EventLog:
    """The log of one folder. One process may append, any number may read."""

    def __init__(self, folder: Path, write: bool, url: str | None = None) -> None:
        """Open the log; make it where it is missing and `write` is true.

        Raises `StoreError` where another process writes, where there is none to read, where the file is damaged, or
        where a newer prefrl made it.
        """
        if not write and url is None and not (folder / "store.db").exists():
            raise StoreError(f"{folder} holds no store: expected the file {folder / 'store.db'}")
        self.folder = folder
        self._owner = _own(folder) if write else None
        self._engine = _engine(folder, write, url)
        try:
            self._prepare(write)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Let go of the database, and of the right to write."""
        self._engine.dispose()
        if self._owner is not None:
            (self.folder / "owner.json").unlink(missing_ok=True)
            self._owner.release()

    def append(self, rows: Iterable[dict[str, Any]]) -> None:
        """Add the events whose id is new, in one transaction that is on disk when this returns."""
        if self._owner is None:
            raise StoreError(f"the store in {self.folder} was opened for reading only")
        fresh: dict[str, dict[str, Any]] = {}
        for one in rows:
            fresh.setdefault(one["id"], one)
        with self._engine.begin() as connection:
            ids = list(fresh)
            for i in range(0, len(ids), 500):  # databases limit the number of parameters of a statement
                for known in connection.scalars(sql.select(event.c.id).where(event.c.id.in_(ids[i : i + 500]))):
                    del fresh[known]
            if fresh:
                connection.execute(sql.insert(event), list(fresh.values()))

    def since(self, seq: int) -> list[sql.Row[Any]]:
        """The events after a sequence number, oldest first."""
        with self._engine.connect() as connection:
            return list(connection.execute(sql.select(event).where(event.c.seq > seq).order_by(event.c.seq)))

    def _prepare(self, write: bool) -> None:
        try:
            if write:
                metadata.create_all(self._engine)
            with self._engine.begin() as connection:
                found = connection.scalar(sql.select(meta.c.value).where(meta.c.key == "schema"))
                if found is None and write:
                    connection.execute(sql.insert(meta), {"key": "schema", "value": str(SCHEMA)})
        except DatabaseError as error:
            raise StoreError(f"the store in {self.folder} cannot be opened: {error.orig}") from error
        if found is not None and int(found) > SCHEMA:
            raise StoreError(
                f"the store in {self.folder} has schema {found}, made by a newer prefrl; this one knows up to "
                f"{SCHEMA}: upgrade with pip install -U prefrl"
            )


def _own(folder: Path) -> FileLock:
    """Become the one process that may write, or say who is."""
    folder.mkdir(parents=True, exist_ok=True)
    lock, note = FileLock(folder / "owner.lock", timeout=0), folder / "owner.json"
    try:
        lock.acquire()
    except Timeout:
        holder = note.read_text() if note.exists() else "unknown"
        raise StoreError(
            f"another process is writing to the store in {folder}: {holder}; "
            "wait for it, stop it, or use another folder"
        ) from None
    write_file(note, json.dumps({"pid": os.getpid(), "host": socket.gethostname()}).encode())
    return lock


def _engine(folder: Path, write: bool, url: str | None) -> sql.Engine:
    if url is not None:
        return sql.create_engine(url)
    path = (folder / "store.db").absolute()
    uri = f"{path.as_uri()}?mode={'rwc' if write else 'ro'}"  # a reader must not make a store where there is none
    engine = sql.create_engine("sqlite://", creator=lambda: sqlite3.connect(uri, uri=True), poolclass=sql.QueuePool)
    sql.event.listen(engine, "connect", _on_connect if write else _on_connect_reader)
    sql.event.listen(
        engine, "begin", lambda connection: connection.exec_driver_sql("BEGIN IMMEDIATE" if write else "BEGIN")
    )
    return engine


def _on_connect(connection: Any, _: object) -> None:
    """Every acknowledged label is on disk: WAL with full synchronisation; sqlite3 must not begin on its own."""
    connection.isolation_level = None
    for pragma in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON", "busy_timeout=30000"):
        connection.execute(f"PRAGMA {pragma}")


def _on_connect_reader(connection: Any, _: object) -> None:
    connection.isolation_level = None
    connection.execute("PRAGMA busy_timeout=30000")
