import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from prefrl.files import DamagedError
from prefrl.log import StoreError, StoreFull
from prefrl.maintenance import verify_store
from prefrl.store import Store
from prefrl.types import Comparison, Query, Ranking, Response, Segment, Skip

Ask = Callable[..., Query[Segment]]


def test_what_was_asked_and_answered_is_there_after_reopening(store: Store[Segment], make_query: Ask) -> None:
    query = make_query()
    store.ask([query])
    store.answer([Comparison(query.id, 0.7, "me", (1, 0))])
    store.close()
    with Store[Segment](store.folder, write=False) as again:
        (judged,) = again.judged()
    assert judged.query.id == query.id
    assert judged.judgement == Comparison(query.id, 0.7, "me", (1, 0))
    np.testing.assert_array_equal(judged.query.candidates[0].actions, query.candidates[0].actions)


def test_responses_come_back_as_they_were_sampled(text_store: Store[Response]) -> None:
    query = Query((Response("p", "a \u202e b", (1,), (2, 3)), Response("p", "c")))
    text_store.ask([query])
    assert {(c.text, c.tokens) for c in text_store.query(query.id).candidates} == {("a \u202e b", (2, 3)), ("c", ())}


def test_gold_is_filed_apart_and_never_comes_back_with_a_candidate(store: Store[Segment], make_query: Ask) -> None:
    query = make_query(1.0, 2.0)
    store.ask([query])
    read = store.open_queries()[0]
    assert all(c.gold is None for c in read.candidates)
    gold = [values.sum() for values in store.gold(read.candidates)]
    assert gold == [pytest.approx(c.gold.sum()) for c in query.candidates if c.gold is not None]
    assert b"gold" not in b"".join(p.read_bytes() for p in (store.folder / "blobs").rglob("*.safetensors"))


def test_asking_and_answering_again_changes_nothing(store: Store[Segment], make_query: Ask) -> None:
    query = make_query()
    for _ in range(2):
        store.ask([query])
        store.answer([Comparison(query.id, 1.0, "me")])
    store.answer([Comparison(query.id, 0.0, "me")])  # the first stands
    assert store.counts() == {"asked": 1, "answered": 1, "skipped": 0}
    assert store.judged()[0].judgement == Comparison(query.id, 1.0, "me")


def test_an_answer_can_be_taken_back_and_given_again_and_the_log_keeps_all(
    store: Store[Segment], make_query: Ask
) -> None:
    query = make_query()
    store.ask([query])
    store.answer([Comparison(query.id, 1.0, "me")])
    before = store.sequence
    store.retract(query.id, "me")
    assert store.open_queries("me")
    store.answer([Comparison(query.id, 0.0, "me")])
    assert store.judged()[0].judgement == Comparison(query.id, 0.0, "me")
    assert store.judged(upto=before)[0].judgement == Comparison(query.id, 1.0, "me")
    with pytest.raises(StoreError, match="no answer"):
        store.retract(query.id, "someone else")


def test_a_snapshot_does_not_see_what_came_later(store: Store[Segment], make_query: Ask) -> None:
    first, second = make_query(), make_query()
    store.ask([first, second])
    store.answer([Comparison(first.id, 1.0)])
    snapshot = store.sequence
    store.answer([Comparison(second.id, 1.0)])
    assert [j.query.id for j in store.judged(snapshot)] == [first.id]
    assert len(store.judged()) == 2


def test_a_skip_is_no_label_and_is_asked_again_of_others_only(store: Store[Segment], make_query: Ask) -> None:
    skipped, incomparable = make_query(), make_query()
    store.ask([skipped, incomparable])
    store.answer([Skip(skipped.id, "skip", "me"), Skip(incomparable.id, "incomparable", "me")])
    assert store.judged() == []
    assert store.open_queries("me") == []
    assert [q.id for q in store.open_queries("you")] == [skipped.id]
    assert store.counts() == {"asked": 2, "answered": 0, "skipped": 2}


@pytest.mark.parametrize("answer", [lambda q: Comparison("0" * 64, 1.0), lambda q: Ranking(q.id, (0, 1, 2))])
def test_an_answer_that_fits_no_query_is_refused(
    store: Store[Segment], make_query: Ask, answer: Callable[[Query[Segment]], Comparison | Ranking]
) -> None:
    query = make_query()
    store.ask([query])
    with pytest.raises(StoreError):
        store.answer([Comparison(query.id, 1.0), answer(query)])
    assert store.judged() == []  # all or none


def test_the_log_cannot_be_changed(store: Store[Segment], make_query: Ask) -> None:
    store.ask([make_query()])
    store.close()
    with sqlite3.connect(store.folder / "store.db") as connection:
        for statement in ("UPDATE event SET body = '{}'", "DELETE FROM event"):
            with pytest.raises(sqlite3.IntegrityError, match="append-only"):
                connection.execute(statement)
    connection.close()


def test_one_may_read_while_another_writes(store: Store[Segment], make_query: Ask) -> None:
    with Store[Segment](store.folder, write=False) as reader:
        store.ask([query := make_query()])
        assert [q.id for q in reader.open_queries()] == [query.id]
        with pytest.raises(StoreError, match="reading only"):
            reader.ask([make_query()])


def test_a_second_writer_is_told_who_holds_the_store(store: Store[Segment]) -> None:
    code = f"from pathlib import Path; from prefrl.store import Store; Store(Path({str(store.folder)!r}))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "another process is writing" in done.stderr
    assert '"pid"' in done.stderr


def test_every_answer_is_on_disk_when_the_process_is_killed(tmp_path: Path) -> None:
    code = f"""
import os, signal, numpy as np
from pathlib import Path
from prefrl.maintenance import verify_store
from prefrl.store import Store
from prefrl.types import *
store = Store(Path({str(tmp_path)!r}))
for i in range(5):
    q = Query((Response("p", f"a{{i}}"), Response("p", f"b{{i}}")))
    store.ask([q]); store.answer([Comparison(q.id, 1.0)])
os.kill(os.getpid(), signal.SIGKILL)
"""
    subprocess.run([sys.executable, "-c", code], check=False)
    with Store[Response](tmp_path) as store:  # the lock of a dead process does not bind
        assert store.counts()["answered"] == 5


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


def test_a_changed_or_missing_blob_is_noticed(store: Store[Segment], make_query: Ask) -> None:
    query, other = make_query(), make_query()
    store.ask([query, other])
    store.close()
    path = next((store.folder / "blobs").rglob(f"{query.candidates[0].id}*"))
    path.write_bytes(next((store.folder / "blobs").rglob(f"{other.candidates[0].id}*")).read_bytes())
    next((store.folder / "blobs").rglob(f"{other.candidates[1].id}*")).unlink()
    with Store[Segment](store.folder, write=False) as again:
        with pytest.raises(StoreError, match="has changed"):
            again.query(query.id)
        with pytest.raises(DamagedError, match="cannot be read"):
            again.query(other.id)


def test_any_database_will_do(tmp_path: Path, make_query: Ask) -> None:
    with Store[Segment](tmp_path, url=f"sqlite:///{tmp_path / 'other.db'}") as store:
        store.ask([make_query()])
        assert store.counts()["asked"] == 1


def test_a_full_disk_is_an_error_and_loses_nothing(store: Store[Segment], make_query: Ask) -> None:
    kept = make_query()
    store.ask([kept])
    assert store.log._writer is not None
    with store.log._writer.connect() as connection:
        pages = connection.exec_driver_sql("PRAGMA page_count").scalar()
        connection.exec_driver_sql(f"PRAGMA max_page_count={pages}")
    late = [make_query() for _ in range(200)]
    with pytest.raises(StoreFull, match="is full"):
        store.ask(late)
    assert [q.id for q in store.open_queries()] == [kept.id]
    with store.log._writer.connect() as connection:
        connection.exec_driver_sql("PRAGMA max_page_count=1000000")
    store.ask(late)  # there is room again
    assert len(store.open_queries()) == 201


def test_of_two_answers_given_at_once_the_first_stands(store: Store[Segment], make_query: Ask) -> None:
    store.ask([query := make_query()])
    store.answer([Comparison(query.id, 1.0, "me"), Comparison(query.id, 0.0, "me")])
    assert store.judged()[0].judgement == Comparison(query.id, 1.0, "me")


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
