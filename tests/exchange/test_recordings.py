"""Recorded behaviour from files: unlike lengths, discrete actions, and errors that name what the user has."""

import json
import sys
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from recorded_files import JOINED, SEEN, TAKEN, minari_folder, saved

from prefrl.envs.control import ControlSettings
from prefrl.exchange.ports import export
from prefrl.exchange.recordings import recorded, recording
from prefrl.judgements import Demonstration
from prefrl.protocols import ControlTask
from prefrl.store import Store
from prefrl.types import Query, Segment


def test_episodes_of_unlike_length_lie_one_after_another_and_whole_numbers_are_discrete_actions(tmp_path: Path) -> None:
    found = recording(saved(tmp_path / "x.npz", **JOINED))
    hot = recording(saved(tmp_path / "y.npz", **JOINED | {"actions": np.eye(3, dtype=np.float32)[TAKEN]}))
    assert [one.id for one in found.segments] == [one.id for one in hot.segments]
    assert [len(one) for one in found.segments] == [2, 3]
    assert found.bounds is None
    np.testing.assert_array_equal(found.segments[1].observations, SEEN[2:])
    np.testing.assert_array_equal(found.segments[1].actions.argmax(1), TAKEN[2:])
    gold = found.segments[1].gold
    assert gold is not None
    np.testing.assert_array_equal(gold, SEEN[2:, 0])


def test_of_equal_lengths_whole_numbers_are_discrete_as_well_and_more_than_were_taken_may_be_said(
    tmp_path: Path,
) -> None:
    rows = {"observations": SEEN[None], "actions": TAKEN[None], "action_count": 4}
    (one,) = recording(saved(tmp_path / "x.npz", **rows)).segments
    np.testing.assert_array_equal(one.actions, np.eye(4, dtype=np.float32)[TAKEN])


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        (
            {"lengths": np.array([2, 2])},
            r"lengths: expected whole numbers above 0 that sum to the 5 steps, got \[2, 2\]",
        ),
        ({"lengths": np.array([5, 0])}, "lengths: expected whole numbers above 0"),
        ({"lengths": np.array([2.0, 3.0])}, "lengths: expected whole numbers above 0"),
        ({"observations": SEEN[None]}, r"expected observations \(S, O\)"),
        ({"rewards": np.zeros(4)}, r"expected observations \(S, O\)"),
        ({"actions": TAKEN - 1}, "actions: expected whole numbers from 0 to 1, got -1 to 1"),
        ({"action_count": 2}, "actions: expected whole numbers from 0 to 1, got 0 to 2"),
        ({"action_count": np.array([3])}, r"action_count: expected one whole number, got int64 of shape \(1,\)"),
        ({"actions": TAKEN + 10**8}, "actions: expected whole numbers from 0 to 9999"),
        (
            {"observations": np.where(SEEN == 6, np.nan, SEEN)},
            r"x\.npz: episode 2: array observations is nan in",
        ),
        ({"actions": np.full((5, 1), np.inf)}, "episode 1: array actions is inf in step 0"),
    ],
)
def test_what_does_not_fit_is_refused_by_its_array_and_its_episode(
    tmp_path: Path, arrays: dict[str, Any], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        recording(saved(tmp_path / "x.npz", **JOINED | arrays))


def test_an_array_of_objects_is_refused_with_what_to_do(tmp_path: Path) -> None:
    ragged = np.empty(2, object)
    ragged[:] = [SEEN[:2], SEEN[2:]]
    with pytest.raises(ValueError, match=r"array observations: .*one after another.* lengths \(N,\)"):
        recording(saved(tmp_path / "x.npz", observations=ragged, actions=TAKEN))


def test_what_cannot_be_imitated_is_called_by_its_row(tmp_path: Path) -> None:
    pendulum = cast("ControlTask", ControlSettings.model_validate({"env": "Pendulum-v1"}).build())
    seen, done = np.zeros((3, 4, 3), np.float32), np.zeros((3, 4, 1), np.float32)
    done[1, 2] = 9.0
    with pytest.raises(ValueError, match=r"x\.npz, row 2 has the action \[9\.\] in step 2, outside of the bounds"):
        recorded(saved(tmp_path / "x.npz", observations=seen, actions=done), pendulum)
    with pytest.raises(ValueError, match=r"x\.npz, episode 1 has observations and actions of \(2, 3\) numbers"):
        recorded(saved(tmp_path / "x.npz", **JOINED), pendulum)


def test_a_bundle_is_to_be_imported_first(tmp_path: Path) -> None:
    query = Query((Segment(SEEN, np.zeros((5, 1), np.float32), "ann/0", 0),))
    with Store[Segment](tmp_path / "store") as store:
        store.ask([query])
        store.answer([Demonstration(query.id, query.candidates[0].id, "ann")])
        export(store, tmp_path / "bundle", "bundle")
    with pytest.raises(ValueError, match=r"bundle is a bundle: import it first \(prefrl import"):
        recording(tmp_path / "bundle")


@pytest.mark.parametrize(("start", "form"), [(0, "arrow"), (4, "arrow"), (0, "hdf5")])
def test_discrete_actions_of_minari_are_one_hot_from_where_they_start(tmp_path: Path, start: int, form: str) -> None:
    found = recording(minari_folder(tmp_path / "set", start, form))
    assert found.bounds is None
    assert [len(one) for one in found.segments] == [2, 3]
    for one, taken in zip(found.segments, (TAKEN[:2], TAKEN[2:]), strict=True):
        np.testing.assert_array_equal(one.actions, np.eye(3, dtype=np.float32)[taken])
    gold = found.segments[1].gold
    assert gold is not None
    assert gold.sum() == 3


def test_actions_outside_of_minaris_own_space_are_refused(tmp_path: Path) -> None:
    folder = minari_folder(tmp_path / "set")
    metadata = json.loads((folder / "metadata.json").read_text())
    narrow = json.dumps({"type": "Discrete", "dtype": "int64", "start": 0, "n": 2})
    (folder / "metadata.json").write_text(json.dumps(metadata | {"action_space": narrow}))
    with pytest.raises(ValueError, match="episode 0 has actions that are not whole numbers from 0 to 1"):
        recording(folder)


def test_where_a_form_of_minari_cannot_be_read_the_extra_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = minari_folder(tmp_path / "set")
    metadata = json.loads((folder / "metadata.json").read_text())
    (folder / "metadata.json").write_text(json.dumps(metadata | {"data_format": "hdf5"}))
    monkeypatch.setitem(sys.modules, "h5py", None)
    monkeypatch.delitem(sys.modules, "minari.dataset._storages.hdf5_storage", raising=False)
    with pytest.raises(ValueError, match=r"form 'hdf5', and what reads it is missing: pip install 'prefrl\[interch"):
        recording(folder)
