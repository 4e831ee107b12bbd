import gzip
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prefrl.exchange.formats import check_file, read_judgements
from prefrl.exchange.layout import Layout, Which
from prefrl.exchange.ports import import_judgements
from prefrl.exchange.text_rows import parse
from prefrl.judgements import Choice, Comparison, Judged, Ranking, Rating
from prefrl.storage.log import StoreError
from prefrl.store import Store
from prefrl.types import Response, Segment

PAIR = {"prompt": "p", "chosen": "yes", "rejected": "no"}
RANKED = {"prompt": "p", "responses": ["a", "b", "c"], "ranks": [2, 0, 0]}


@pytest.fixture
def lines(tmp_path: Path) -> Callable[..., Path]:
    def write(*rows: Mapping[str, object] | str) -> Path:
        path = tmp_path / "rows.jsonl"
        path.write_text("".join((row if isinstance(row, str) else json.dumps(row)) + "\n" for row in rows))
        return path

    return write


@pytest.fixture
def pairs(tmp_path: Path) -> Callable[..., Path]:
    """An .npz of three training pairs and one evaluation pair; keywords change arrays or, as None, leave them out."""

    def write(**changes: Any) -> Path:
        rng, arrays = np.random.default_rng(0), dict[str, Any]()
        for split, count in (("train", 3), ("eval", 1)):
            for side in ("1", "2"):
                arrays[f"{split}_obs_{side}"] = rng.normal(size=(count, 5, 3)).astype(np.float32)
                arrays[f"{split}_action_{side}"] = rng.normal(size=(count, 5, 2)).astype(np.float32)
            arrays[f"{split}_label_human"] = np.array([0.0, 1.0, 0.5], np.float32)[:count]
            arrays[f"{split}_label_script"] = np.array([1, 0, 0])[:count]
        arrays = {name: value for name, value in (arrays | changes).items() if value is not None}
        np.savez(tmp_path / "pairs.npz", **arrays)
        return tmp_path / "pairs.npz"

    return write


def one(row: Mapping[str, object]) -> Judged[Response]:
    (found,) = parse(dict(row))
    assert not isinstance(found, str)
    return found.judged


def by_text(judged: Judged[Response], values: tuple[int, ...]) -> dict[str, int]:
    return {c.text: v for c, v in zip(judged.query.candidates, values, strict=True)}


# --- text ---------------------------------------------------------------------------------------------------------


@given(st.lists(st.text(max_size=3), min_size=2, max_size=8, unique=True), st.data())
def test_each_response_keeps_its_own_rank_rating_and_place_in_whatever_order_they_come(
    texts: list[str], data: st.DataObject
) -> None:
    values = data.draw(st.lists(st.integers(0, 4), min_size=len(texts), max_size=len(texts)))
    row = {"prompt": "p", "responses": texts}
    ranking, rating = one(row | {"ranks": values}), one(row | {"ratings": values, "scale": 5})
    assert isinstance(ranking.judgement, Ranking)
    assert isinstance(rating.judgement, Rating)
    assert by_text(ranking, ranking.judgement.ranks) == by_text(rating, rating.judgement.levels)
    assert by_text(ranking, ranking.judgement.ranks) == dict(zip(texts, values, strict=True))
    choice = one(row | {"best": values[0] % len(texts)})
    assert isinstance(choice.judgement, Choice)
    assert choice.query.candidates[choice.judgement.best].text == texts[values[0] % len(texts)]


@pytest.mark.parametrize("texts", [["a", "b"], ["b", "a"]])
def test_a_preference_is_that_of_the_first_response(texts: list[str]) -> None:
    judged = one({"prompt": "p", "responses": texts, "preference": 0.8, "labeler": "ann", "weight": 2})
    assert isinstance(judged.judgement, Comparison)
    first = judged.query.candidates[0].text == texts[0]
    assert judged.judgement.preference == pytest.approx(0.8 if first else 0.2)
    assert (judged.judgement.labeler, judged.judgement.weight) == ("ann", 2.0)


def message(role: str, text: str, *replies: object, rank: int | None = None) -> dict[str, Any]:
    return {"role": role, "text": text, "rank": rank, "replies": list(replies)}


def test_a_conversation_tree_is_a_ranking_for_each_conversation_so_far(lines: Callable[..., Path]) -> None:
    again = message("prompter", "and?", message("assistant", "w", rank=1), message("assistant", "v", rank=0))
    root = message(
        "prompter",
        "hi",
        message("assistant", "x", again, rank=0),
        message("assistant", "y", message("prompter", "no", message("assistant", "z")), rank=1),
        message("assistant", "unranked"),
    )
    read = read_judgements(lines({"message_tree_id": "1", "prompt": root}))
    found = {j.query.candidates[0].prompt: by_text(j, j.judgement.ranks) for j in read.judged}  # type: ignore[union-attr]
    assert found == {
        "Human: hi\n\nAssistant: ": {"x": 0, "y": 1},
        "Human: hi\n\nAssistant: x\n\nHuman: and?\n\nAssistant: ": {"v": 0, "w": 1},
    }
    assert sorted(read.notes) == [
        "left out: 1 x prompt with fewer than two ranked replies",
        "left out: 1 x reply without a rank beside ranked ones",
    ]


def test_a_compressed_file_reads_as_a_plain_one_and_a_damaged_one_is_refused(
    lines: Callable[..., Path], tmp_path: Path
) -> None:
    plain, packed = lines(PAIR, RANKED), tmp_path / "rows.jsonl.gz"
    packed.write_bytes(gzip.compress(plain.read_bytes()))
    assert [j.query.id for j in read_judgements(packed).judged] == [j.query.id for j in read_judgements(plain).judged]
    for damaged in (packed.read_bytes()[:-12], b"not gzip"):
        packed.write_bytes(damaged)
        with pytest.raises(ValueError, match="no whole gzip file"):
            read_judgements(packed)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (RANKED | {"ranks": [0, 1]}, "ranks: expected an integer for each of 3 responses, got [0, 1]"),
        (RANKED | {"ranks": [0, 1, True]}, "ranks: expected an integer"),
        (RANKED | {"ranks": [0, -1, 1]}, "a whole rank >= 0"),
        (RANKED | {"responses": ["a"], "ranks": [0]}, "at least 2 candidates"),
        (RANKED | {"responses": ["a", "a", "b"]}, "may not compare a candidate with itself"),
        (RANKED | {"best": 0}, "expected one of ranks, best, ratings, preference, skip, got ranks, best"),
        ({"prompt": "p", "responses": ["a", "b"]}, "got none"),
        ({"prompt": "p", "responses": ["a", 3], "best": 0}, "expected responses that are strings"),
        ({"responses": ["a", "b"], "best": 0}, 'expected "prompt": string'),
        ({"prompt": "p", "responses": ["a", "b"], "best": 2}, "from 0 to 1, got 2"),
        ({"prompt": "p", "responses": ["a", "b"], "ratings": [1, 5], "scale": 5}, "levels from 0 to scale - 1"),
        ({"prompt": "p", "responses": ["a", "b"], "ratings": [1, 2]}, 'ratings need "scale"'),
        ({"prompt": "p", "responses": ["a", "b"], "preference": 1.5}, "must lie in [0, 1], got 1.5"),
        ({"prompt": "p", "responses": ["a", "b", "c"], "preference": 1}, "of the first of two responses"),
        (PAIR | {"weight": 0}, "must be positive and finite, got 0.0"),
        (PAIR | {"weight": "much"}, "column 'weight': expected number, got 'much'"),
        (PAIR | {"labeler": 3}, "column 'labeler': expected str, got 3"),
        (PAIR | {"labeler": "x\ud800"}, "labeler: expected text that is valid Unicode"),
        (PAIR | {"labeler": "x\0"}, "without NUL"),
        (PAIR | {"shown": ["0", "1"]}, "column 'shown': expected each of 0 to 1 once"),
        (PAIR | {"shown": [True, False]}, "column 'shown': expected each of 0 to 1 once"),
        (RANKED | {"ranks": [0, 1, 10**400]}, "ranks that are whole numbers up to 2147483647"),
        ({"prompt": "p", "responses": ["a", "b"], "ratings": [0, 1], "scale": 10**400}, "a scale of at most 10000"),
        ({"prompt": {"role": "prompter", "text": "t", "replies": 5}}, "expected a message"),
        ({"conversation_a": [{"role": [], "content": ""}], "winner": "tie"}, "expected messages with a role"),
        ({"prompt": {"role": "prompter", "text": None}}, "expected a message with a text and a role"),
        ("[" * 100_000, "nested too deeply"),
    ],
)
def test_a_bad_row_is_named_and_nothing_is_read(
    lines: Callable[..., Path], row: Mapping[str, object] | str, message: str
) -> None:
    with pytest.raises(ValueError) as caught:
        read_judgements(lines(PAIR, row))
    assert "row 2: " in str(caught.value)
    assert message in str(caught.value)


# --- segments -----------------------------------------------------------------------------------------------------


def test_pairs_of_segments_are_read_with_the_better_one_first(pairs: Callable[..., Path]) -> None:
    read = read_judgements(path := pairs())
    arrays = np.load(path)
    assert len(read.judged) == 4
    assert "4 x label by a script" in read.notes[0]
    for i, judged in enumerate(read.judged[:3]):
        assert isinstance(judged.judgement, Comparison)
        first = next(c for c in judged.query.candidates if (c.observations == arrays["train_obs_1"][i]).all())
        stated = judged.judgement.preference
        better_first = stated if first is judged.query.candidates[0] else 1.0 - stated
        assert better_first == 1.0 - arrays["train_label_human"][i]
        assert (first.actions == arrays["train_action_1"][i]).all()
        assert first.episode.startswith("train/")


@pytest.mark.parametrize(
    ("which", "count", "labelers"),
    [
        (Which(("human",)), 4, {"human"}),
        (Which(("script",), "train"), 3, {"script"}),
        (Which(("human", "script"), "eval"), 2, {"human", "script"}),
    ],
)
def test_labelers_and_parts_can_be_chosen(
    pairs: Callable[..., Path], which: Which, count: int, labelers: set[str]
) -> None:
    read = read_judgements(pairs(), which)
    assert len(read.judged) == count
    assert {j.judgement.labeler for j in read.judged} == labelers


@pytest.mark.parametrize("which", [Which(("bob",)), Which((), "test")])
def test_a_choice_that_leaves_nothing_says_what_there_is(pairs: Callable[..., Path], which: Which) -> None:
    with pytest.raises(ValueError, match="labelers there: human, script; splits there: eval, train"):
        read_judgements(pairs(), which)


def test_the_same_segment_in_two_pairs_is_one_candidate(pairs: Callable[..., Path]) -> None:
    arrays = np.load(pairs())
    twice = {name: arrays[name][[0, 0, 2]] for name in ("train_obs_1", "train_action_1")}
    read = read_judgements(pairs(**twice), Which(("human",), "train"))
    assert len({c.id for j in read.judged for c in j.query.candidates}) == 5


FULL = np.zeros((3, 5, 3), np.float32)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"train_obs_2": None}, "array train_obs_2 is missing"),
        ({"train_obs_1": None, "eval_obs_1": None}, "expected arrays named train_obs_1 and so on"),
        ({"train_obs_2": FULL[:2]}, "train_obs_2: expected (pairs, T, O) twice"),
        ({"train_action_1": FULL[:, :4, :2]}, "train_action_1: expected (pairs, T, O) twice"),
        ({"train_obs_1": FULL[0]}, "train_obs_1: expected (pairs, T, O) twice"),
        ({"train_obs_1": FULL.astype(int)}, "train_obs_1: expected floats"),
        ({"train_obs_1": np.full(FULL.shape, np.nan, np.float32)}, "train, row 1: obs_1 is nan in step 0"),
        ({"train_obs_1": np.full(FULL.shape, 1e300)}, "train, row 1: obs_1 is inf in step 0"),
        ({"train_label_human": np.array([0.0, np.nan, 1.0])}, "train, row 2: label_human: expected 0 (first better)"),
        ({"train_label_human": np.array([0.0, 1.0, 2.0])}, "train, row 3: label_human"),
        ({"train_label_human": np.zeros(2)}, "train_label_human: expected a number for each of 3 pairs"),
        ({"train_label_human": np.array(["a", "b", "c"])}, "train_label_human: expected a number"),
        ({"train_label_human": None, "train_label_script": None}, "expected labels train_label_human, say"),
        ({"train_label_human": np.array([None] * 3)}, "allow_pickle=False"),
    ],
)
def test_arrays_that_do_not_fit_are_named(pairs: Callable[..., Path], changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError) as caught:
        read_judgements(pairs(**changes))
    assert message in str(caught.value)


@pytest.mark.parametrize("layout", [Layout(form="preferences"), Layout(columns=(("prompt", "question"),))])
def test_what_is_said_of_rows_is_refused_for_pairs_of_segments(pairs: Callable[..., Path], layout: Layout) -> None:
    with pytest.raises(ValueError, match=r"holds judged segments: --map and --form are for rows, leave them out"):
        check_file(pairs(), layout=layout)


def test_a_segment_compared_with_itself_is_refused_with_its_row(pairs: Callable[..., Path]) -> None:
    arrays = dict(np.load(pairs()))
    for name in ("obs", "action"):
        arrays[f"train_{name}_2"][1] = arrays[f"train_{name}_1"][1]
    with pytest.raises(ValueError, match="train, row 2: a query may not compare a candidate with itself"):
        read_judgements(pairs(**arrays))


@pytest.mark.parametrize("content", [b"", b"PK\x03\x04 and no more", b"\x93NUMPY\x01\x00"])
def test_what_is_no_archive_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "x.npz").write_bytes(content)
    with pytest.raises(ValueError, match=r"x\.npz"):
        read_judgements(tmp_path / "x.npz")


def test_one_array_is_no_archive(tmp_path: Path) -> None:
    np.save(tmp_path / "x.npy", FULL)
    (tmp_path / "x.npy").rename(tmp_path / "x.npz")
    with pytest.raises(ValueError, match="expected an archive of arrays, got one array"):
        read_judgements(tmp_path / "x.npz")


# --- stores -------------------------------------------------------------------------------------------------------


def test_contradictions_within_a_file_are_kept(text_store: Store[Response], lines: Callable[..., Path]) -> None:
    said = {"prompt": "p", "responses": ["a", "b"], "labeler": "ann"}
    path = lines(said | {"preference": 1}, said | {"preference": 0})
    for _ in range(2):  # a second reading changes nothing
        assert import_judgements(path, text_store).read == 2
    assert text_store.counts()["answered"] == 2
    assert {j.judgement.labeler for j in text_store.judged()} == {"ann", "ann#2"}
    assert len(read_judgements(path, Which(("ann",))).judged) == 2


def test_another_file_cannot_overrule_a_labeler_unnoticed(
    text_store: Store[Response], lines: Callable[..., Path]
) -> None:
    said = {"prompt": "p", "responses": ["a", "b"], "labeler": "ann"}
    import_judgements(lines(said | {"preference": 1}), text_store)
    with pytest.raises(StoreError, match=r"'ann' has judged query .* otherwise before"):
        import_judgements(lines(said | {"preference": 0}, PAIR), text_store)
    assert text_store.counts()["asked"] == 1


def test_an_import_chooses_as_well(store: Store[Segment], pairs: Callable[..., Path]) -> None:
    assert import_judgements(pairs(), store, Which(("human", "script"), "train")).read == 6
    assert store.counts() == {"asked": 3, "answered": 6, "skipped": 0}
