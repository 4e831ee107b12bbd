"""Rollouts: which segments are cut, what they carry, what is refused."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from prefrl import Config
from prefrl.envs.control import ControlSettings, GymnasiumTask
from prefrl.policies.rollout import (
    OVERLAP,
    Act,
    Rollout,
    _ages,
    collect,
    cut,
    evaluation,
    first_rollout,
    joined,
    learned_rewards,
    whole_episodes,
    windows,
)
from prefrl.reward_models.mlp import MLPSettings
from prefrl.reward_models.steps import StepReward
from prefrl.sample.queries import groups
from prefrl.types import Floats


def _task(**settings: object) -> GymnasiumTask:
    return ControlSettings.model_validate({"env": "Pendulum-v1", "horizon": 7, "segment_steps": 3, **settings}).build()


def _act(observations: Floats) -> tuple[Floats, Floats]:
    actions = observations[:, :1] * 0.5
    return actions, actions


def _alternating() -> Act:
    """Push left and right by turns: a pole stands for some 30 steps."""
    turn = iter(range(10_000))

    def act(observations: Floats) -> tuple[Floats, Floats]:
        actions = np.tile(np.eye(2, dtype=np.float32)[next(turn) % 2], (len(observations), 1))
        return actions, actions

    return act


def _rollout(steps: int = 17, count: int = 2) -> Rollout:
    envs = _task().environments(count)
    return collect(envs, envs.reset(np.random.default_rng(0)), steps, _act)[0]


def _model() -> StepReward:
    return MLPSettings(hidden=(4,)).build(_task(), np.random.default_rng(0))


def test_windows_stay_inside_one_episode_and_include_the_last_start() -> None:
    starts, weights = windows(_rollout(), 3)
    at = [int(t) for env, t in starts if env == 0]
    assert at == [0, 1, 2, 3, 4, 7, 8, 9, 10, 11, 14]  # episodes 0-6, 7-13 and the open one 14-16
    assert [float(w) for (env, _), w in zip(starts, weights, strict=True) if env == 0] == [
        *(3, 1, 1, 1, 3),
        *(3, 1, 1, 1, 3),
        3,
    ]


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


def test_parts_joined_are_what_one_collection_would_have_been() -> None:
    envs = _task().environments(2)
    first, observations = collect(envs, envs.reset(np.random.default_rng(0)), 9, _act)
    second, _ = collect(envs, observations, 8, _act)
    whole = _rollout()
    assert all(np.array_equal(a, whole.state()[name]) for name, a in joined([first, second]).state().items())


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
    less = Rollout(**{name: values[:, :-60] for name, values in rollout.state().items()})
    assert rollout.ends[:, :-1].any()
    assert len(windows(less, 44)[0]) < 40 <= len(windows(rollout, 44)[0])


def test_episodes_that_are_shorter_than_segments_are_an_error_and_not_endless() -> None:
    task = _task(env="CartPole-v1", horizon=200, segment_steps=150, variable_horizon=True)
    right = np.array([0.0, 1.0], np.float32)
    with pytest.raises(
        ValueError, match=r"hold 0 segments of 150 steps.* 20 were.*longest episode seen had (9|10|11) "
    ):
        first_rollout(task, lambda o: (np.tile(right, (len(o), 1)),) * 2, 20, 4, np.random.default_rng(0))


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


def test_evaluation_means_over_first_episodes_only() -> None:
    task = _task(env="CartPole-v1", horizon=60, variable_horizon=True)
    right = np.array([0.0, 1.0], np.float32)
    act = lambda o: (np.tile(right, (len(o), 1)),) * 2  # noqa: E731
    rollout = whole_episodes(task, act, 5, np.random.default_rng(0))
    model = MLPSettings(hidden=(4,)).build(task, np.random.default_rng(0))
    metrics = evaluation(task, rollout, model).metrics
    assert 8 <= metrics["length"] <= 11
    assert metrics["gold"] == metrics["length"]
    assert set(metrics) == {"gold", "gold_std", "learned", "length"}


def test_whole_episodes_spend_exactly_a_fixed_horizon() -> None:
    task = _task(horizon=130, segment_steps=20)
    rollout = whole_episodes(task, _act, 3, np.random.default_rng(0))
    assert rollout.ends.shape == (3, 130)
    found = evaluation(task, rollout, MLPSettings().build(task, np.random.default_rng(0)))
    assert [len(s) for s in found.examples] == [80, 80, 80]
    assert found.metrics["gold"] == pytest.approx(rollout.gold.sum(1).mean())


def test_an_observation_that_is_not_finite_is_an_error_that_names_it_and_the_step() -> None:
    class Broken:
        def __init__(self) -> None:
            self.inner, self.steps = _task().environments(2), 0

        def reset(self, rng: np.random.Generator) -> Floats:
            return self.inner.reset(rng)

        def states(self) -> Floats | None:
            return None

        def step(self, actions: Floats):  # type: ignore[no-untyped-def]
            self.steps += 1
            step = self.inner.step(actions)
            if self.steps == 3:
                step.final_observations[1, 2] = np.nan
            return step

    envs = Broken()
    with pytest.raises(FloatingPointError, match="observation of environment 1 after step 2"):
        collect(envs, envs.reset(np.random.default_rng(0)), 5, _act)


def test_a_reward_that_is_not_finite_is_an_error_that_names_it_and_the_step() -> None:
    rollout = _rollout()
    observations = rollout.observations.copy()
    observations[1, 4] = np.inf
    with pytest.raises(FloatingPointError, match="environment 1, step 4"):
        evaluation(_task(), replace(rollout, observations=observations, truncated=rollout.truncated | True), _model())


def test_a_reward_that_looks_back_is_told_where_episodes_begin() -> None:
    rollout, told = _rollout(), list[Any]()

    class Told:
        fitted, members, memory = True, 1, 5

        def rewards(self, observations: Floats, actions: Floats, begins: np.ndarray | None = None) -> Floats:
            told.append(begins)
            return np.zeros(observations.shape[:2], np.float32)

    learned_rewards(Told(), rollout)  # type: ignore[arg-type]
    assert np.flatnonzero(told[0][0]).tolist() == [0, 7, 14]
