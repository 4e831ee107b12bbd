import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from prefrl import Config
from prefrl.components import ConfigError
from prefrl.envs.toys import INK, MARK, ForkSettings, PointSettings, TMazeSettings
from prefrl.store import Store
from prefrl.types import Segment


def test_the_point_moves_as_told_and_gold_is_its_closeness_to_the_middle(rng: np.random.Generator) -> None:
    envs = PointSettings().build().environments(3)
    before = envs.reset(rng)
    step = envs.step(np.array([[1, 0], [0, -5], [0, 0]], np.float32))
    moved = before + np.array([[0.1, 0], [0, -0.1], [0, 0]], np.float32)
    np.testing.assert_allclose(step.final_observations, moved, atol=1e-6)
    np.testing.assert_allclose(step.rewards, -np.linalg.norm(moved, axis=1), atol=1e-6)


def test_an_episode_is_cut_at_its_horizon_and_never_terminates(rng: np.random.Generator) -> None:
    envs = PointSettings(horizon=3, segment_steps=2).build().environments(2)
    envs.reset(rng)
    steps = [envs.step(np.zeros((2, 2), np.float32)) for _ in range(3)]
    assert [s.truncated.all() for s in steps] == [False, False, True]
    assert not any(s.terminated.any() for s in steps)


def test_a_picture_shows_the_point_and_the_middle() -> None:
    task = PointSettings(frame_size=90).build()
    states = np.array([[1.0, 1.0], [-1.0, 0.0]])
    segment = Segment(states.astype(np.float32), np.zeros((2, 2), np.float32), "e", 0, states)
    frames = task.frames(segment)
    assert frames.shape == (2, 90, 90, 3)
    assert tuple(frames[0, 45, 45]) == MARK
    assert tuple(frames[0, 15, 75]) == INK  # up and to the right
    assert tuple(frames[1, 45, 15]) == INK
    with pytest.raises(ValueError, match="simulator states"):
        task.frames(Segment(segment.observations, segment.actions, "e", 0))


def test_who_hits_the_disc_stays_there_and_the_goal_counts_once_on_the_wanted_side(rng: np.random.Generator) -> None:
    for side, expected in (("either", 1.0), ("left", 1.0), ("right", 0.0)):
        world = ForkSettings.model_validate({"side": side}).build().world
        states = np.array([[0.0, -0.65, 0, 0], [-0.7, -0.02, 0, 0], [0.1, 0.8, 0, -1.0]])
        up = np.tile([0.0, 1.0], (3, 1))
        after, gold, ended = world.advance(states, up, rng)
        assert after[:, 2].tolist() == [-1, 0, 1]
        assert after[1, 3] == -1  # abreast of the disc, on its left
        assert gold.tolist() == [0, 0, expected]
        assert not ended.any()
        again, gold, _ = world.advance(after, up, rng)
        np.testing.assert_array_equal(again[[0, 2]], after[[0, 2]])
        assert gold[[0, 2]].tolist() == [0, 0]


def test_a_picture_of_the_fork_shows_the_disc_the_goal_and_the_point() -> None:
    picture = ForkSettings().build().world.picture(np.array([-1.0, -1.0, 0, 0]), 90)
    assert tuple(picture[45, 45]) == (150, 150, 150)
    assert tuple(picture[15, 45]) == MARK
    assert tuple(picture[75, 15]) == INK


def test_a_segment_longer_than_the_episode_is_refused() -> None:
    with pytest.raises(ConfigError, match="segment of 9 steps is longer than an episode of 8"):
        PointSettings(horizon=8, segment_steps=9).build()


def check_learned(first: dict[str, float], last: dict[str, float]) -> None:
    """Standing still gives about -31, the best there is about -4."""
    assert first["evaluate/gold"] < -25
    assert last["evaluate/gold"] > -10
    assert last["fit/accuracy_held_out"] > 0.7


def test_the_loop_learns_the_toy(finished_toy: Path) -> None:
    first, *_, last = map(json.loads, (finished_toy / "metrics.jsonl").read_text().splitlines())
    check_learned(first, last)


@pytest.mark.slow
def test_the_loop_learns_the_toy_from_another_seed_too(tmp_path: Path) -> None:
    with Store[Any](tmp_path) as store:
        first, *_, last = Config.load("control/toy", ["seed=1"]).build(store).run()
    check_learned(first.metrics, last.metrics)


ON, LEFT, RIGHT = np.eye(3, dtype=np.float32)


def test_a_maze_shows_its_sign_once_and_pays_for_the_arm_that_it_named(rng: np.random.Generator) -> None:
    envs = TMazeSettings(length=4).build().environments(200)
    first = envs.reset(rng)
    signs = first[:, 0]
    assert set(signs.tolist()) == {-1.0, 1.0}
    seen = [envs.step(np.tile(ON, (200, 1))) for _ in range(3)]
    assert not any(step.observations[:, 0].any() or step.rewards.any() for step in seen)
    assert [bool(step.observations[:, 1].all()) for step in seen] == [False, False, True]
    turns = np.where(rng.random((200, 1)) < 0.5, LEFT, RIGHT)
    last = envs.step(turns)
    np.testing.assert_array_equal(last.rewards, (turns[:, 2] - turns[:, 1] == signs).astype(float))
    assert last.terminated.all()  # nothing follows that a critic could be asked about
    assert set(last.observations[:, 0].tolist()) == {-1.0, 1.0}  # the next episode's


def test_a_step_that_does_not_lead_on_costs_its_share_and_the_junction_is_missed(rng: np.random.Generator) -> None:
    envs = TMazeSettings(length=4).build().environments(1)
    envs.reset(rng)
    rewards = [float(envs.step(action[None]).rewards[0]) for action in (LEFT, ON, ON, ON)]
    assert rewards == [-0.25, 0.0, 0.0, 0.0]


def test_a_picture_of_a_maze_shows_the_walker_and_the_right_arm() -> None:
    task = TMazeSettings(length=5, frame_size=60).build()
    states = np.array([[0.0, 1.0, 0.0, 0.0], [4.0, -1.0, -1.0, 5.0]])
    frames = task.frames(Segment(np.zeros((2, 2), np.float32), np.zeros((2, 3), np.float32), "e", 0, states))
    assert frames.shape == (2, 60, 60, 3)
    assert frames[0, 32, 3].tolist() == list(INK)
    assert frames[0, 52, 43].tolist() == list(MARK)
    assert frames[1, 12, 43].tolist() == list(INK)  # in the right arm, over it
    with pytest.raises(ConfigError, match="6 steps is longer than an episode of 5"):
        TMazeSettings(length=5, segment_steps=6).build()
