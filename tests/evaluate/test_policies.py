"""Evaluations of policies count what they say."""

from __future__ import annotations

import math

import numpy as np
import pytest

from prefrl.envs.control import ControlSettings, GymnasiumTask
from prefrl.evaluate.policies import evaluation, self_bleu
from prefrl.policies.rollout import whole_episodes
from prefrl.reward_models.mlp import MLPSettings


def _task(**settings: object) -> GymnasiumTask:
    return ControlSettings.model_validate({"env": "Pendulum-v1", "horizon": 7, "segment_steps": 3, **settings}).build()


def test_evaluation_means_over_first_episodes_only() -> None:
    task = _task(env="CartPole-v1", horizon=60, variable_horizon=True)
    right = np.array([0.0, 1.0], np.float32)
    act = lambda o, legal, begins: (np.tile(right, (len(o), 1)),) * 2  # noqa: E731
    rollout = whole_episodes(task, act, 5, np.random.default_rng(0))
    model = MLPSettings(hidden=(4,)).build(task, np.random.default_rng(0))
    metrics = evaluation(task, rollout, model).metrics
    assert 8 <= metrics["length"] <= 11
    assert metrics["gold"] == metrics["length"]
    assert set(metrics) == {"count", "gold", "gold_std", "learned", "length"}


def test_an_evaluation_counts_the_last_step_of_an_episode() -> None:
    task = _task()
    act = lambda o, legal, begins: (o[:, :1],) * 2  # noqa: E731
    rollout = whole_episodes(task, act, 3, np.random.default_rng(0))
    metrics = evaluation(task, rollout, MLPSettings(hidden=(4,)).build(task, np.random.default_rng(0))).metrics
    assert metrics["length"] == 7.0
    assert metrics["gold"] == pytest.approx(rollout.gold.sum(1).mean())


def test_episodes_that_are_all_alike_are_shown_once() -> None:
    task = _task()
    act = lambda o, legal, begins: (o[:, :1],) * 2  # noqa: E731
    rollout = whole_episodes(task, act, 5, np.random.default_rng(0))
    rollout.observations[:3], rollout.actions[:3] = rollout.observations[0], rollout.actions[0]
    found = evaluation(task, rollout, MLPSettings(hidden=(4,)).build(task, np.random.default_rng(0)))
    assert [one.episode for one in found.examples] == ["evaluation/0/0", "evaluation/3/0", "evaluation/4/0"]
    assert len(found.candidates) == 5


def test_self_bleu_is_what_it_is_worked_out_to_be_by_hand() -> None:
    texts = [text.split() for text in ("the cat sat", "the cat ran", "a dog sat down")]
    first = (3 / 3 * 1 / 2 * 0.1 / 1) ** (1 / 3)  # "the cat" is also in the second, and no run of three anywhere
    second = (2 / 3 * 1 / 2 * 0.1 / 1) ** (1 / 3)
    third = (1 / 4 * 0.1 / 3 * 0.1 / 2 * 0.1 / 1) ** (1 / 4)
    assert self_bleu(texts) == pytest.approx((first + second + third) / 3)
    assert self_bleu([["a", "b", "c", "d", "e"]] * 3) == pytest.approx(1.0)
    # The shorter of two has all its words in the longer one, and is punished for being short.
    short, long = 1.0 * math.exp(1 - 4 / 2), (2 / 4 * 1 / 3 * 0.1 / 2 * 0.1 / 1) ** (1 / 4)
    assert self_bleu([["a", "b"], ["a", "b", "c", "d"]]) == pytest.approx((short + long) / 2)
    # A word counts as often as one other text has it, not as often as all others together.
    assert self_bleu([["a", "a"], ["a"], ["a"]]) == pytest.approx(((1 / 2 * 0.1) ** 0.5 + 1 + 1) / 3)
    assert self_bleu([[], []]) == 0.0
