"""Segments stay inside episodes, and a first pool costs what was promised."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from prefrl import Config
from prefrl.envs.control import ControlSettings, GymnasiumTask
from prefrl.policies.rollout import Act, Rollout, collect
from prefrl.sample.queries import groups
from prefrl.sample.segments import OVERLAP, _ages, cut, first_rollout, windows
from prefrl.types import Bools, Floats


def _task(**settings: object) -> GymnasiumTask:
    return ControlSettings.model_validate({"env": "Pendulum-v1", "horizon": 7, "segment_steps": 3, **settings}).build()


def _act(observations: Floats, legal: Bools | None, begins: Bools) -> tuple[Floats, Floats]:
    actions = observations[:, :1] * 0.5
    return actions, actions


def _alternating() -> Act:
    """Push left and right by turns: a pole stands for some 30 steps."""
    turn = iter(range(10_000))

    def act(observations: Floats, legal: Bools | None, begins: Bools) -> tuple[Floats, Floats]:
        actions = np.tile(np.eye(2, dtype=np.float32)[next(turn) % 2], (len(observations), 1))
        return actions, actions

    return act


def _one_way(observations: Floats, legal: Bools | None, begins: Bools) -> tuple[Floats, Floats]:
    actions = np.tile(np.array([0, 1], np.float32), (len(observations), 1))
    return actions, actions


def _rollout(steps: int = 17, count: int = 2) -> Rollout:
    envs = _task().environments(count)
    return collect(envs, envs.reset(np.random.default_rng(0)), steps, _act)[0]


def test_windows_stay_inside_one_episode_and_include_the_last_start() -> None:
    starts, weights = windows(_rollout(), 3)
    at = [int(t) for env, t in starts if env == 0]
    assert at == [0, 1, 2, 3, 4, 7, 8, 9, 10, 11, 14]  # episodes 0-6, 7-13 and the open one 14-16
    assert [float(w) for (env, _), w in zip(starts, weights, strict=True) if env == 0] == [
        *(3, 1, 1, 1, 3),
        *(3, 1, 1, 1, 3),
        3,
    ]


def test_windows_in_which_nothing_moves_weigh_together_as_much_as_one() -> None:
    envs = _task(env="CartPole-v1", horizon=40, segment_steps=5).environments(3)
    rollout = collect(envs, envs.reset(np.random.default_rng(0)), 80, _one_way)[0]
    starts, weights = windows(rollout, 5)
    still = np.array([(rollout.observations[i, t : t + 5] == rollout.observations[i, t]).all() for i, t in starts])
    assert still.sum() > 0.6 * len(starts)  # a pole that is pushed one way falls within ten steps
    for env in range(3):
        for episode in (0, 1):
            mine = (starts[:, 0] == env) & (starts[:, 1] // 40 == episode)
            assert weights[mine & still].sum() == pytest.approx(1.0)
            assert set(weights[mine & ~still]) == {1.0, 5.0}


def test_every_window_is_cut_at_most_once_and_all_can_be() -> None:
    segments = cut(_rollout(), 3, 22, "round 0", np.random.default_rng(0))
    assert len({s.id for s in segments}) == 22
    assert Counter((s.episode, s.start) for s in segments).most_common(1)[0][1] == 1


def test_a_segment_is_the_rollouts_own_steps_by_value_with_gold_and_states() -> None:
    rollout = _rollout()
    for one in cut(rollout, 3, 22, "round 0", np.random.default_rng(0)):
        env, begin = (int(x) for x in one.episode.split("/")[1:])
        t = begin + one.start
        assert one.states is not None
        assert one.gold is not None
        assert rollout.states is not None
        assert np.array_equal(one.observations, rollout.observations[env, t : t + 3])
        assert np.array_equal(one.actions, rollout.actions[env, t : t + 3])
        assert np.array_equal(one.states, rollout.states[env, t : t + 3])
        assert np.array_equal(one.gold, rollout.gold[env, t : t + 3])
        assert not np.shares_memory(one.observations, rollout.observations)
        angle, velocity = one.states.T
        np.testing.assert_allclose(one.observations, np.stack([np.cos(angle), np.sin(angle), velocity], 1), atol=1e-6)


def test_more_segments_than_there_are_is_an_error_with_both_numbers() -> None:
    with pytest.raises(ValueError, match=r"hold 22 segments of 3 steps.*but 23"):
        cut(_rollout(), 3, 23, "round 0", np.random.default_rng(0))
    with pytest.raises(ValueError, match="hold 0 segments"):
        cut(_rollout(2), 3, 1, "round 0", np.random.default_rng(0))


def test_a_first_rollout_goes_on_until_it_holds_enough() -> None:
    task = _task()
    few = first_rollout(task, _act, 3, 2, np.random.default_rng(0))
    many = first_rollout(task, _act, 25, 2, np.random.default_rng(0))
    assert (few.ends.shape, many.ends.shape) == ((1, 7), (1, 35))


@pytest.mark.parametrize("most", [1, 4, 100])
def test_steps_of_a_first_rollout_are_shared_by_as_many_segments_as_promised(most: int) -> None:
    task = _task(horizon=200, segment_steps=40)
    rollout = first_rollout(task, _act, 480, most, np.random.default_rng(0))
    assert rollout.ends.size == 480 * 40 / OVERLAP  # four episodes, though three hold that many windows


def test_a_first_rollout_stops_as_soon_as_it_holds_enough_where_episodes_end_early() -> None:
    task = _task(env="CartPole-v1", horizon=60, segment_steps=44, variable_horizon=True)
    rollout = first_rollout(task, _alternating(), 40, 2, np.random.default_rng(0))
    less = Rollout(**{name: values[:, :-60] for name, values in rollout.state().items() if values is not None})
    assert rollout.ends[:, :-1].any()
    assert len(windows(less, 44)[0]) < 40 <= len(windows(rollout, 44)[0])


def test_episodes_that_are_shorter_than_segments_are_an_error_and_not_endless() -> None:
    task = _task(env="CartPole-v1", horizon=200, segment_steps=150, variable_horizon=True)
    right = np.array([0.0, 1.0], np.float32)
    said = r"hold 0 segments of 150 steps.* 20 were.*longest episode seen had (9|10|11) .*segment_steps\) smaller"
    for one, ends in (
        (task, r", or leave task\.variable_horizon at false, so that episodes do not end early$"),
        (replace(task, variable_horizon=False), "$"),  # not what such a task was told
    ):
        with pytest.raises(ValueError, match=said + ends):
            first_rollout(
                one, lambda o, legal, begins: (np.tile(right, (len(o), 1)),) * 2, 20, 4, np.random.default_rng(0)
            )


def test_windows_are_counted_across_parts_as_in_the_whole() -> None:
    ends = np.random.default_rng(0).random((3, 40)) < 0.15
    first = _ages(ends[:, :17], np.zeros(3, np.int64))
    second = _ages(ends[:, 17:], np.where(ends[:, 16], 0, first[:, -1]))
    ages = np.concatenate([first, second], 1)
    for row, ended in zip(ages, ends, strict=True):
        expected, age = [], 0
        for end in ended:
            expected.append(age := age + 1)
            age = 0 if end else age
        assert row.tolist() == expected


@pytest.mark.parametrize("preset", ["pendulum", "cartpole"])
def test_a_preset_s_first_pool_costs_little_and_gives_all_queries(preset: str) -> None:
    config: Any = Config.load(f"control/{preset}")
    loop, rng = config.loop, np.random.default_rng(0)
    task = config.task.build()
    learner = config.learner.build(task, rng)
    count = loop.asked_by(1)
    pool = learner.sample(int(count * 2 * loop.pool), rng)
    assert len(groups(pool, 2, rng)) >= 1.5 * count
    assert learner.steps.query <= 0.05 * loop.rounds * config.learner.steps_per_round
    if preset == "pendulum":
        assert learner.steps.query + loop.rounds * config.learner.steps_per_round <= 80_000
