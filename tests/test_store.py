"""What holds of a store on every database that it may be kept in: the same tests on each."""

import contextlib
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from stores import derived, fill, responses

from prefrl.judgements import Comparison, Demonstration, Ranking, Skip
from prefrl.storage.files import DamagedError
from prefrl.storage.log import StoreError
from prefrl.storage.maintenance import backup, verify_store
from prefrl.storage.projection import dump, rebuild
from prefrl.store import Store
from prefrl.types import Query, Response, Segment

Ask = Callable[..., Query[Segment]]


@pytest.fixture(params=["sqlite", "postgresql"])
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    """A folder for a new store, whose log is kept in one database or the other."""
    folder = tmp_path / "store"
    folder.mkdir()
    if request.param == "postgresql":
        (folder / "store.url").write_text(f"{request.getfixturevalue('postgres_url')}\n")
    return folder


@pytest.fixture
def store(folder: Path) -> Iterator[Store[Segment]]:
    with Store[Segment](folder) as opened:
        yield opened


@pytest.fixture
def text_store(folder: Path) -> Iterator[Store[Response]]:
    with Store[Response](folder) as opened:
        yield opened


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


def test_of_two_answers_given_at_once_the_first_stands(store: Store[Segment], make_query: Ask) -> None:
    store.ask([query := make_query()])
    store.answer([Comparison(query.id, 1.0, "me"), Comparison(query.id, 0.0, "me")])
    assert store.judged()[0].judgement == Comparison(query.id, 1.0, "me")


KILLED = """
import os, signal, sys
from pathlib import Path
from typing import Any, cast
from prefrl.judgements import *
from prefrl.store import Store
from prefrl.types import *
store = Store(Path(sys.argv[1]))
for i in range(5):
    q = Query((Response("p", f"a{i}"), Response("p", f"b{i}")))
    store.ask([q]); store.answer([Comparison(q.id, 1.0)])
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_every_answer_is_on_disk_when_the_process_is_killed(folder: Path) -> None:
    subprocess.run([sys.executable, "-c", KILLED, str(folder)], check=False)
    with opened_soon(folder) as store:  # the lock of a dead process does not bind
        assert store.counts()["answered"] == 5


def opened_soon(folder: Path) -> Store[Response]:
    """A server may take a moment to notice that a process is gone."""
    for _ in range(50):
        with contextlib.suppress(StoreError):
            return Store[Response](folder)
        time.sleep(0.1)
    return Store[Response](folder)


def check_rebuilt(store: Store[Response]) -> None:
    """The derived tables are the same when they are written again from the log."""
    before = derived(store.folder)
    with store.log.transaction() as tx:
        rebuild(tx.connection)
    with store.log.reading() as connection:
        assert list(dump(connection)) == before


def test_derived_tables_are_the_same_when_written_again(text_store: Store[Response]) -> None:
    fill(text_store)
    check_rebuilt(text_store)


def test_a_transaction_that_fails_leaves_nothing(text_store: Store[Response]) -> None:
    first, second = responses(2)
    text_store.ask([first])
    with pytest.raises(StoreError, match="never asked"):
        text_store.answer([Comparison(first.id, 1.0), Comparison(second.id, 1.0)])
    with text_store.log.transaction() as tx:
        text_store.put(tx, Comparison(first.id, 1.0, "a"), {})
        with contextlib.suppress(StoreError), tx.savepoint():
            text_store.put(tx, Comparison(first.id, 1.0, "b"), {})
            raise StoreError("no")
    assert [a.labeler for a in text_store.answers()] == ["a"]
    assert verify_store(text_store.folder).ok


def test_a_store_verifies_and_is_copied_while_it_is_open(text_store: Store[Response], tmp_path: Path) -> None:
    fill(text_store)
    assert backup(text_store.folder, tmp_path / "copy") == verify_store(text_store.folder).events
    assert verify_store(tmp_path / "copy").ok


def test_progress_counts_queries_however_many_people_answer(text_store: Store[Response]) -> None:
    queries = responses(4)
    text_store.ask(queries)
    text_store.ask(responses(1, 3), "check", [0])
    text_store.answer([Comparison(queries[0].id, 1.0, who) for who in ("a", "b", "c")])
    text_store.answer([Skip(queries[0].id, "skip", "d"), Skip(queries[1].id, "skip", "d")])
    text_store.answer([Skip(queries[1].id, "incomparable", "e"), Skip(queries[2].id, "incomparable", "e")])
    assert text_store.progress() == (4, 1, 2)


def test_nothing_is_learned_from_check_questions(text_store: Store[Response]) -> None:
    (label, check) = responses(2)
    text_store.ask([label])
    text_store.ask([check], "check", [0])
    text_store.answer([Comparison(query.id, 1.0, "ann") for query in (label, check)])
    assert [one.query.id for one in text_store.judged()] == [label.id]
    assert [one.query for one in text_store.answers()] == [label.id]


def test_numbers_that_numpy_made_are_kept(folder: Path) -> None:
    query, pair = Query(tuple(Response("p", text) for text in "abc")), Query((Response("p", "a"), Response("p", "d")))
    ranks: Any = tuple(np.argsort([3, 1, 2]))
    with Store[Response](str(folder)) as store:
        store.ask([query, pair])
        store.answer([Ranking(query.id, ranks, "ann"), Comparison(pair.id, float(np.float32(0.25)), "ann")])
        store.answer([Comparison(pair.id, cast(Any, np.float32(0.75)), "ben")])
    with Store[Response](folder, write=False) as store:
        assert [a.ranks for a in store.answers() if isinstance(a, Ranking)] == [(1, 2, 0)]
        assert [a.preference for a in store.answers() if isinstance(a, Comparison)] == [0.25, 0.75]


def test_demonstrations_come_back_with_what_they_show_and_close_their_queries(text_store: Store[Response]) -> None:
    asked = [Query((Response(f"p{i}", "so so", (1,), (2, 3)),)) for i in range(3)]
    text_store.ask(asked)
    better = Response("p0", "good", (1,), (4,), gold=np.array([1.0]))
    text_store.keep([better])
    itself = asked[1].candidates[0]
    text_store.answer([Demonstration(asked[0].id, better.id, "ann", weight=2.0)])
    text_store.answer([Demonstration(asked[1].id, itself.id, "ann")])
    first, second = text_store.demonstrations()
    assert (first.like.text, first.like.tokens, first.like.gold, first.demonstration.weight) == ("good", (4,), None, 2)
    assert second.like.id == itself.id
    assert text_store.judged() == []
    assert [q.id for q in text_store.open_queries()] == [asked[2].id]
    assert text_store.counts() == {"asked": 3, "answered": 2, "skipped": 0, "demonstrations": 2}
    text_store.retract(asked[0].id, "ann")
    assert text_store.counts() == {"asked": 3, "answered": 1, "skipped": 0, "demonstrations": 1}
    assert [one.like.id for one in text_store.demonstrations()] == [itself.id]
    check_rebuilt(text_store)


def test_a_demonstration_of_what_is_not_here_or_of_another_prompt_is_refused(text_store: Store[Response]) -> None:
    query, other = Query((Response("p", "so so"),)), Response("q", "good")
    text_store.ask([query])
    with pytest.raises(StoreError, match="which the store does not hold"):
        text_store.answer([Demonstration(query.id, other.id, "ann")])
    text_store.keep([other])
    with pytest.raises(StoreError, match="another context"):
        text_store.answer([Demonstration(query.id, other.id, "ann")])
    assert text_store.demonstrations() == []
