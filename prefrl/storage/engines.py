"""How a store's database is opened: one connection that writes, others that only read, and one owner."""

from __future__ import annotations

import json
import os
import socket
import sqlite3
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import sqlalchemy as sql
from filelock import FileLock, Timeout

from prefrl.storage.files import write_file

NETWORK = ("nfs", "cifs", "smb", "9p", "fuse.sshfs", "afs", "ceph", "glusterfs")
"""File systems on which SQLite's write-ahead log is not safe: its shared memory does not cross machines."""
ADVISORY = 0x70726566726C
"""The number under which PostgreSQL knows that a store has a writer."""


class StoreError(ValueError):
    """A store cannot be opened, or does not hold what was asked for."""


def saved_url(folder: Path) -> str | None:
    """The database that a folder's file `store.url` names, if there is one."""
    path = folder / "store.url"
    return path.read_text(encoding="utf-8").strip() or None if path.is_file() else None


def own(folder: Path) -> FileLock:
    """Become the one process that may write to a folder, or raise `StoreError` that says who is."""
    folder.mkdir(parents=True, exist_ok=True)
    lock, note = FileLock(folder / "owner.lock", timeout=0), folder / "owner.json"
    try:
        # The lock ends with its process, however that ends; the note beside it only tells people who it is.
        lock.acquire()
    except Timeout:
        holder = note.read_text() if note.exists() else "unknown"
        raise StoreError(
            f"another process is writing to the store in {folder}: {holder}; "
            "wait for it, stop it, or use another folder"
        ) from None
    since = datetime.now(UTC).isoformat(timespec="seconds")
    try:
        write_file(note, json.dumps({"pid": os.getpid(), "host": socket.gethostname(), "since": since}).encode())
    except BaseException:
        lock.release()
        raise
    return lock


def owned(folder: Path) -> bool:
    """Whether some process is writing to a folder."""
    path = folder / "owner.lock"
    if not path.exists():
        return False
    try:
        with FileLock(path, timeout=0):
            return False
    except Timeout:
        return True


def disown(folder: Path, lock: FileLock) -> None:
    """Give up what `own` gave."""
    (folder / "owner.json").unlink(missing_ok=True)  # before the release, or it could be the next owner's
    lock.release()


def writer(folder: Path, url: str | None) -> sql.Engine:
    """An engine of one connection, which does all writing and all checkpoints."""
    if url is not None:
        engine = _engine(folder, url, pool_size=1, max_overflow=0)
        if engine.dialect.name == "sqlite":
            _set_up(engine, writes=True, journal="WAL")
        else:
            sql.event.listen(engine, "connect", _lock_out_others)
        return engine
    engine = _sqlite(folder, "rwc", pool_size=1, max_overflow=0)
    _set_up(engine, writes=True, journal="DELETE" if file_system(folder) in NETWORK else "WAL")
    return engine


def reader(folder: Path, url: str | None) -> sql.Engine:
    """An engine whose connections cannot write; each transaction sees one state of the store throughout."""
    if url is not None:
        engine = _engine(folder, url, pool_pre_ping=True)  # a server may have been restarted
        if engine.dialect.name != "sqlite":
            return engine.execution_options(postgresql_readonly=True, isolation_level="REPEATABLE READ")
        _set_up(engine, writes=False, journal=None)
        return engine
    engine = _sqlite(folder, "ro", pool_size=4, max_overflow=16)
    _set_up(engine, writes=False, journal=None)
    return engine


def _engine(folder: Path, url: str, **options: Any) -> sql.Engine:
    """Raises `StoreError` for what is no URL of a database, or of one whose driver is not installed."""
    try:
        return sql.create_engine(url, **options)
    except (sql.exc.ArgumentError, ModuleNotFoundError) as error:  # the URL may hold a password: it is not shown
        raise StoreError(
            f"the database of the store in {folder} cannot be used: {error}; expected a SQLAlchemy URL such as "
            "postgresql+psycopg://user@host/name (in store.url, or as given), and its driver installed: "
            "pip install 'prefrl[postgres]'"
        ) from error


def file_system(folder: Path) -> str:
    """The type of the file system that a folder lies on, "ext4" say; "" where that cannot be told."""
    try:
        lines = Path("/proc/mounts").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        return ""
    found, path = ("", ""), str(folder.resolve())
    for _, mount, kind, *_ in (line.split(" ") for line in lines):
        where = mount.replace("\\040", " ").rstrip("/")
        if (path == where or path.startswith(where + "/")) and len(where) >= len(found[0]):
            found = where, kind
    return found[1].removesuffix("3").removesuffix("4") if found[1].startswith(("nfs", "smb")) else found[1]


def _sqlite(folder: Path, mode: str, **pool: int) -> sql.Engine:
    # The path may hold anything; and a reader must not make a store where there is none.
    uri = f"{(folder / 'store.db').absolute().as_uri()}?mode={mode}"

    def connect() -> sqlite3.Connection:
        return sqlite3.connect(uri, uri=True, check_same_thread=False)  # the pool lends it to one thread at a time

    return sql.create_engine("sqlite://", creator=connect, poolclass=sql.QueuePool, **pool)


def _set_up(engine: sql.Engine, writes: bool, journal: str | None) -> None:
    """Every acknowledged label is on disk: full synchronisation; and sqlite3 must not begin on its own."""
    pragmas = ["busy_timeout=30000"]
    if writes:
        pragmas += [f"journal_mode={journal}", "synchronous=FULL", "foreign_keys=ON"]
    else:
        pragmas += ["query_only=ON"]

    def on_connect(connection: Any, _: object) -> None:
        connection.isolation_level = None
        for pragma in pragmas:
            connection.execute(f"PRAGMA {pragma}")

    sql.event.listen(engine, "connect", on_connect)
    begin = "BEGIN IMMEDIATE" if writes else "BEGIN"  # a lock is waited for at the start, or not at all
    sql.event.listen(engine, "begin", lambda connection: connection.exec_driver_sql(begin))


def _lock_out_others(connection: Any, _: object) -> None:
    """On a PostgreSQL server the lock of a folder binds nobody elsewhere: the database itself must say no."""
    with connection.cursor() as cursor:
        cursor.execute("SELECT pg_try_advisory_lock(%s)", (ADVISORY,))
        (free,) = cursor.fetchone()
        cursor.execute(
            "SELECT pid, client_addr, backend_start FROM pg_stat_activity WHERE pid IN (SELECT pid FROM "
            "pg_locks WHERE locktype = 'advisory' AND granted)"
        )
        others = cursor.fetchall()
    connection.commit()  # ends the transaction; the lock is the session's, and stays
    if not free:
        raise StoreError(f"another process is writing to this database: server process, address, since: {others}")
