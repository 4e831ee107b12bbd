"""What is PostgreSQL's alone; test_store.py has what holds on every database."""

from __future__ import annotations

import threading
from itertools import count
from pathlib import Path

import pytest
import sqlalchemy as sql
from sqlalchemy.exc import DBAPIError
from stores import derived, fill, responses

from prefrl.judgements import Comparison
from prefrl.storage.log import DamagedStore, StoreError
from prefrl.storage.maintenance import backup, repair_derived, verify_store
from prefrl.storage.tables import event
from prefrl.store import Store
from prefrl.types import Response


@pytest.fixture
def folder(tmp_path: Path, postgres_url: str) -> Path:
    """A store's folder that names its database."""
    (tmp_path / "store").mkdir()
    (tmp_path / "store" / "store.url").write_text(postgres_url + "\n")
    return tmp_path / "store"


def test_it_holds_the_same_as_sqlite(folder: Path, tmp_path: Path) -> None:
    with Store[Response](folder) as store, Store[Response](tmp_path / "sqlite") as other:
        fill(store)
        fill(other)
        assert store.counts() == other.counts()
        assert [j.judgement for j in store.judged()] == [j.judgement for j in other.judged()]
        assert store.answers() == other.answers()
        assert [q.id for q in store.open_queries("bob")] == [q.id for q in other.open_queries("bob")]
        assert [e["body"] for e in store.events()] == [e["body"] for e in other.events()]
        assert derived(folder) == derived(tmp_path / "sqlite")
    assert not (folder / "store.db").exists()


def test_readers_see_one_state_while_somebody_writes(folder: Path) -> None:
    with Store[Response](folder) as store, store.log.reading() as connection:
        store.ask(responses(2))
        before = connection.scalar(sql.select(sql.func.count()).select_from(event))
        store.ask(responses(4))
        assert before
        assert connection.scalar(sql.select(sql.func.count()).select_from(event)) == before


@pytest.mark.slow
def test_a_store_is_opened_and_verified_while_somebody_writes(folder: Path) -> None:
    with Store[Response](folder) as store:
        fill(store)
        stop = threading.Event()
        writing = threading.Thread(target=_write_until, args=(store, stop))
        writing.start()
        try:
            for _ in range(15):
                with Store[Response](folder, write=False) as reader:
                    assert reader.counts()["asked"] > 0
                assert verify_store(folder).ok
        finally:
            stop.set()
            writing.join()


def _write_until(store: Store[Response], stop: threading.Event) -> None:
    queries = responses(12)
    for number in count():
        store.answer([Comparison(queries[number % 12].id, float(number % 2), f"person {number}")])
        if stop.is_set():
            return


def test_reading_goes_on_after_the_server_dropped_its_connections(folder: Path, postgres_url: str) -> None:
    with Store[Response](folder) as store:
        store.ask(responses(2))
    with Store[Response](folder, write=False) as reader:
        asked = reader.counts()["asked"]
        engine = sql.create_engine(postgres_url)
        with engine.begin() as connection:
            others = "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE pid <> pg_backend_pid()"
            connection.exec_driver_sql(others + " AND backend_type = 'client backend'")
        engine.dispose()
        assert reader.counts()["asked"] == asked


def test_the_database_refuses_changes_to_the_log(folder: Path, postgres_url: str) -> None:
    with Store[Response](folder) as store:
        store.ask(responses(2))
    engine = sql.create_engine(postgres_url)
    for statement in ("UPDATE event SET actor = 'eve'", "DELETE FROM event", "TRUNCATE event"):
        with pytest.raises(DBAPIError, match="append-only"), engine.begin() as connection:
            connection.exec_driver_sql(statement)
    engine.dispose()


def test_a_second_writer_on_another_machine_is_refused(folder: Path, postgres_url: str, tmp_path: Path) -> None:
    with Store[Response](folder):
        with pytest.raises(StoreError, match="another process is writing"):
            Store[Response](tmp_path / "elsewhere", url=postgres_url)
        with Store[Response](tmp_path / "elsewhere", write=False, url=postgres_url) as reader:
            assert reader.counts()["asked"] == 0
    Store[Response](tmp_path / "elsewhere", url=postgres_url).close()


def test_changes_behind_its_back_are_found_repaired_and_copied(folder: Path, postgres_url: str, tmp_path: Path) -> None:
    with Store[Response](folder) as store:
        fill(store)
    assert verify_store(folder).ok
    engine = sql.create_engine(postgres_url)
    with engine.begin() as connection:
        connection.exec_driver_sql("UPDATE query SET judged = 9")
    assert not verify_store(folder).ok
    repair_derived(folder)
    assert backup(folder, tmp_path / "copy") == verify_store(folder).events
    assert verify_store(tmp_path / "copy").ok
    with engine.begin() as connection:
        connection.exec_driver_sql("DROP TRIGGER event_append_only ON event")
        connection.exec_driver_sql("DELETE FROM event WHERE seq = (SELECT max(seq) FROM event)")
    engine.dispose()
    assert not verify_store(folder).ok
    with pytest.raises(DamagedStore):
        Store[Response](folder)
