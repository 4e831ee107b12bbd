"""Evaluations of policies count what they say."""

from __future__ import annotations

import numpy as np
import pytest

from prefrl.envs.control import ControlSettings, GymnasiumTask
from prefrl.evaluate.policies import evaluation
from prefrl.policies.rollout import whole_episodes
from prefrl.reward_models.mlp import MLPSettings


def _task(**settings: object) -> GymnasiumTask:
    return ControlSettings.model_validate({"env": "Pendulum-v1", "horizon": 7, "segment_steps": 3, **settings}).build()


def test_evaluation_means_over_first_episodes_only() -> None:
    task = _task(env="CartPole-v1", horizon=60, variable_horizon=True)
    right = np.array([0.0, 1.0], np.float32)
    act = lambda o, legal: (np.tile(right, (len(o), 1)),) * 2  # noqa: E731
    rollout = whole_episodes(task, act, 5, np.random.default_rng(0))
    model = MLPSettings(hidden=(4,)).build(task, np.random.default_rng(0))
    metrics = evaluation(task, rollout, model).metrics
    assert 8 <= metrics["length"] <= 11
    assert metrics["gold"] == metrics["length"]
    assert set(metrics) == {"gold", "gold_std", "learned", "length"}


def test_an_evaluation_counts_the_last_step_of_an_episode() -> None:
    task = _task()
    act = lambda o, _: (o[:, :1],) * 2  # noqa: E731
    rollout = whole_episodes(task, act, 3, np.random.default_rng(0))
    metrics = evaluation(task, rollout, MLPSettings(hidden=(4,)).build(task, np.random.default_rng(0))).metrics
    assert metrics["length"] == 7.0
    assert metrics["gold"] == pytest.approx(rollout.gold.sum(1).mean())
