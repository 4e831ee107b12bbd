"""A task of recorded segments: its sizes and bounds come from the file, and nothing acts in it."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from prefrl import Config
from prefrl.components import ConfigError
from prefrl.envs.segments import SegmentsSettings
from prefrl.exchange.ports import import_judgements
from prefrl.exchange.recordings import recording
from prefrl.improve.control import ControlLearnerSettings
from prefrl.improve.sb3 import SB3Settings
from prefrl.store import Store
from prefrl.types import Segment

CONFIG: dict[str, Any] = {
    "reward": {"kind": "mlp", "members": 1, "hidden": [8]},
    "fitting": {"epochs": 5},
    "learner": {"kind": "cpl", "epochs": 5, "cloning_epochs": 1, "hidden": [8], "held_out": 0.3},
    "loop": {"rounds": 1, "labels": 0},
}


def segments_file(path: Path, count: int = 24, discrete: bool = False, **arrays: Any) -> Path:
    """Segments of 6 steps whose rewards are known."""
    rng = np.random.default_rng(0)
    observations = rng.normal(size=(count, 6, 3)).astype(np.float32)
    actions = rng.normal(size=(count, 6, 2)).astype(np.float32)
    actions = np.eye(2, dtype=np.float32)[actions.argmax(2)] if discrete else actions
    given: dict[str, Any] = {"observations": observations, "actions": actions, "rewards": observations[..., 0]} | arrays
    np.savez(path, **{name: array for name, array in given.items() if array is not None})
    return path


def pairs_file(path: Path, count: int = 60) -> Path:
    rng = np.random.default_rng(0)
    first, second = rng.normal(size=(2, count, 6, 3)).astype(np.float32)
    push = [rng.normal(size=(count, 6, 2)).astype(np.float32) for _ in range(2)]
    labels = (push[1].sum((1, 2)) > push[0].sum((1, 2))).astype(float)
    arrays: dict[str, Any] = {
        "obs_1": first,
        "obs_2": second,
        "action_1": push[0],
        "action_2": push[1],
        "label_human": labels,
    }
    np.savez(path, **{f"train_{name}": array for name, array in arrays.items()})
    return path


@pytest.mark.parametrize("discrete", [False, True], ids=["box", "one-hot"])
def test_sizes_bounds_and_gold_are_those_of_the_file(tmp_path: Path, discrete: bool) -> None:
    task = SegmentsSettings(data=segments_file(tmp_path / "x.npz", discrete=discrete), segment_steps=4).build()
    assert (task.observation_size, task.action_size, task.horizon, task.segment_steps) == (3, 2, 6, 4)
    assert (task.action_bounds is None) == discrete
    gold = task.segments[0].gold
    assert gold is not None
    np.testing.assert_allclose(gold, task.segments[0].observations[:, 0])
    assert SegmentsSettings(data=pairs_file(tmp_path / "p.npz")).build().segments[0].gold is None


def test_the_segments_of_pairs_are_the_candidates_of_their_judgements(tmp_path: Path) -> None:
    path = pairs_file(tmp_path / "p.npz", 5)
    with Store[Segment](tmp_path / "store") as store:
        import_judgements(path, store)
        judged = {c.id for one in store.judged() for c in one.query.candidates}
    assert {one.id for one in recording(path).segments} == judged


@pytest.mark.parametrize("kind", ["cpl", "iql"])
def test_a_policy_learns_without_a_simulator_and_is_measured_on_held_out_judgements(tmp_path: Path, kind: str) -> None:
    path = pairs_file(tmp_path / "p.npz")
    small = {"kind": "iql", "critic_steps": 3, "policy_steps": 3, "hidden": [8], "held_out": 0.3}
    learner = CONFIG["learner"] if kind == "cpl" else small
    config = Config.parse(CONFIG | {"task": {"kind": "segments", "data": str(path)}, "learner": learner})
    with Store[Segment](tmp_path / "store") as store:
        import_judgements(path, store)
        before, after = (round.metrics for round in config.build(store).run())
    assert np.isnan(before["evaluate/gold"])
    assert np.isnan(after["evaluate/gold"])
    assert after["steps/learn"] == after["steps/query"] == after["steps/evaluate"] == 0
    assert 0 <= after["evaluate/agreement"] <= 1
    assert ("evaluate/judgement_loss" in after) == (kind == "cpl")


def test_an_oracle_answers_about_segments_whose_gold_is_in_the_file(tmp_path: Path) -> None:
    path = segments_file(tmp_path / "x.npz")
    changed = {"task": {"kind": "segments", "data": str(path)}, "loop": {"rounds": 1, "labels": 6, "pool": 1}}
    with Store[Segment](tmp_path / "store") as store:
        list(Config.parse(CONFIG | changed).build(store).run())
        judged = store.judged()
    assert len(judged) == 6
    for one in judged:
        sums = [c.observations[:, 0].sum() for c in one.query.candidates]
        assert one.judgement.preference == float(sums[0] > sums[1])  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"actions": None}, "array actions is missing"),
        ({"observations": np.zeros((3, 6), np.float32)}, r"expected observations \(N, T, O\)"),
        ({"rewards": np.zeros((24, 5))}, r"expected observations \(N, T, O\)"),
        ({"observations": np.zeros((24, 6, 3), np.int64)}, "expected floats"),
        ({"observations": np.full((24, 6, 3), np.nan, np.float32)}, "row 1: array observations is nan in step 0"),
    ],
)
def test_a_bad_file_is_refused_with_what_is_wrong_with_it(tmp_path: Path, arrays: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        recording(segments_file(tmp_path / "x.npz", **arrays))


def test_learners_that_act_are_refused_when_they_are_built(tmp_path: Path) -> None:
    task = SegmentsSettings(data=segments_file(tmp_path / "some.npz")).build()
    for settings in (ControlLearnerSettings(), SB3Settings()):
        with pytest.raises(ConfigError, match=r"some has no simulator: use learner\.kind=cpl or iql"):
            settings.build(task, np.random.default_rng(0))


def test_a_missing_file_and_lengths_that_it_has_not_are_told() -> None:
    with pytest.raises(ConfigError, match=r"task\.data: expected a file of segments"):
        SegmentsSettings().build()
    with pytest.raises(ValueError, match=r"expected an \.npz file of segments"):
        recording(Path("README.md"))


def test_episodes_of_a_minari_data_set_are_segments_and_rewards_from_a_store_are_no_gold(tmp_path: Path) -> None:
    pytest.importorskip("minari")
    from prefrl.exchange.ports import export

    path = pairs_file(tmp_path / "p.npz", 3)
    with Store[Segment](tmp_path / "store") as store:
        import_judgements(path, store)
        export(store, tmp_path / "set", "minari")
    found, pairs = recording(tmp_path / "set"), recording(path)
    assert {one.id for one in found.segments} == {one.id for one in pairs.segments}
    assert all(one.gold is None for one in found.segments)
    assert found.bounds is not None
    assert np.isinf(found.bounds[0]).all()
