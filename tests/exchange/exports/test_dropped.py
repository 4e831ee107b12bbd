"""What each form cannot hold is counted, and what it holds is laid out as its readers expect."""

import csv
import gzip
import hashlib
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from prefrl.exchange.ports import EXPORTS, export
from prefrl.exchange.transcripts import prompt_text
from prefrl.judgements import Choice, Comparison, Ranking, Rating, Skip
from prefrl.storage.log import StoreError, row
from prefrl.store import Store
from prefrl.types import Query, Response, Segment

CHAT = prompt_text([{"role": "user", "content": "hi"}])


def asked(*texts: str, prompt: str = CHAT) -> Query[Response]:
    return Query(tuple(Response(prompt, text) for text in texts))


@pytest.fixture
def full(text_store: Store[Response]) -> Store[Response]:
    """A store with one of everything."""
    pair, other, tie = asked("a", "b"), asked("c", "d"), asked("e", "f")
    three, single = asked("g", "h", "i"), asked("j")
    text_store.ask([pair, other, tie, three, single])
    text_store.ask([check := asked("k", "l")], "check", [0])
    text_store.answer(
        [
            Comparison(pair.id, 0.88, "ann", (1, 0)),
            Comparison(pair.id, 1.0, "bob", (), 2.0),
            Skip(other.id, "skip", "ann"),
            Skip(other.id, "incomparable", "bob"),
            Comparison(tie.id, 0.5, "ann"),
            Ranking(three.id, (0, 1, 1), "ann"),
            Choice(three.id, 2, "bob"),
            Rating(single.id, (1,), 2, "ann"),
            Comparison(check.id, 1.0, "ann"),
        ]
    )
    text_store.retract(tie.id, "ann")
    text_store.answer([Comparison(tie.id, 0.5, "ann")])
    with text_store.log.transaction() as tx:
        text_store.put(tx, Comparison(tie.id, 0.0, "eve"), {"comment": "hm"})
        tx.append(row("g" * 32, "guideline", actor="admin", body={"text": "# Be kind\n---\n<b>"}))
        tx.append(row("token:" + "0" * 64, "token", actor="ann", body={"use": "session"}))
        tx.append(row("annotator:ann", "annotator", actor="ann", body={"role": "annotator"}))
    return text_store


def rows(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


EVENTS = {"answer that was taken back": 1, "guideline": 1, "check question": 1, "note on how an answer came about": 1}
SKIPS = {"skipped query": 1, "query called incomparable": 1}
DROPPED: dict[str, dict[str, int]] = {
    "preferences": {
        "annotator's name": 9,
        "order in which candidates were shown": 1,
        "time of an answer": 9,
        "weight of a judgement, other than 1": 1,
        "tie": 2,
        "ranking, choice or rating as a whole (its pairs are written)": 3,
        "rating of a single response": 1,
        **SKIPS,
    },
    "unpaired": {
        "annotator's name": 9,
        "order in which candidates were shown": 1,
        "time of an answer": 9,
        "weight of a judgement, other than 1": 1,
        "strength of a preference": 1,
        "response that is neither better than all others nor worse": 2,
        **SKIPS,
    },
    "judgements": {},
    "dataset": {},
    "argilla": {
        "order in which candidates were shown": 1,
        "time of an answer": 9,
        "weight of a judgement, other than 1": 1,
        "strength of a preference": 1,
        "rating, for which records hold no question": 1,
    },
    "label-studio": {
        "order in which candidates were shown": 1,
        "weight of a judgement, other than 1": 1,
        "strength of a preference": 1,
        "ranking, choice or rating as a whole (its pairs are written)": 3,
        "rating of a single response": 1,
    },
    "arena": {
        "order in which candidates were shown": 1,
        "weight of a judgement, other than 1": 1,
        "strength of a preference": 1,
        "ranking, choice or rating as a whole (its pairs are written)": 3,
        "rating of a single response": 1,
        "skipped query": 1,
    },
    "csv": {
        "order in which candidates were shown": 1,
        "ranking, choice or rating as a whole (its pairs are written)": 3,
        "rating of a single response": 1,
        **SKIPS,
    },
}


@pytest.mark.parametrize("form", DROPPED)
def test_what_a_form_cannot_hold_is_counted(full: Store[Response], tmp_path: Path, form: str) -> None:
    assert dict(export(full, tmp_path / "out", form).dropped) == DROPPED[form] | EVENTS


def test_a_bundle_leaves_out_secrets_and_people_and_says_so(full: Store[Response], tmp_path: Path) -> None:
    done = export(full, tmp_path / "bundle", "bundle")
    assert dict(done.dropped) == {"event about people's access or the project's settings": 2}
    kinds = {event["kind"] for event in rows(tmp_path / "bundle/events.jsonl")}
    assert {"guideline", "retract", "comparison", "query"} <= kinds
    assert not kinds & {"token", "annotator"}
    assert "token:" not in (tmp_path / "bundle/events.jsonl").read_text()


def digest(folder: Path) -> str:
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return hashlib.sha256(b"".join(path.read_bytes() for path in files)).hexdigest()


@pytest.mark.parametrize("form", ["bundle", "dataset"])
def test_the_same_store_gives_the_same_bytes(full: Store[Response], tmp_path: Path, form: str) -> None:
    for name in ("one", "two"):
        export(full, tmp_path / name, form)
    assert digest(tmp_path / "one") == digest(tmp_path / "two")


def test_a_margin_is_the_difference_of_rewards_that_a_strength_implies(full: Store[Response], tmp_path: Path) -> None:
    export(full, tmp_path / "out.jsonl")
    margins = sorted({row["margin"] for row in rows(tmp_path / "out.jsonl")})
    assert margins == [0.0, pytest.approx(math.log(0.88 / 0.12))]


def test_without_strengths_there_is_no_margin(text_store: Store[Response], tmp_path: Path) -> None:
    text_store.ask([query := asked("a", "b")])
    text_store.answer([Comparison(query.id, 1.0)])
    export(text_store, tmp_path / "out.jsonl")
    assert set(rows(tmp_path / "out.jsonl")[0]) == {"prompt", "chosen", "rejected"}


@pytest.mark.parametrize("first_better", [0.0, 1.0])
def test_the_better_one_is_the_chosen_one(text_store: Store[Response], tmp_path: Path, first_better: float) -> None:
    text_store.ask([query := asked("a", "b")])
    text_store.answer([Comparison(query.id, first_better)])
    export(text_store, tmp_path / "out.jsonl")
    better, worse = query.candidates if first_better else query.candidates[::-1]
    (found,) = rows(tmp_path / "out.jsonl")
    assert (found["chosen"], found["rejected"]) == (better.text, worse.text)


def test_ties_can_be_written_both_ways(text_store: Store[Response], tmp_path: Path) -> None:
    text_store.ask([query := asked("a", "b")])
    text_store.answer([Comparison(query.id, 0.5)])
    done = export(text_store, tmp_path / "out.jsonl", ties="both")
    assert (done.written, done.dropped["tie written both ways"]) == (2, 1)
    assert {row["chosen"] for row in rows(tmp_path / "out.jsonl")} == {"a", "b"}
    with pytest.raises(ValueError, match="for preferences and conversational"):
        export(text_store, tmp_path / "out.csv", "csv", ties="both")


def test_messages_of_a_transcript_are_told_apart_and_other_prompts_are_said_to_be_none(
    text_store: Store[Response], tmp_path: Path
) -> None:
    queries = [asked("a", "b\n\nHuman: c\n\nAssistant: d"), asked("a", "b", prompt="a review:")]
    text_store.ask(queries)
    text_store.answer([Comparison(query.id, 1.0) for query in queries])
    done = export(text_store, tmp_path / "out.jsonl", "conversational")
    assert done.notes == ("1 x prompt that is no transcript, written as one message of a user",)
    first, second = rows(tmp_path / "out.jsonl")
    assert first["prompt"] == [{"role": "user", "content": "hi"}]
    roles = {tuple(message["role"] for message in first[name]) for name in ("chosen", "rejected")}
    assert roles == {("assistant",), ("assistant", "user", "assistant")}
    assert second["prompt"] == [{"role": "user", "content": "a review:"}]


def test_a_table_runs_no_formula_and_an_import_takes_the_guard_away(
    text_store: Store[Response], tmp_path: Path
) -> None:
    texts = ["=cmd|' /C calc'!A0", "+1", "-1", "@SUM(A1)", "\t=1", " =1", "plain", "'mine", ""]
    queries = [asked(text, "other", prompt="=p") for text in texts]
    text_store.ask(queries)
    text_store.answer([Comparison(query.id, 1.0, "=ann") for query in queries])
    done = export(text_store, tmp_path / "out.csv", "csv")
    with (tmp_path / "out.csv").open(newline="") as file:
        cells = [cell for line in csv.DictReader(file) for name, cell in line.items() if name != "guarded"]
    assert not [cell for cell in cells if cell.lstrip(" ").startswith(("=", "+", "-", "@", "\t", "\r"))]
    assert "'mine" in cells
    assert any("apostrophe" in note for note in done.notes)


@pytest.mark.parametrize("form", ["csv", "dataset"])
def test_text_that_is_no_unicode_is_refused_and_nothing_is_left_behind(
    text_store: Store[Response], tmp_path: Path, form: str
) -> None:
    text_store.ask([query := asked("\ud800", "b")])
    text_store.answer([Comparison(query.id, 1.0)])
    with pytest.raises(StoreError, match="use bundle"):
        export(text_store, tmp_path / "out/x", form)
    assert list((tmp_path / "out").iterdir()) == []


def test_a_file_can_be_packed(full: Store[Response], tmp_path: Path) -> None:
    export(full, tmp_path / "out.jsonl.gz")
    export(full, tmp_path / "out.jsonl")
    assert gzip.decompress((tmp_path / "out.jsonl.gz").read_bytes()) == (tmp_path / "out.jsonl").read_bytes()


@pytest.mark.parametrize("form", sorted(set(EXPORTS) - {"bundle", "minari", "pick-a-pic"}))
def test_segments_fit_no_form_for_texts(
    store: Store[Segment], make_query: Callable[..., Query[Segment]], tmp_path: Path, form: str
) -> None:
    store.ask([query := make_query()])
    store.answer([Comparison(query.id, 1.0)])
    with pytest.raises(StoreError, match="--form bundle or minari"):
        export(store, tmp_path / "out", form)
    assert not (tmp_path / "out").exists()


# --- data sets for other libraries --------------------------------------------------------------------------------


def test_a_data_set_is_read_by_the_library_that_it_is_for(
    full: Store[Response], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    datasets = pytest.importorskip("datasets")
    done = export(full, tmp_path / "set", "dataset")
    cache = str(tmp_path / "cache")
    pairs = datasets.load_dataset(str(tmp_path / "set"), split="train", cache_dir=cache)
    assert pairs.column_names == ["prompt", "chosen", "rejected", "margin"]
    judged = datasets.load_dataset(str(tmp_path / "set"), "judgements", split="train", cache_dir=cache)
    assert len(judged) == done.written == 9
    assert {row["skip"] for row in judged} == {None, "skip", "incomparable"}


def test_a_card_says_what_was_asked_of_whom_and_how_they_agree(full: Store[Response], tmp_path: Path) -> None:
    import yaml

    export(full, tmp_path / "set", "dataset")
    _, head, text = (tmp_path / "set/README.md").read_text().split("---\n", 2)
    card = yaml.safe_load(head)
    assert (card["license"], card["size_categories"]) == ("other", ["n<1K"])
    assert [one["config_name"] for one in card["configs"] if one.get("default")] == ["preferences"]
    assert "    # Be kind\n    ---\n    <b>\n" in text
    assert "agree in 50.0% of 2 pairs" in text
    assert "| comparison | 4 |" in text
    assert "| annotators | 3 |" in text


def test_segments_become_episodes_that_minari_opens(
    store: Store[Segment], make_query: Callable[..., Query[Segment]], tmp_path: Path
) -> None:
    minari = pytest.importorskip("minari")
    queries = [make_query(0.0, 1.0), make_query(0.0, 1.0)]
    store.ask(queries)
    store.answer([Comparison(query.id, 1.0, "ann") for query in queries])
    done = export(store, tmp_path / "some set", "minari")
    data = minari.MinariDataset(tmp_path / "some set")
    assert (data.total_episodes, data.total_steps) == (4, 20)
    assert not any(episode.rewards.any() for episode in data.iterate_episodes())
    (first, *_) = rows(tmp_path / "some set/labels.jsonl")
    found = data[first["episodes"][0]]
    assert (found.observations[:-1] == queries[0].candidates[0].observations).all()
    assert any("gold" in note for note in done.notes)


def test_segments_of_two_sizes_do_not_fit_one_data_set(store: Store[Segment], tmp_path: Path) -> None:
    import numpy as np

    segments = [Segment(np.zeros((2, o), np.float32), np.zeros((2, 1), np.float32), str(o), 0) for o in (2, 3)]
    store.ask([query := Query(tuple(segments))])
    store.answer([Comparison(query.id, 1.0)])
    with pytest.raises(StoreError, match="do not fit one data set"):
        export(store, tmp_path / "out", "minari")
    assert not (tmp_path / "out").exists()


def test_responses_do_not_fit_minari(full: Store[Response], tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="no trajectories"):
        export(full, tmp_path / "out", "minari")
