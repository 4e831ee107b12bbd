"""Care for a store: is it whole, a copy of it, what can be saved of a damaged one."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import sqlalchemy as sql
from sqlalchemy import Connection
from sqlalchemy.exc import DatabaseError

from prefrl.storage import engines
from prefrl.storage.events import load_candidate
from prefrl.storage.files import check_free, verify, whole_folder, write_file
from prefrl.storage.log import StoreError, check_schema, require_store
from prefrl.storage.projection import KINDS, all_events, chunks, dump, project, rebuild
from prefrl.storage.tables import SCHEMA, chained, event, meta, metadata, version

SHOWN = 20
"""How many faults are told."""
PARTS = ("blobs", "gold", "config.yaml")
"""What belongs to a store beside its database."""


@dataclass
class Verified:
    """What was looked at, and what is wrong."""

    events: int = 0
    blobs: int = 0
    whole: int = 0
    """The log is as it was written up to the event of this number."""
    hash: str = ""
    """Of that event."""
    faults: list[str] = field(default_factory=list)

    @property
    def ok(self) -> bool:
        return not self.faults


def verify_store(folder: Path) -> Verified:
    """Check a store: the database, the chain of hashes, the derived tables, the files. Changes nothing.

    Raises `StoreError` where there is no store, or one of another version.
    """
    with _opened(folder) as connection:
        found = Verified()
        try:
            check_schema(connection, folder)
            found.faults += _integrity(connection)
            _check_chain(connection, found)
            if found.ok:
                found.faults += _check_derived(connection)
        except (DatabaseError, ValueError, KeyError, TypeError) as error:
            if isinstance(error, StoreError):
                raise
            found.faults.append(f"the database cannot be read: {error}")
        if not found.faults:
            _check_blobs(connection, folder, found)
    found.faults[SHOWN:] = [f"... and {len(found.faults) - SHOWN} more"] * (len(found.faults) > SHOWN)
    return found


def repair_derived(folder: Path) -> None:
    """Write the derived tables again from the log. Raises `StoreError` where the log is damaged, or there is none."""
    require_store(folder)
    lock = engines.own(folder)  # nobody may append while the tables are written again
    try:
        with _opened(folder) as connection:
            check_schema(connection, folder)
            found = Verified()
            _check_chain(connection, found)
        if not found.ok:
            raise StoreError(f"the log in {folder} is damaged ({found.faults[0]}); save what is whole, with --salvage")
        writer = engines.writer(folder, engines.saved_url(folder))
        try:
            with writer.begin() as connection:
                rebuild(connection)
        finally:
            writer.dispose()
    finally:
        engines.disown(folder, lock)


def backup(folder: Path, to: Path) -> int:
    """Copy a store into a new folder, also while it is written to, checking each event; returns how many there are.

    The copy is SQLite, whatever the database. Raises `StoreError` where the chain is broken.
    """
    check_free(to)
    with _opened(folder) as connection:
        check_schema(connection, folder)
        found = Verified()
        with whole_folder(to) as work:
            for name in PARTS:
                _copy(folder / name, work / name)
            _write_events(_chain(connection, found), work)
            if not found.ok:
                raise StoreError(
                    f"{folder} is damaged: {found.faults[0]}; `prefrl verify --salvage` saves what is whole"
                )
    verify(to)
    return found.events


def salvage(folder: Path, to: Path) -> Verified:
    """Copy the part of a damaged store that is whole, from its beginning to the first fault, into a new folder."""
    check_free(to)
    found = Verified()
    with _opened(folder) as connection, whole_folder(to) as work:
        for name in PARTS:
            _copy(folder / name, work / name)
        _write_events(_until_unreadable(_chain(connection, found), found), work)
    return found


@contextmanager
def _opened(folder: Path) -> Iterator[Connection]:
    """A connection for looking only, without asking whether all is well."""
    require_store(folder)
    engine = engines.reader(folder, engines.saved_url(folder))
    try:
        with engine.connect() as connection:
            yield connection
    except DatabaseError as error:
        raise StoreError(f"the store in {folder} cannot be opened: {error.orig}") from error
    finally:
        engine.dispose()


def _integrity(connection: Connection) -> list[str]:
    if connection.dialect.name != "sqlite":
        return []
    said = [str(line) for (line,) in connection.exec_driver_sql("PRAGMA integrity_check(20)")]
    return [] if said == ["ok"] else [f"the database: {line}" for line in said]


def _check_chain(connection: Connection, found: Verified) -> None:
    for _ in _chain(connection, found):
        pass
    noted = connection.scalar(sql.select(meta.c.value).where(meta.c.key == "head")) or "0:"
    if found.ok and noted != f"{found.whole}:{found.hash}":
        found.faults.append(f"the log ends at event {found.whole}, but it was noted to end at {noted:.24}")


def _chain(connection: Connection, found: Verified) -> Iterator[dict[str, Any]]:
    """The events whose hashes are right, up to the first that is wrong; `found` says how it went."""
    # Bodies as the text that was hashed: parsed and written again, damage could go unnoticed.
    before, raw = "", sql.type_coerce(event.c.body, sql.Text).label("raw")
    after = 0
    while True:
        some = sql.select(event, raw).where(event.c.seq > after).order_by(event.c.seq).limit(5000)
        rows = list(connection.execute(some.with_only_columns(*(c for c in event.c if c.name != "body"), raw)))
        for row in rows:
            one: dict[str, Any] = dict(row._mapping)
            one["body"] = one.pop("raw")
            after, found.events = one["seq"], found.events + 1
            if one["seq"] != found.whole + 1 or chained(before, one) != one["hash"] or one["kind"] not in KINDS:
                found.faults.append(f"event {found.whole + 1}: its hash is not that of what it says")
                return
            before = found.hash = one["hash"]
            found.whole = one["seq"]
            yield one
        if not rows:
            return


def _check_derived(connection: Connection) -> list[str]:
    """Compare the derived tables with what the log gives."""
    scratch = sql.create_engine("sqlite://")
    with scratch.begin() as again:
        metadata.create_all(again)
        for some in chunks(all_events(connection), 5000):
            project(again, some)
        there, should = dump(connection), dump(again)
        for is_, ought in zip(there, should, strict=False):
            if is_ != ought:
                return [f"the derived tables: {is_:.200} should be {ought:.200}; --repair-derived writes them again"]
        rest = [*there, *should]
    scratch.dispose()
    return [f"the derived tables: {rest[0]:.200} stands on one side only; --repair-derived"] if rest else []


def _check_blobs(connection: Connection, folder: Path, found: Verified) -> None:
    """Every candidate must still have the content that its id names."""
    for one in all_events(connection):
        if one["kind"] == "candidate":
            try:
                load_candidate(one["id"], one["body"], folder / "blobs")
            except ValueError as error:
                found.faults.append(str(error))
            found.blobs += 1


def _until_unreadable(rows: Iterator[dict[str, Any]], found: Verified) -> Iterator[dict[str, Any]]:
    try:
        yield from rows
    except (DatabaseError, ValueError, KeyError, TypeError) as error:
        found.faults.append(f"event {found.whole + 1}: {error}")


def _write_events(rows: Iterator[dict[str, Any]], folder: Path) -> None:
    """A new database with these events, hashes and all, and its derived tables."""
    engine = sql.create_engine(f"sqlite:///{folder / 'store.db'}")
    last = (0, "")
    plain = sql.table("event", *(sql.column(c.name) for c in event.c))  # bodies go over as the text that was hashed
    with engine.begin() as connection:
        metadata.create_all(connection)
        for some in chunks(rows, 5000):
            connection.execute(sql.insert(plain), some)
            last = some[-1]["seq"], some[-1]["hash"]
        connection.execute(sql.insert(version), {"version_num": str(SCHEMA)})
        keys = {"schema": str(SCHEMA), "head": f"{last[0]}:{last[1]}"}
        connection.execute(sql.insert(meta), [{"key": k, "value": v} for k, v in keys.items()])
        rebuild(connection)
    engine.dispose()


def _copy(source: Path, to: Path) -> None:
    """A file, or a tree of files that never change, by links where the disk allows."""
    if source.is_file():
        write_file(to, source.read_bytes())
    elif source.is_dir():
        shutil.copytree(source, to, copy_function=_link, symlinks=True)


def _link(source: str, to: str) -> None:
    try:
        os.link(source, to)
    except OSError:
        shutil.copy2(source, to)
