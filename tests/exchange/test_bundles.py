"""A bundle gives a store back to the event; a damaged, hostile or contradictory one changes nothing."""

import json
import tracemalloc
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import pytest
from stores import fill, seal

from prefrl.exchange.bundles import export_bundle, import_bundle, try_bundle
from prefrl.exchange.layout import Layout
from prefrl.exchange.ports import import_judgements, try_import
from prefrl.judgements import Comparison, Demonstration, Ranking, Skip
from prefrl.storage import log
from prefrl.storage.files import DamagedError
from prefrl.storage.log import StoreError
from prefrl.store import Store
from prefrl.types import Query, Response, Segment


def texts(*names: str) -> Query[Response]:
    return Query(tuple(Response("p", name) for name in names))


def lines(*rows: Mapping[str, object]) -> str:
    return "".join(json.dumps(row) + "\n" for row in rows)


def test_a_bundle_loses_nothing(
    store: Store[Segment], make_query: Callable[..., Query[Segment]], tmp_path: Path
) -> None:
    queries = [make_query(0.0, 1.0), make_query(2.0, 3.0), make_query(0.0, 1.0, 2.0)]
    store.ask(queries)
    store.answer([Comparison(queries[0].id, 0.3, "a", (1, 0)), Ranking(queries[2].id, (0, 0, 1), "b")])
    store.answer([Skip(queries[1].id, "incomparable", "a")])
    store.retract(queries[0].id, "a")
    store.answer([Comparison(queries[0].id, 0.9, "a")])
    export_bundle(store, tmp_path / "bundle")
    with Store[Segment](tmp_path / "copy") as copy:
        assert import_bundle(tmp_path / "bundle", copy) == (4, 0)
        assert import_bundle(tmp_path / "bundle", copy) == (4, 4)  # again: nothing changes
        assert list(copy.events()) == list(store.events())
        assert copy.answers() == store.answers()
        assert [q.id for q in copy.open_queries()] == [q.id for q in store.open_queries()]
    assert not (tmp_path / "copy/gold").exists()


def test_a_bundle_that_was_changed_after_it_was_written_is_refused(text_store: Store[Response], tmp_path: Path) -> None:
    """By whoever turns an answer round, and leaves all else as it is."""
    text_store.ask([query := texts("a", "b")])
    text_store.answer([Comparison(query.id, 1.0, "me")])
    export_bundle(text_store, tmp_path / "bundle")
    events = tmp_path / "bundle/events.jsonl"
    written = events.read_text()
    events.write_text(written.replace('"preference": 1.0', '"preference": 0.0'))
    assert events.read_text() != written
    with Store[Response](tmp_path / "copy") as copy:
        for read in (import_bundle, try_bundle):
            with pytest.raises(DamagedError, match="it was changed"):
                read(tmp_path / "bundle", copy)
        assert copy.sequence == 0


def test_a_bundle_never_takes_the_place_of_other_things(
    store: Store[Segment], make_query: Callable[..., Query[Segment]]
) -> None:
    store.ask([make_query()])
    with pytest.raises(ValueError, match="would be lost"):
        export_bundle(store, store.folder)
    assert (store.folder / "store.db").exists()


def test_a_bundle_of_an_older_store_is_read(
    store: Store[Segment], make_query: Callable[..., Query[Segment]], tmp_path: Path
) -> None:
    store.ask([query := make_query()])
    store.answer([Comparison(query.id, 1.0, "a")])
    export_bundle(store, tmp_path / "bundle")
    path = tmp_path / "bundle/events.jsonl"
    older = [{"seq": n} | json.loads(line) for n, line in enumerate(path.read_text().splitlines(), 1)]
    path.write_text(lines(*older))
    seal(tmp_path / "bundle")
    with Store[Segment](tmp_path / "copy") as copy:
        assert import_bundle(tmp_path / "bundle", copy) == (1, 0)
        assert list(copy.events()) == list(store.events())


def test_assignments_repeats_and_checks_survive_in_a_bundle(text_store: Store[Response], tmp_path: Path) -> None:
    text_store.ask([query := texts("a", "b")])
    text_store.ask([texts("c", "d")], "check", [1])
    said = {"kind": "comparison", "preference": 1.0, "shown": [1, 0]}
    with text_store.log.transaction() as tx:
        for name, purpose in (("0" * 32, "label"), ("1" * 32, "repeat")):
            tx.append(log.row(name, "assign", query.id, "ann", {"shown": [1, 0], "purpose": purpose, "guideline": ""}))
        text_store.put(tx, Comparison(query.id, 1.0, "ann", (1, 0)), {"submission": "s", "comment": "why"})
        tx.append(log.row(f"repeat:{'1' * 32}", "repeat", query.id, "ann", {"answer": said, "about": {}}))
        tx.append(log.row("flag:1", "flag", query.id, "ann", {"text": "odd"}))
    export_bundle(text_store, tmp_path / "bundle")
    with Store[Response](tmp_path / "copy") as copy:
        import_bundle(tmp_path / "bundle", copy)
        assert list(copy.events()) == list(text_store.events())
        assert copy.counts() == text_store.counts()


def test_everything_that_people_do_survives(text_store: Store[Response], tmp_path: Path) -> None:
    fill(text_store)
    again = {"answer": {"kind": "comparison", "preference": 1.0}, "about": {"assignment": f"{999:032x}"}}
    with text_store.log.transaction() as tx:  # what was repeated, taken back and said again
        name = f"repeat:{999:032x}:{998:032x}"
        tx.append(log.row(name, "repeat", text_store.open_queries()[0].id, "ann", again))
    export_bundle(text_store, tmp_path / "bundle")
    secret = ("annotator", "token", "revoke", "state", "project")
    with Store[Response](tmp_path / "copy") as copy:
        import_bundle(tmp_path / "bundle", copy)
        fields = [
            [(e["id"], e["kind"], e["actor"], e["body"], e["at"]) for e in s.events()] for s in (copy, text_store)
        ]
        assert fields[0] == [one for one in fields[1] if one[1] not in secret]


# --- what a store holds already -----------------------------------------------------------------------------------


@pytest.fixture
def theirs(text_store: Store[Response], tmp_path: Path) -> Path:
    """A bundle of three answers by "me", one of them given anew; `text_store` holds two queries and one answer."""
    queries = [texts("a", "b"), texts("c", "d"), texts("e", "f")]
    with Store[Response](tmp_path / "other") as other:
        other.ask(queries)
        other.answer([Comparison(q.id, 1.0, "me") for q in queries])
        other.retract(queries[0].id, "me")
        other.answer([Comparison(queries[0].id, 0.0, "me")])
        export_bundle(other, tmp_path / "bundle")
    text_store.ask(queries[:2])
    text_store.answer([Comparison(queries[0].id, 1.0, "me")])
    return tmp_path / "bundle"


def test_what_is_there_already_is_counted_and_what_is_new_is_added(theirs: Path, text_store: Store[Response]) -> None:
    for _ in range(2):
        assert (done := try_import(theirs, text_store)) == import_judgements(theirs, text_store)
    assert (done.read, done.known) == (4, 4)
    assert text_store.counts() == {"asked": 3, "answered": 3, "skipped": 0}
    preferences = {a.query: a.preference for a in text_store.answers() if isinstance(a, Comparison)}
    assert preferences[texts("a", "b").id] == 0.0  # the newer word of the same person


def test_an_answer_that_contradicts_the_store_is_told_and_nothing_is_added(
    theirs: Path, text_store: Store[Response]
) -> None:
    text_store.answer([Comparison(texts("c", "d").id, 0.0, "me")])
    before = list(text_store.events())
    for read in (try_import, import_judgements):
        with pytest.raises(StoreError, match=r"(?s)contradicts the store 1 times.*'me' has judged query .* otherwise"):
            read(theirs, text_store)
    assert list(text_store.events()) == before


def test_a_check_on_one_side_alone_is_told(theirs: Path, text_store: Store[Response]) -> None:
    text_store.ask([texts("e", "f")], "check", [0])
    with pytest.raises(StoreError, match="is a check question on one side alone"):
        import_judgements(theirs, text_store)


def test_a_dry_run_of_texts_into_segments_fails_as_the_import_would(
    theirs: Path, store: Store[Segment], make_query: Callable[..., Query[Segment]]
) -> None:
    store.ask([make_query()])
    for read in (try_import, import_judgements):
        with pytest.raises(ValueError, match="a store that holds segments cannot hold a response"):
            read(theirs, store)


def test_a_dry_run_writes_nothing(theirs: Path, text_store: Store[Response]) -> None:
    before = list(text_store.events())
    assert try_import(theirs, text_store).known == 1
    assert try_import(theirs, None).read == 4
    assert list(text_store.events()) == before


@pytest.mark.parametrize("layout", [Layout("arena"), Layout(columns=(("prompt", "q"),)), Layout(skip_bad=True)])
def test_what_a_bundle_would_ignore_is_refused(theirs: Path, text_store: Store[Response], layout: Layout) -> None:
    with pytest.raises(ValueError, match="a bundle is read whole, as it is"):
        import_judgements(theirs, text_store, None, layout)


def test_a_bundle_is_read_without_having_all_of_it_in_memory(
    store: Store[Segment], tmp_path: Path, rng: np.random.Generator
) -> None:
    for batch in range(2):
        segments = [
            Segment(rng.normal(size=(50, 500)).astype(np.float32), np.zeros((50, 1), np.float32), f"{batch}-{i}", 0)
            for i in range(50)
        ]
        store.ask([Query(pair) for pair in zip(segments[::2], segments[1::2], strict=True)])
    export_bundle(store, tmp_path / "bundle")
    size = sum(path.stat().st_size for path in (tmp_path / "bundle/blobs").rglob("*.safetensors"))
    with Store[Segment](tmp_path / "copy") as copy:
        tracemalloc.start()
        import_bundle(tmp_path / "bundle", copy)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert copy.counts()["asked"] == 50
    assert peak < size * 2 / 3, f"{peak / 2**20:.1f} MB for {size / 2**20:.1f} MB"


def test_demonstrations_survive_in_a_bundle_and_those_of_nothing_are_refused(
    store: Store[Segment], make_query: Callable[..., Query[Segment]], tmp_path: Path
) -> None:
    query, like = make_query(0.0), make_query(5.0).candidates[0]
    store.ask([query])
    store.keep([like])
    store.answer([Demonstration(query.id, like.id, "expert")])
    export_bundle(store, tmp_path / "bundle")
    with Store[Segment](tmp_path / "copy") as copy:
        assert import_bundle(tmp_path / "bundle", copy) == (1, 0)
        (shown,) = copy.demonstrations()
        np.testing.assert_array_equal(shown.like.observations, like.observations)
        assert list(copy.events()) == list(store.events())
    events = (tmp_path / "bundle/events.jsonl").read_text().splitlines(keepends=True)
    gone = [line for line in events if json.loads(line)["id"] != like.id]
    (tmp_path / "bundle/events.jsonl").write_text("".join(gone))
    seal(tmp_path / "bundle")
    with Store[Segment](tmp_path / "other") as other, pytest.raises(ValueError, match="which is not there"):
        import_bundle(tmp_path / "bundle", other)
