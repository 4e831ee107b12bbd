"""Recorded behaviour that is imported: each segment a demonstration that stands for itself, all of them or none."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded_files import JOINED, SEEN, TAKEN, minari_folder, saved

from prefrl.exchange.formats import read_judgements
from prefrl.exchange.layout import Layout
from prefrl.exchange.ports import import_judgements, try_import
from prefrl.judgements import Comparison
from prefrl.store import Store
from prefrl.types import Response, Segment

HOT = np.eye(3, dtype=np.float32)[TAKEN]


def test_each_episode_of_a_file_is_a_demonstration_that_stands_for_itself(
    store: Store[Segment], tmp_path: Path
) -> None:
    done = import_judgements(saved(tmp_path / "x.npz", **JOINED), store)
    shown = store.demonstrations()
    assert (done.read, done.known, store.judged(), store.open_queries()) == (2, 0, [], [])
    assert [one.query.candidates[0].id for one in shown] == [one.like.id for one in shown]
    for one, part in zip(shown, (slice(0, 2), slice(2, 5)), strict=True):
        np.testing.assert_array_equal(one.like.observations, SEEN[part])
        np.testing.assert_array_equal(one.like.actions, HOT[part])
        assert one.demonstration.labeler.startswith("file:")
    assert f"recorded behaviour, read as demonstrations: 2 by {shown[0].demonstration.labeler}" in done.notes
    assert [one.like.episode.partition("/")[0] for one in shown] == ["episode 1", "episode 2"]


def test_rewards_of_a_file_stay_out_and_are_counted(store: Store[Segment], tmp_path: Path) -> None:
    done = import_judgements(saved(tmp_path / "x.npz", **JOINED), store)
    assert any(note.startswith("left out: 2 x row of rewards") for note in done.notes)
    assert not (store.folder / "gold").exists()
    with Store[Segment](tmp_path / "other") as other:
        plain = {name: array for name, array in JOINED.items() if name != "rewards"}
        assert len(import_judgements(saved(tmp_path / "y.npz", **plain), other).notes) == 1


def test_a_second_reading_adds_nothing_whatever_the_file_is_called(store: Store[Segment], tmp_path: Path) -> None:
    import_judgements(saved(tmp_path / "x.npz", **JOINED), store)
    before, again = store.sequence, (tmp_path / "x.npz").rename(tmp_path / "y.npz")
    for done in (import_judgements(again, store), try_import(again, store)):
        assert (done.read, done.known) == (2, 2)
    assert store.sequence == before


def test_episodes_that_are_alike_are_two_demonstrations(store: Store[Segment], tmp_path: Path) -> None:
    twice = {"observations": np.stack([SEEN, SEEN]), "actions": np.stack([TAKEN, TAKEN])}
    import_judgements(saved(tmp_path / "x.npz", **twice), store)
    shown = store.demonstrations()
    assert len({one.like.id for one in shown}) == len({one.demonstration.query for one in shown}) == 2
    assert {one.demonstration.labeler for one in shown} == {shown[0].demonstration.labeler}


def test_a_file_may_name_its_episodes_and_where_in_them_it_begins(store: Store[Segment], tmp_path: Path) -> None:
    import_judgements(saved(tmp_path / "x.npz", **JOINED, episodes=["ann/0", "ann/0"], starts=[0, 2]), store)
    assert [(one.like.episode, one.like.start) for one in store.demonstrations()] == [("ann/0", 0), ("ann/0", 2)]


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"observations": np.where(SEEN == 6, np.nan, SEEN)}, r"episode 2: array observations is nan in step 1"),
        ({"actions": np.full((5, 1), np.inf)}, "(?s)episode 1: array actions is inf in step 0.*episode 2: array"),
        ({"lengths": [2, 4]}, "array lengths: expected whole numbers above 0 that sum to the 5 steps"),
        ({"actions": None}, "array actions is missing"),
        ({"observations": None}, "expected arrays named train_obs_1 and so on, or observations and actions, got"),
        ({"observations": SEEN[:4]}, r"expected observations \(S, O\)"),
        ({"observations": SEEN[:0], "actions": TAKEN[:0], "rewards": None, "lengths": np.zeros(0, int)}, "got none"),
        (
            {"observations": SEEN[:0].reshape(2, 0, 2), "actions": np.zeros((2, 0, 1)), "rewards": None}
            | {"lengths": None},
            "row 1: it has no step\nrow 2: it has no step",
        ),
        ({"starts": [0, 2]}, r"array starts .*: add episodes \(N,\)"),
        ({"episodes": ["a"]}, r"array episodes: expected a text for each of 2 segments, got <U1 of shape \(1,\)"),
        ({"episodes": [1, 2]}, "array episodes: expected a text for each of 2 segments, got int64"),
        ({"episodes": ["a", ""]}, "array episodes: expected a text for each of 2 segments"),
        ({"episodes": ["a", "\ud800"]}, "episode 2: its episode: expected text that is valid Unicode"),
        ({"episodes": ["a", "b"], "starts": [0, -1]}, "array starts: expected a step from 0 on for each of 2"),
        ({"episodes": ["a", "b"], "starts": [0.0, 1.0]}, "array starts: expected a step from 0 on for each of 2"),
    ],
)
def test_bad_arrays_are_named_and_nothing_is_written(
    store: Store[Segment], tmp_path: Path, arrays: dict[str, Any], message: str
) -> None:
    given = {name: array for name, array in (JOINED | arrays).items() if array is not None}
    path = saved(tmp_path / "x.npz", **given)
    with pytest.raises(ValueError, match=message):
        try_import(path, None)
    with pytest.raises(ValueError, match=r"x\.npz: "):
        import_judgements(path, store)
    assert store.sequence == 0


def test_episodes_of_unlike_length_in_an_array_of_objects_are_refused_with_what_to_do(
    store: Store[Segment], tmp_path: Path
) -> None:
    ragged = np.empty(2, object)
    ragged[:] = [SEEN[:2], SEEN[2:]]
    with pytest.raises(ValueError, match=r"array observations: .*one after another.* lengths \(N,\)"):
        import_judgements(saved(tmp_path / "x.npz", observations=ragged, actions=TAKEN), store)


@pytest.mark.parametrize("kept", [0, 10, 400, -30])
def test_a_file_that_was_cut_off_is_refused(store: Store[Segment], tmp_path: Path, kept: int) -> None:
    path = saved(tmp_path / "x.npz", **JOINED)
    path.write_bytes(path.read_bytes()[:kept])
    with pytest.raises(ValueError, match=r"x\.npz: "):
        import_judgements(path, store)
    assert store.sequence == 0


def test_a_way_of_packing_that_cannot_be_read_is_refused(store: Store[Segment], tmp_path: Path) -> None:
    path = saved(tmp_path / "x.npz", **JOINED)
    data = bytearray(path.read_bytes())
    for at in (8, data.index(b"PK\x01\x02") + 10):  # the method, in the first file's own header and in the directory
        data[at] = 99
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"x\.npz: That compression method is not supported"):
        import_judgements(path, store)


def test_bad_episodes_can_be_left_out(store: Store[Segment], tmp_path: Path) -> None:
    arrays = JOINED | {"observations": np.where(SEEN == 6, np.nan, SEEN)}
    done = import_judgements(saved(tmp_path / "x.npz", **arrays), store, layout=Layout(skip_bad=True))
    assert (done.read, [len(one.like) for one in store.demonstrations()]) == (1, [2])
    assert any("1 x bad row\nepisode 2: array observations" in note for note in done.notes)


@pytest.mark.parametrize("layout", [Layout("preferences"), Layout(columns=(("prompt", "x"),))])
def test_what_is_said_of_rows_does_not_go_with_segments(tmp_path: Path, layout: Layout) -> None:
    with pytest.raises(ValueError, match=r"x\.npz is recorded behaviour, .* are for rows"):
        try_import(saved(tmp_path / "x.npz", **JOINED), None, layout=layout)
    assert try_import(tmp_path / "x.npz", None, layout=Layout("demonstrations")).read == 2


# --- Minari -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("form", ["arrow", "hdf5", "parquet"])
def test_episodes_of_a_minari_data_set_are_demonstrations_as_well(
    store: Store[Segment], tmp_path: Path, form: str
) -> None:
    folder = minari_folder(tmp_path / "set", start=4, form=form)
    assert import_judgements(folder, store).read == 2
    assert import_judgements(folder, store).known == 2
    shown = store.demonstrations()
    for one, part in zip(shown, (slice(0, 2), slice(2, 5)), strict=True):
        np.testing.assert_array_equal(one.like.observations, SEEN[part])
        np.testing.assert_array_equal(one.like.actions, HOT[part])
    assert [one.like.episode.partition("/")[0] for one in shown] == ["episode 0", "episode 1"]
    assert not (store.folder / "gold").exists()


def test_the_labeler_is_called_after_what_a_data_set_holds(store: Store[Segment], tmp_path: Path) -> None:
    h5py: Any = pytest.importorskip("h5py")
    folder = minari_folder(tmp_path / "set", form="hdf5")
    import_judgements(folder, store)
    with h5py.File(folder / "main_data.hdf5", "a") as file:
        file["episode_0/observations"][0] = 7.0
    import_judgements(folder, store)
    assert len({one.demonstration.labeler for one in store.demonstrations()}) == 2


def test_a_bad_episode_of_minari_is_named_and_nothing_is_written(store: Store[Segment], tmp_path: Path) -> None:
    h5py: Any = pytest.importorskip("h5py")
    folder = minari_folder(tmp_path / "set", form="hdf5")
    with h5py.File(folder / "main_data.hdf5", "a") as file:
        file["episode_1/observations"][0] = np.nan
    with pytest.raises(ValueError, match="set: nothing was read\nepisode 1: holds values that are not finite"):
        import_judgements(folder, store)
    for shape in ((4, 5), (6, 2)):
        with h5py.File(folder / "main_data.hdf5", "a") as file:
            del file["episode_1/observations"]
            file["episode_1/observations"] = np.zeros(shape, np.float32)
        said = re.escape(f"episode 1: has observations {shape} and actions (3, 3); expected (T + 1, O) and (T, A)")
        with pytest.raises(ValueError, match=said):
            import_judgements(folder, store)
    (folder / "main_data.hdf5").write_bytes((folder / "main_data.hdf5").read_bytes()[:500])
    with pytest.raises(ValueError, match="episode 0: cannot be read: "):
        import_judgements(folder, store)
    assert store.sequence == 0


def test_a_folder_of_rows_that_has_metadata_stays_rows(text_store: Store[Response], tmp_path: Path) -> None:
    (tmp_path / "set").mkdir()
    (tmp_path / "set/metadata.json").write_text('{"by": "somebody"}')
    (tmp_path / "set/rows.jsonl").write_text(json.dumps({"prompt": "p", "chosen": "a", "rejected": "b"}))
    assert import_judgements(tmp_path / "set", text_store).read == 1
    assert len(text_store.judged()) == 1


def test_each_two_segments_of_ranked_behaviour_are_a_pair(store: Store[Segment], tmp_path: Path) -> None:
    three = {"observations": np.stack([SEEN, SEEN + 1, SEEN + 2]), "actions": np.stack([TAKEN] * 3)}
    path = saved(
        tmp_path / "x.npz", **three, rewards=three["observations"][:, :, 0], ranks=np.array([2, 0, 2], np.uint8)
    )
    done = import_judgements(path, store)
    judged = store.judged()
    assert (done.read, len(judged), store.demonstrations()) == (3, 3, [])
    assert all(candidate.gold is None for one in read_judgements(path).judged for candidate in one.query.candidates)
    found = {}
    for one in judged:
        assert isinstance(one.judgement, Comparison)
        first, second = (int(candidate.observations[0, 0]) for candidate in one.query.candidates)
        preference = one.judgement.preference
        found[min(first, second), max(first, second)] = preference if first < second else 1 - preference
    assert found == {(0, 1): 0.0, (0, 2): 0.5, (1, 2): 1.0}


@pytest.mark.parametrize(
    ("ranks", "told"),
    [
        ([0, 1, 2], r"expected a finite number for each of 2 segments, got int64 of shape \(3,\)"),
        ([0.0, np.nan], "expected a finite number for each of 2 segments, got float64"),
        (["a", "b"], "expected a finite number for each of 2 segments, got <U1"),
    ],
)
def test_ranks_that_are_not_one_number_a_segment_are_refused(ranks: Any, told: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=rf"x\.npz: array ranks: {told}"):
        try_import(saved(tmp_path / "x.npz", **JOINED, ranks=np.array(ranks)), None)


def test_segments_that_are_alike_or_judged_twice_over_are_no_ranks(tmp_path: Path) -> None:
    alike = {"observations": np.stack([SEEN, SEEN]), "actions": np.stack([TAKEN, TAKEN]), "ranks": np.arange(2)}
    with pytest.raises(ValueError, match="row 1 and row 2: both are the same segment"):
        try_import(saved(tmp_path / "x.npz", **alike), None)
    with pytest.raises(ValueError, match=r"judged pairs \(train_obs_1\) and array ranks: put them into a file each"):
        try_import(saved(tmp_path / "y.npz", **alike, train_obs_1=SEEN), None)
