"""A bundle that is damaged, or says what no store says, is refused whole, with the number of the event."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
from stores import seal

from prefrl.exchange.bundles import export_bundle, import_bundle
from prefrl.exchange.ports import try_import
from prefrl.judgements import Comparison, Ranking
from prefrl.store import Store
from prefrl.types import Query, Response, Segment

HUGE = 10**400


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A bundle of one answer to one question: four events."""
    folder = tmp_path_factory.mktemp("whole")
    query = Query((Response("7", "a", (), (5,)), Response("7", "b", (), (5,))))
    with Store[Response](folder / "store") as store:
        store.ask([query])
        store.answer([Comparison(query.id, 1.0, "x", (0, 1))])
        export_bundle(store, folder / "bundle")
    return folder / "bundle"


def read(bundle: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in (bundle / "events.jsonl").read_text().splitlines()]


def bundle_of(folder: Path, *events: Mapping[str, Any]) -> Path:
    """A bundle that says these, with a manifest that fits."""
    folder.mkdir(exist_ok=True)
    (folder / "events.jsonl").write_text("".join(json.dumps(event) + "\n" for event in events))
    seal(folder)
    return folder


def said(kind: str, **body: Any) -> dict[str, Any]:
    return {"kind": kind, "body": {"shown": [0, 1], **body}}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"at": "yesterday"}, "at: expected a time"),
        ({"at": "2026-02-31T10:00:00+00:00"}, "day"),
        ({"at": "2026-02-03"}, "at: expected a time"),
        ({"actor": "x\ud800"}, "actor: expected text that is valid Unicode"),
        ({"actor": "x\0"}, "without NUL"),
        ({"actor": 5}, "actor: expected text"),
        ({"body": [1]}, "'list' object"),
        (said("comparison", preference=1.0, shown=[5, "x"]), "shown: expected each of 0 to 1 once"),
        (said("comparison", preference=1.0, shown=[0, 0]), "shown: expected each of 0 to 1 once"),
        (said("comparison", preference=1.0, shown=[False, True]), "shown: expected each of 0 to 1 once"),
        (said("comparison", preference=True), "a preference that is a number"),
        (said("comparison", preference=7), "a preference must lie in"),
        (said("comparison", preference=1.0, weight="1"), "not supported"),
        (said("comparison", preference=1.0, weight=HUGE), "too large"),
        (said("comparison", preference=1.0, more=1), "unexpected keyword"),
        (said("comparison", preference=1.0, labeler="other"), "multiple values"),
        (said("comparison"), "missing 1 required"),
        (said("comparison", preference=1.0, about={"digest": {}}), "about.digest: expected str"),
        (said("comparison", preference=1.0, about={"timings": 5}), "about.timings: expected dict"),
        (said("comparison", preference=1.0, about={"timings": {"decision_ms": "1"}}), "decision_ms: expected a number"),
        (said("comparison", preference=1.0, about={"more": HUGE}), "too large"),
        (said("comparison", preference=1.0, about=json.loads("[" * 50 + "]" * 50)), "nested more than 20 deep"),
        (said("skip", reason="comparison"), "the reason skip or incomparable"),
        (said("skip", reason=[1]), "the reason skip or incomparable"),
        (said("skip", reason="retracted"), "the reason skip or incomparable"),
        (said("choice", best=0.5), "the best candidate is counted from 0, got 0.5"),
        (said("choice", best=True), "the best candidate is counted from 0, got True"),
        (said("ranking", ranks=[0.5, 1]), "a ranking needs a whole rank"),
        (said("ranking", ranks=[False, True]), "a ranking needs a whole rank"),
        (said("ranking", ranks=[0, 10**10]), "ranks that are whole numbers up to 2147483647"),
        (said("ranking", ranks="01"), "a ranking needs a whole rank"),
        (said("rating", levels=[0.5, 1], scale=3), "a rating needs whole levels"),
        (said("rating", levels=[0, 1], scale=10**9), "a scale of at most 10000"),
        (said("retract"), "is not that of this labeler's next word"),
        ({"id": "f" * 64 + ":x:0"}, "is not that of this labeler's next word"),
        (said("assign", purpose="label"), "is not that of an event of kind 'assign'"),
        (said("flag", text="t"), "is not that of an event of kind 'flag'"),
    ],
)
def test_an_event_that_says_what_no_store_says_is_refused_with_its_number(
    whole: Path, tmp_path: Path, change: dict[str, Any], message: str
) -> None:
    *rest, last = read(whole)
    with pytest.raises(ValueError, match="event 4 cannot be merged") as caught:
        try_import(bundle_of(tmp_path, *rest, last | change), None)
    assert message in str(caught.value)


@pytest.mark.parametrize(
    ("number", "change", "message"),
    [
        (0, {"tokens": ["5"]}, "tokens that are no numbers"),
        (0, {"tokens": [5.5]}, "tokens that are no numbers"),
        (0, {"tokens": [HUGE]}, "too large"),
        (0, {"type": "segment"}, "cannot be read"),
        (0, {"prompt": 7}, "is not described as it is"),
        (0, {"more": 5}, "is not described as it is"),
        (2, {"purpose": "check"}, "is a check, and names its best"),
        (2, {"purpose": "check", "expected": True}, "is a check, and names its best"),
        (2, {"expected": 0}, "is a check, and names its best"),
        (2, {"batch": 0.5}, "the number of its batch"),
        (2, {"candidates": []}, "at least one candidate"),
        (2, {"candidates": ["f" * 64]}, "is missing"),
    ],
)
def test_a_question_that_is_not_as_questions_are_is_refused_with_its_number(
    whole: Path, tmp_path: Path, number: int, change: dict[str, Any], message: str
) -> None:
    events = read(whole)
    events[number]["body"] |= change
    with pytest.raises(ValueError, match=f"event {number + 1} cannot be merged") as caught:
        try_import(bundle_of(tmp_path, *events), None)
    assert message in str(caught.value)


def test_candidates_out_of_order_or_of_two_kinds_are_refused(
    store: Store[Segment], make_query: Callable[..., Query[Segment]], whole: Path, tmp_path: Path
) -> None:
    one, two, query, answer = read(whole)
    turned = query | {"body": {"candidates": query["body"]["candidates"][::-1]}}
    with pytest.raises(ValueError, match=r"event 3 cannot be merged: query .* does not have the sha256"):
        try_import(bundle_of(tmp_path / "bundle", one, two, turned, answer), None)
    store.ask([make_query()])
    export_bundle(store, tmp_path / "segments")
    with pytest.raises(ValueError, match="event 4 cannot be merged: a store that holds segments cannot hold"):
        try_import(bundle_of(tmp_path / "segments", *read(tmp_path / "segments"), one), None)


def test_an_answer_over_one_that_stands_is_refused(text_store: Store[Response], whole: Path, tmp_path: Path) -> None:
    *_, last = events = read(whole)
    second = last | {"id": last["id"].removesuffix("0") + "1"}
    with pytest.raises(ValueError, match="event 5 cannot be merged"):
        import_bundle(bundle_of(tmp_path / "bundle", *events, second), text_store)
    assert text_store.sequence == 0


@pytest.mark.parametrize("damage", ["blob", "events", "foreign", "path"])
def test_a_damaged_or_hostile_bundle_is_refused_whole(
    store: Store[Segment], make_query: Callable[..., Query[Segment]], tmp_path: Path, damage: str
) -> None:
    store.ask([query := make_query()])
    store.answer([Comparison(query.id, 1.0, "a")])
    bundle = tmp_path / "bundle"
    export_bundle(store, bundle)
    events = bundle / "events.jsonl"
    if damage == "blob":
        next(bundle.rglob("*.safetensors")).write_bytes(b"")
    if damage == "events":
        events.write_text(events.read_text()[:-5])
    if damage in ("foreign", "path"):
        old, new = (query.id, "f" * 64) if damage == "foreign" else (query.candidates[0].id, "../../secret")
        events.write_text(events.read_text().replace(old, new))
        seal(bundle)
    with Store[Segment](tmp_path / "copy") as copy:
        with pytest.raises(ValueError):
            import_bundle(bundle, copy)
        assert copy.counts()["asked"] == 0


@pytest.mark.parametrize("answer", ["short", "pair", "stolen", "kind"])
def test_an_answer_in_a_bundle_that_fits_no_query_is_refused(
    store: Store[Segment], make_query: Callable[..., Query[Segment]], tmp_path: Path, answer: str
) -> None:
    store.ask([query := make_query(0, 1, 2)])
    store.answer([Ranking(query.id, (0, 1, 2), "a")])
    export_bundle(store, tmp_path / "bundle")
    path = tmp_path / "bundle/events.jsonl"
    *rest, last = (json.loads(line) for line in path.read_text().splitlines())
    change = {
        "short": {"body": {"ranks": [0, 1], "shown": []}},
        "pair": {"kind": "comparison", "body": {"preference": 1.0, "shown": []}},
        "stolen": {"id": f"{query.id}:oracle:0"},
        "kind": {"kind": "verdict"},
    }[answer]
    path.write_text("".join(json.dumps(e) + "\n" for e in [*rest, last | change]))
    seal(tmp_path / "bundle")
    with Store[Segment](tmp_path / "copy") as copy:
        with pytest.raises(ValueError, match="cannot be merged"):
            import_bundle(tmp_path / "bundle", copy)
        assert copy.counts()["asked"] == 0


def test_a_bundle_that_leads_elsewhere_is_refused(
    store: Store[Segment], make_query: Callable[..., Query[Segment]], tmp_path: Path
) -> None:
    store.ask([make_query()])
    export_bundle(store, tmp_path / "bundle")
    manifest, hashes = tmp_path / "bundle/MANIFEST.json", json.loads((tmp_path / "bundle/MANIFEST.json").read_text())
    with Store[Segment](tmp_path / "copy") as copy:
        for name in ("../secret", "/etc/passwd", "a/../../b", "a\\b"):
            manifest.write_text(json.dumps(hashes | {name: "0" * 64}))
            with pytest.raises(ValueError, match="lies outside: refused"):
                import_bundle(tmp_path / "bundle", copy)
        manifest.write_text("{}")
        with pytest.raises(ValueError, match="does not name events"):
            import_bundle(tmp_path / "bundle", copy)
        manifest.write_text(json.dumps(hashes))
        blob = next((tmp_path / "bundle").rglob("*.safetensors"))
        blob.rename(tmp_path / "elsewhere")
        blob.symlink_to(tmp_path / "elsewhere")
        with pytest.raises(ValueError, match="symbolic link"):
            import_bundle(tmp_path / "bundle", copy)
        assert copy.sequence == 0
