"""Rollouts: which segments are cut, what they carry, what is refused."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from prefrl.envs.control import ControlSettings, GymnasiumTask
from prefrl.evaluate.policies import evaluation
from prefrl.policies.rollout import Rollout, collect, joined, learned_rewards, whole_episodes
from prefrl.protocols import Transition
from prefrl.reward_models.mlp import MLPSettings
from prefrl.reward_models.steps import StepReward
from prefrl.types import Bools, Floats


def _task(**settings: object) -> GymnasiumTask:
    return ControlSettings.model_validate({"env": "Pendulum-v1", "horizon": 7, "segment_steps": 3, **settings}).build()


def _act(observations: Floats, legal: Bools | None, begins: Bools) -> tuple[Floats, Floats]:
    actions = observations[:, :1] * 0.5
    return actions, actions


def _rollout(steps: int = 17, count: int = 2) -> Rollout:
    envs = _task().environments(count)
    return collect(envs, envs.reset(np.random.default_rng(0)), steps, _act)[0]


def _model() -> StepReward:
    return MLPSettings(hidden=(4,)).build(_task(), np.random.default_rng(0))


def test_parts_joined_are_what_one_collection_would_have_been() -> None:
    envs = _task().environments(2)
    first, observations = collect(envs, envs.reset(np.random.default_rng(0)), 9, _act)
    second, _ = collect(envs, observations, 8, _act)
    whole = _rollout()
    for name, values in joined([first, second]).state().items():
        np.testing.assert_array_equal(values, whole.state()[name])


def test_what_a_step_led_to_is_kept_also_where_an_episode_ended_there() -> None:
    """Episodes of 7 steps, beside ones of 100 from the same start."""
    rollout, envs = _rollout(), _task(horizon=100).environments(2)
    longer, _ = collect(envs, envs.reset(np.random.default_rng(0)), 7, _act)
    assert np.flatnonzero(rollout.ends.any(0)).tolist() == [6, 13]
    assert np.array_equal(rollout.final_observations[:, :7], longer.final_observations)
    goes_on = ~rollout.ends[:, :-1]
    assert np.array_equal(rollout.final_observations[:, :-1][goes_on], rollout.observations[:, 1:][goes_on])
    assert not np.isclose(rollout.final_observations[:, 6], rollout.observations[:, 7]).all(1).any()


def test_whole_episodes_spend_exactly_a_fixed_horizon() -> None:
    task = _task(horizon=130, segment_steps=20)
    rollout = whole_episodes(task, _act, 3, np.random.default_rng(0))
    assert rollout.ends.shape == (3, 130)
    found = evaluation(task, rollout, MLPSettings().build(task, np.random.default_rng(0)))
    assert [len(s) for s in found.examples] == [80, 80, 80]
    assert found.metrics["gold"] == pytest.approx(rollout.gold.sum(1).mean())


def test_an_observation_that_is_not_finite_is_an_error_that_names_it_and_the_step() -> None:
    envs = Broken(steps=3, name="final_observations")
    with pytest.raises(FloatingPointError, match="observation of environment 1 after step 2"):
        collect(envs, envs.reset(np.random.default_rng(0)), 5, _act)


def test_an_observation_that_an_episode_begins_with_is_looked_at_too() -> None:
    envs, first = Broken(steps=7, name="observations"), np.full((2, 3), np.nan, np.float32)
    for begins in (envs.reset(np.random.default_rng(0)), first):  # the second episode's, and the first one's
        with pytest.raises(FloatingPointError, match=r"first observation of an episode of environment [01] is not"):
            collect(envs, begins, 9, _act)


class Broken:
    """Two pendulums, of which the second is no number in one array after so many steps."""

    def __init__(self, steps: int, name: str) -> None:
        self.inner, self.left, self.name = _task().environments(2), steps, name

    def reset(self, rng: np.random.Generator) -> Floats:
        return self.inner.reset(rng)

    def states(self) -> Floats | None:
        return None

    def legal(self) -> Bools | None:
        return None

    def step(self, actions: Floats) -> Transition:
        self.left -= 1
        step = self.inner.step(actions)
        if self.left:
            return step
        wrong: Floats = step._asdict()[self.name].copy()
        wrong[1, 2] = np.nan
        return step._replace(**{self.name: wrong})


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


def test_states_are_those_in_which_actions_were_taken_also_where_a_simulator_writes_on() -> None:
    envs = _task(env="InvertedPendulum-v5").environments(2)
    rollout, _ = collect(envs, envs.reset(np.random.default_rng(0)), 9, _act)
    assert rollout.states is not None
    np.testing.assert_array_equal(rollout.states.astype(np.float32), rollout.observations)
