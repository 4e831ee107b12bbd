"""What is SQLite's alone; test_store.py has what holds on every database."""

import shutil
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from prefrl.judgements import Comparison
from prefrl.storage import engines
from prefrl.storage.log import StoreError, StoreFull
from prefrl.storage.maintenance import verify_store
from prefrl.store import Store
from prefrl.types import Query, Response, Segment

Ask = Callable[..., Query[Segment]]
Pairs = Callable[[int], list[Query[Segment]]]
HOLDER = """
import sqlite3, sys, time
connection = sqlite3.connect(sys.argv[1], isolation_level=None)
connection.execute("BEGIN IMMEDIATE")
print("held", flush=True)
sys.stdin.readline()
time.sleep(float(sys.argv[2]))
print(time.monotonic(), flush=True)
connection.execute("ROLLBACK")
"""


def test_a_lock_of_another_program_delays_an_answer_and_does_not_fail_it(text_store: Store[Response]) -> None:
    """As of somebody who looks into the database with the sqlite3 shell, and begins to write there."""
    query = Query((Response("p", "a"), Response("p", "b")))
    text_store.ask([query])
    command = [sys.executable, "-c", HOLDER, str(text_store.folder / "store.db"), "1"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as holder:
        assert holder.stdin is not None
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        assert text_store.counts()["asked"] == 1  # who reads does not wait: it is held until we say so
        holder.stdin.write("let go\n")
        holder.stdin.flush()
        text_store.answer([Comparison(query.id, 1.0, "me")])
        assert time.monotonic() > float(holder.stdout.readline())
    assert text_store.counts()["answered"] == 1
    assert verify_store(text_store.folder).ok


def test_one_who_reads_for_long_delays_no_answer(text_store: Store[Response]) -> None:
    query = Query((Response("p", "a"), Response("p", "b")))
    text_store.ask([query])
    reader = sqlite3.connect(text_store.folder / "store.db", isolation_level=None)
    reader.execute("BEGIN")
    reader.execute("SELECT count(*) FROM event").fetchone()
    begin = time.monotonic()
    text_store.answer([Comparison(query.id, 1.0, "me")])
    assert time.monotonic() - begin < 15, "half of what a writer waits for a lock"
    reader.close()


def test_whoever_writes_waits_for_the_disk(store: Store[Segment]) -> None:
    with engines.writer(store.folder, None).connect() as connection:
        assert connection.exec_driver_sql("PRAGMA synchronous").scalar() == 2  # FULL
        assert connection.exec_driver_sql("PRAGMA journal_mode").scalar() == "wal"


def test_the_log_cannot_be_changed(store: Store[Segment], make_query: Ask) -> None:
    store.ask([make_query()])
    store.close()
    with sqlite3.connect(store.folder / "store.db") as connection:
        for statement in ("UPDATE event SET body = '{}'", "DELETE FROM event"):
            with pytest.raises(sqlite3.IntegrityError, match="append-only"):
                connection.execute(statement)
    connection.close()


def test_a_store_from_a_newer_version_is_refused(store: Store[Segment]) -> None:
    store.close()
    with sqlite3.connect(store.folder / "store.db") as connection:
        connection.execute("UPDATE meta SET value = '99'")
    connection.close()
    with pytest.raises(StoreError, match="newer prefrl"):
        Store[Segment](store.folder)


def test_a_file_that_is_no_database_is_refused(tmp_path: Path) -> None:
    (tmp_path / "store.db").write_bytes(b"x" * 4096)
    with pytest.raises(StoreError, match="cannot be opened"):
        Store[Segment](tmp_path)
    (tmp_path / "store.db").unlink()
    with pytest.raises(StoreError, match="holds no store"):
        Store[Segment](tmp_path, write=False)


def test_any_database_will_do(tmp_path: Path, make_query: Ask) -> None:
    with Store[Segment](tmp_path, url=f"sqlite:///{tmp_path / 'other.db'}") as store:
        store.ask([make_query()])
        assert store.counts()["asked"] == 1


def test_a_full_disk_is_an_error_and_loses_nothing(store: Store[Segment], make_pairs: Pairs) -> None:
    kept, *late = make_pairs(201)
    store.ask([kept])
    assert store.log._writer is not None
    with store.log._writer.connect() as connection:
        pages = connection.exec_driver_sql("PRAGMA page_count").scalar()
        connection.exec_driver_sql(f"PRAGMA max_page_count={pages}")
    with pytest.raises(StoreFull, match="is full"):
        store.ask(late)
    assert [q.id for q in store.open_queries()] == [kept.id]
    with store.log._writer.connect() as connection:
        connection.exec_driver_sql("PRAGMA max_page_count=1000000")
    store.ask(late)  # there is room again
    assert len(store.open_queries()) == 201


def test_a_store_of_the_first_version_is_brought_up_to_date_after_a_copy(tmp_path: Path) -> None:
    shutil.copy(Path(__file__).parent / "data/store-1/store.db", tmp_path / "store.db")
    with pytest.raises(StoreError, match="made by an older prefrl"):
        Store[Response](tmp_path, write=False)
    with Store[Response](tmp_path) as store:
        assert store.counts() == {"asked": 4, "answered": 5, "skipped": 2}
        assert store.sequence == 23
        assert {(j.judgement.labeler, type(j.judgement).__name__) for j in store.judged()} == {
            ("ann", "Ranking"),
            ("ann", "Comparison"),
            ("bob", "Comparison"),
            ("bob", "Choice"),
            ("bob", "Rating"),
        }
    assert verify_store(tmp_path).faults == []
    (copy,) = (tmp_path / "backups").iterdir()
    with sqlite3.connect(copy) as connection:
        assert connection.execute("SELECT value FROM meta WHERE key = 'schema'").fetchall() == [("1",)]
    connection.close()


def test_migrations_make_the_tables_that_new_stores_have(tmp_path: Path) -> None:
    shutil.copy(Path(__file__).parent / "data/store-1/store.db", tmp_path / "store.db")
    Store[Response](tmp_path).close()
    Store[Response](tmp_path / "new").close()

    def described(path: Path) -> set[tuple[str, str, str]]:
        with sqlite3.connect(path) as connection:
            of_ours = "SELECT type, name, tbl_name FROM sqlite_master WHERE name <> 'sqlite_sequence'"
            rows = connection.execute(of_ours).fetchall()
        connection.close()
        return set(rows)

    assert described(tmp_path / "store.db") == described(tmp_path / "new" / "store.db")


def test_a_disk_that_fills_up_inside_a_savepoint_is_said_to_be_full(text_store: Store[Response]) -> None:
    queries = [Query((Response(f"p{i}", "a"), Response(f"p{i}", "b"))) for i in range(400)]
    text_store.ask(queries)
    assert text_store.log._writer is not None
    with text_store.log._writer.connect() as connection:
        pages = connection.exec_driver_sql("PRAGMA page_count").scalar()
        connection.exec_driver_sql(f"PRAGMA max_page_count={pages}")

    def fill() -> None:
        with text_store.log.transaction() as tx:
            for query in queries:
                with tx.savepoint():
                    text_store.put(tx, Comparison(query.id, 1.0), {"comment": "x" * 500})

    with pytest.raises(StoreFull, match="is full"):
        fill()
    assert text_store.judged() == []


@pytest.mark.parametrize("url", ["not a url", "foo+bar://somewhere"])
def test_what_names_no_database_is_refused_without_a_word_of_it(tmp_path: Path, url: str) -> None:
    (tmp_path / "store.url").write_text(url)
    for use in (lambda: Store[Segment](tmp_path), lambda: verify_store(tmp_path)):
        with pytest.raises(StoreError, match="expected a SQLAlchemy URL") as caught:
            use()
        assert url not in str(caught.value)
