"""Demonstrations of control that leave: they come back as they were, and what a file cannot hold is counted."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from prefrl.exchange.ports import export, import_judgements
from prefrl.exchange.recordings import recording
from prefrl.judgements import Comparison, Demonstration
from prefrl.storage.log import StoreError
from prefrl.store import Store
from prefrl.types import Floats, Query, Response, Segment

FORMS = ["x.npz", "set"]


def one(steps: int, episode: str, actions: Floats | None = None, **more: Any) -> Segment:
    rng = np.random.default_rng(len(episode) + steps)
    done = rng.normal(size=(steps, 2)).astype(np.float32) if actions is None else actions
    return Segment(rng.normal(size=(steps, 3)).astype(np.float32), done, episode, **({"start": 0} | more))


def show(store: Store[Segment], segments: Sequence[Segment], labeler: str = "ann") -> None:
    queries = [Query((each,)) for each in segments]
    store.ask(queries)
    store.answer([Demonstration(q.id, q.candidates[0].id, labeler) for q in queries])


def told(segments: Sequence[Segment]) -> list[tuple[Any, ...]]:
    """All of each that a file holds, to the bit."""
    return [
        (s.episode, s.start, s.observations.tobytes(), s.actions.tobytes(), s.observations.shape, s.actions.dtype)
        for s in segments
    ]


@pytest.mark.parametrize("name", FORMS)
@pytest.mark.parametrize("discrete", [False, True])
def test_what_was_shown_comes_back_to_the_bit(store: Store[Segment], tmp_path: Path, name: str, discrete: bool) -> None:
    if name == "set":
        pytest.importorskip("minari")
    hot = np.eye(4, dtype=np.float32)  # of four actions the last is never taken
    shown = [
        one(3, "e/0", hot[[0, 2, 1]] if discrete else None),
        one(2, "e/0", hot[[2, 1]] if discrete else None, start=1),
        one(5, "f/1", hot[[0, 0, 0, 0, 0]] if discrete else None, gold=np.ones(5)),
    ]
    show(store, shown)
    assert export(store, tmp_path / name, "demonstrations").written == 3
    found = recording(tmp_path / name)
    assert told(found.segments) == told(shown)
    assert (found.bounds is None) == discrete
    with Store[Segment](tmp_path / "again") as again:
        import_judgements(tmp_path / name, again)
        assert told([each.like for each in again.demonstrations()]) == told(shown)
        assert not (again.folder / "gold").exists()


def test_the_arrays_are_those_that_a_script_would_write(store: Store[Segment], tmp_path: Path) -> None:
    show(store, [one(2, "e", np.eye(3, dtype=np.float32)[[1, 0]], gold=np.ones(2)), one(1, "f", np.eye(3)[[1]])])
    export(store, tmp_path / "x.npz", "demonstrations")
    with np.load(tmp_path / "x.npz") as file:
        assert file["actions"].tolist() == [1, 0, 1]
        assert (file["lengths"].tolist(), int(file["action_count"])) == ([2, 1], 3)
        assert file["observations"].shape == (3, 3)
        assert "rewards" not in file


@pytest.mark.parametrize("name", FORMS)
def test_what_a_file_cannot_hold_is_counted(store: Store[Segment], tmp_path: Path, name: str) -> None:
    if name == "set":
        pytest.importorskip("minari")
    own, other, judged = one(2, "own"), one(2, "asked", context="left"), Query((one(2, "a"), one(2, "bb")))
    show(store, [one(2, "own", states=np.zeros((2, 1)))])
    like = replace(other, actions=own.actions)
    store.keep([like])
    store.ask([query := Query((other,)), judged])
    store.answer([Demonstration(query.id, like.id, "bob", weight=2.0), Comparison(judged.id, 1.0, "bob")])
    done = export(store, tmp_path / name, "demonstrations")
    assert (done.written, any("gold" in note for note in done.notes)) == (2, True)
    assert dict(done.dropped) == {
        "annotator's name": 2,
        "time of an answer": 2,
        "weight of a judgement, other than 1": 1,
        "judgement or skip": 1,
        "behaviour that a demonstration answers": 1,
        "simulator states of a segment": 1,
        "name of a segment's task, of several": 1,
    }


@pytest.mark.parametrize("name", ["x.jsonl", "x.csv", "x.npz.gz"])
def test_another_suffix_is_refused_in_words(store: Store[Segment], tmp_path: Path, name: str) -> None:
    show(store, [one(2, "e")])
    with pytest.raises(ValueError, match=r"demonstrations of control go into an \.npz, or, where the name has no suff"):
        export(store, tmp_path / name, "demonstrations")
    assert not (tmp_path / name).exists()


def test_demonstrations_of_text_go_into_no_arrays(text_store: Store[Response], tmp_path: Path) -> None:
    text_store.ask([query := Query((Response("p", "a"),))])
    text_store.answer([Demonstration(query.id, query.candidates[0].id)])
    with pytest.raises(ValueError, match=r"x\.npz: demonstrations of text are JSON lines"):
        export(text_store, tmp_path / "x.npz", "demonstrations")
    assert export(text_store, tmp_path / "x.jsonl", "demonstrations").written == 1


def test_segments_of_two_sizes_go_into_no_file(store: Store[Segment], tmp_path: Path) -> None:
    show(store, [one(2, "e"), one(2, "f", np.zeros((2, 5), np.float32))])
    with pytest.raises(StoreError, match=r"different sizes, \(3, 2\) and \(3, 5\), do not fit one file"):
        export(store, tmp_path / "x.npz", "demonstrations")
    assert not (tmp_path / "x.npz").exists()


def test_the_same_demonstrations_give_the_same_bytes(store: Store[Segment], tmp_path: Path) -> None:
    show(store, [one(2, "e")])
    for name in ("x.npz", "y.npz"):
        export(store, tmp_path / name, "demonstrations")
    assert (tmp_path / "x.npz").read_bytes() == (tmp_path / "y.npz").read_bytes()
