"""An append-only, chained log of events in a database: SQLite by default, any SQLAlchemy URL otherwise."""

from __future__ import annotations

import errno
import threading
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import sqlalchemy as sql
from sqlalchemy import Connection
from sqlalchemy.exc import DatabaseError, IntegrityError, OperationalError

from prefrl.storage import engines
from prefrl.storage.engines import StoreError
from prefrl.storage.files import write_file
from prefrl.storage.projection import CHUNK, all_events, chunks, project
from prefrl.storage.tables import SCHEMA, chained, event, meta, metadata, version

BALLAST = 8 * 2**20
"""Bytes kept in reserve while people label: a full disk still has room to close the books."""
_KNOWN = sql.select(event.c.id, event.c.seq).where(event.c.id == sql.bindparam("b_id"))
_INSERT = sql.insert(event)


class StoreFull(StoreError):
    """Nothing more fits on the disk. What was acknowledged is safe."""


class DamagedStore(StoreError):
    """The log is not what was written."""


def row(id: str, kind: str, subject: str = "", actor: str = "", body: dict[str, Any] | None = None) -> dict[str, Any]:
    """One event: `id` makes it idempotent, `subject` is the query it speaks of, `actor` who speaks."""
    now = datetime.now(UTC).isoformat(timespec="milliseconds")
    return {"id": id, "kind": kind, "subject": subject, "actor": actor, "body": body or {}, "at": now}


@dataclass
class Transaction:
    """Events that are about to be appended together, over one connection."""

    connection: Connection
    seq: int
    hash: str

    def append(self, one: dict[str, Any]) -> int:
        """Append an event; returns its number. One whose id is there already changes nothing."""
        return self.extend([one])[0]

    def extend(self, rows: Iterable[dict[str, Any]]) -> list[int]:
        """Append events; returns the number of each. Those whose ids are there already change nothing."""
        rows = list(rows)
        numbers = self._numbers([one["id"] for one in rows])
        fresh = []
        for one in rows:
            if one["id"] not in numbers:
                self.seq += 1
                numbers[one["id"]] = self.seq  # noted at once: the same id may come twice among these rows
                self.hash = chained(self.hash, one | {"seq": self.seq})
                fresh.append(one | {"seq": self.seq, "hash": self.hash})
        if fresh:
            self.connection.execute(_INSERT, fresh)
            project(self.connection, fresh)
        return [numbers[one["id"]] for one in rows]

    @contextmanager
    def savepoint(self) -> Iterator[None]:
        """What raises inside is undone alone."""
        seq, hash = self.seq, self.hash
        try:
            with self.connection.begin_nested():
                yield
        except BaseException:
            self.seq, self.hash = seq, hash  # the chain goes on from the last event that is still there
            raise

    def _numbers(self, ids: Sequence[str]) -> dict[str, int]:
        """The numbers of the events that are there already."""
        found: dict[str, int] = {}
        for some in chunks(ids, CHUNK):
            if len(some) == 1:
                rows = self.connection.execute(_KNOWN, {"b_id": some[0]})
            else:
                rows = self.connection.execute(sql.select(event.c.id, event.c.seq).where(event.c.id.in_(some)))
            found |= {one.id: one.seq for one in rows}
        return found


class EventLog:
    """The log of one folder. One process may append, from any of its threads; any number may read."""

    def __init__(self, folder: Path, write: bool, url: str | None = None) -> None:
        """Open the log; make it where it is missing and `write` is true.

        Without `url`, a file `store.url` in the folder may name another SQLAlchemy database. Raises `StoreError` where
        another process writes, where there is none to read, where the file is damaged, or where a newer prefrl made it.
        """
        if not write and url is None:
            require_store(folder)
        url = url or engines.saved_url(folder)
        self.folder = folder
        self.full = False
        """Whether the disk was full when it was last written to."""
        self._turn = threading.RLock()
        self._head = (0, "")
        # Before the database is touched: a second writer must not even open it.
        self._owner = engines.own(folder) if write else None
        self._opened: list[sql.Engine] = []
        try:
            self._writer = self._open(engines.writer(folder, url)) if write else None
            self._reader = self._open(engines.reader(folder, url))
            self._prepare()
        except BaseException:
            self.close()
            raise

    def _open(self, engine: sql.Engine) -> sql.Engine:
        """Keep in mind what has to be closed, also where the next step fails."""
        self._opened.append(engine)
        return engine

    def close(self) -> None:
        """Let go of the database, and of the right to write."""
        for engine in reversed(self._opened):  # the writer last: it empties the write-ahead log
            engine.dispose()
        # Last of all: another process may write from here on.
        if self._owner is not None:
            engines.disown(self.folder, self._owner)
            self._owner = None

    # --- writing ---------------------------------------------------------------------------------------------

    @contextmanager
    def transaction(self) -> Iterator[Transaction]:
        """Append events together: all are on disk when this ends, or none. One thread at a time.

        Raises `StoreFull` when the disk is; later ones are tried again once there is room for the reserve.
        """
        with self._turn:
            if self._writer is None or self._owner is None:
                raise StoreError(f"the store in {self.folder} was opened for reading only")
            if self.full:
                self._recover()
            try:
                with self._writer.begin() as connection:
                    at = Transaction(connection, *self._head)
                    yield at
                    if at.seq > self._head[0]:
                        _set_head(connection, at.seq, at.hash)
                # Only after the commit: a transaction that failed leaves no trace in the chain.
                self._head = at.seq, at.hash
            except OperationalError as error:
                if not _says_full(error):
                    raise
                self._is_full()
                says = "nothing more can be stored until there is room; what was acknowledged is safe"
                raise StoreFull(f"the disk with {self.folder} is full: {says}") from error

    def append(self, rows: Iterable[dict[str, Any]]) -> None:
        """Add the events whose id is new, in one transaction that is on disk when this returns."""
        with self.transaction() as at:
            at.extend(rows)

    def reserve(self) -> None:
        """Keep some of the disk in reserve, for when it is full; for stores that people answer into."""
        path = self.folder / "ballast"
        if not path.exists():
            write_file(path, bytes(BALLAST))

    def _is_full(self) -> None:
        self.full = True
        (self.folder / "ballast").unlink(missing_ok=True)

    def _recover(self) -> None:
        """Be writable again if there is room. Raises `StoreFull` if not."""
        try:
            self.reserve()
        except OSError as error:
            if error.errno not in (errno.ENOSPC, errno.EDQUOT):
                raise
            says = "make room, and answers are taken again"
            raise StoreFull(f"the disk with {self.folder} is still full: {says}") from None
        self.full = False

    # --- reading ---------------------------------------------------------------------------------------------

    @property
    def sequence(self) -> int:
        """The number of the newest event."""
        with self.reading() as connection:
            return connection.scalar(sql.select(sql.func.max(event.c.seq))) or 0

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """A connection that cannot write, for one consistent look."""
        with self._reader.connect() as connection:
            yield connection

    def since(self, seq: int) -> Iterator[dict[str, Any]]:
        """The events after a number, oldest first, with their numbers and hashes."""
        with self.reading() as connection:
            yield from all_events(connection, seq)

    # --- opening ---------------------------------------------------------------------------------------------

    def _prepare(self) -> None:
        try:
            if self._writer is not None:
                self._make_or_migrate(self._writer)
            with self.reading() as connection:
                check_schema(connection, self.folder)
                self._head = head(connection, self.folder)
        except DatabaseError as error:
            raise StoreError(f"the store in {self.folder} cannot be opened: {error.orig}") from error

    def _make_or_migrate(self, writer: sql.Engine) -> None:
        with writer.begin() as connection:
            there = sql.inspect(connection).has_table("event")
            if not there:
                metadata.create_all(connection)
                connection.execute(sql.insert(version), {"version_num": str(SCHEMA)})
                connection.execute(sql.insert(meta), {"key": "schema", "value": str(SCHEMA)})
        if there and schema_of(self._reader) < SCHEMA:
            from prefrl.storage.migrate import migrate

            migrate(writer, self.folder)


def has_store(folder: Path) -> bool:
    """Whether a folder holds a store, or names the database of one."""
    return (folder / "store.db").exists() or engines.saved_url(folder) is not None


def require_store(folder: Path) -> None:
    """Raise `StoreError` unless there is a store: what cares for one must not make one."""
    if not has_store(folder):
        raise StoreError(f"{folder} holds no store: expected the file {folder / 'store.db'}, or store.url beside it")


def head(connection: Connection, folder: Path) -> tuple[int, str]:
    """Number and hash of the newest event. Raises `DamagedStore` where the log has lost its end."""
    newest = connection.execute(sql.select(event.c.seq, event.c.hash).order_by(event.c.seq.desc()).limit(1)).first()
    found = (newest.seq, newest.hash) if newest else (0, "")
    noted = connection.scalar(sql.select(meta.c.value).where(meta.c.key == "head")) or "0:"
    if noted != f"{found[0]}:{found[1]}":
        raise DamagedStore(
            f"the store in {folder} ends at event {found[0]}, but {noted.partition(':')[0]} was its last: it is "
            "damaged; `prefrl verify` says where, and can save what is whole"
        )
    return found


def check_schema(connection: Connection, folder: Path) -> None:
    """Raise `StoreError` where the tables are not those of this version."""
    found = _schema(connection)
    if found > SCHEMA:
        raise StoreError(
            f"the store in {folder} has schema {found}, made by a newer prefrl; this one knows up to "
            f"{SCHEMA}: upgrade with pip install -U prefrl"
        )
    if found < SCHEMA:
        raise StoreError(
            f"the store in {folder} has schema {found}, made by an older prefrl: `prefrl migrate {folder}` brings it "
            f"to {SCHEMA}, and keeps a copy"
        )


def schema_of(engine: sql.Engine) -> int:
    with engine.connect() as connection:
        return _schema(connection)


def _schema(connection: Connection) -> int:
    found = connection.scalar(sql.select(meta.c.value).where(meta.c.key == "schema"))
    return int(found) if found is not None else 0


def _set_head(connection: Connection, seq: int, hash: str) -> None:
    value = f"{seq}:{hash}"
    if not connection.execute(sql.update(meta).where(meta.c.key == "head").values(value=value)).rowcount:
        connection.execute(sql.insert(meta), {"key": "head", "value": value})


def _says_full(error: BaseException | None) -> bool:
    """Whether an error, or one that it hides, is that of a full disk: SQLite then misses its savepoints too."""
    words = ("disk is full", "no space left", "could not extend")
    return error is not None and (any(w in str(error).lower() for w in words) or _says_full(error.__context__))


__all__ = [
    "DamagedStore",
    "EventLog",
    "IntegrityError",
    "StoreError",
    "StoreFull",
    "Transaction",
    "has_store",
    "head",
    "require_store",
    "row",
]
