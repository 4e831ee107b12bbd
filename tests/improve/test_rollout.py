"""Rollouts: which segments are cut, what they carry, what is refused."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from prefrl.envs.control import ControlSettings, GymnasiumTask
from prefrl.improve.rollout import Rollout, collect, cut, evaluation, first_rollout, joined, whole_episodes, windows
from prefrl.reward_models.mlp import MLPReward, MLPSettings
from prefrl.types import Floats


def _task(**settings: object) -> GymnasiumTask:
    return ControlSettings.model_validate({"env": "Pendulum-v1", "horizon": 7, "segment_steps": 3, **settings}).build()


def _act(observations: Floats) -> tuple[Floats, Floats]:
    actions = observations[:, :1] * 0.5
    return actions, actions


def _rollout(steps: int = 17, count: int = 2) -> Rollout:
    envs = _task().environments(count)
    return collect(envs, envs.reset(np.random.default_rng(0)), steps, _act)[0]


def _model() -> MLPReward:
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
    assert (few.ends.shape, many.ends.shape) == ((1, 7), (2, 21))


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
