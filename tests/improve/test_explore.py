"""Exploring before the first question."""

from __future__ import annotations

import math
from copy import deepcopy
from typing import Any

import numpy as np
import pytest
import torch
from control_stubs import Known, point

from prefrl.components import ConfigError
from prefrl.improve.explore import StateEntropy, explore, state_entropy
from prefrl.improve.sb3 import SB3, SB3Settings
from prefrl.store import Store
from prefrl.types import Segment, Steps

SMALL: dict[str, Any] = {
    "algorithm": "SAC",
    "environments": 2,
    "steps_per_round": 80,
    "explore_steps": 120,
    "evaluation_episodes": 2,
    "policy": {"net_arch": [8]},
    "options": {"train_freq": 5, "gradient_steps": 2, "learning_starts": 20, "batch_size": 16, "buffer_size": 400},
}


def built(hide_gold: bool = False, spent: list[int] | None = None, **settings: Any) -> SB3:
    task = point(spent=spent, hide_gold=hide_gold)
    return SB3Settings.model_validate(SMALL | settings).build(task, np.random.default_rng(0))


def weights(learner: SB3, part: str) -> list[torch.Tensor]:
    return [x.clone() for name, x in learner.model.policy.state_dict().items() if name.startswith(part)]


def equal(one: list[torch.Tensor], other: list[torch.Tensor]) -> bool:
    return all(torch.equal(x, y) for x, y in zip(one, other, strict=True))


def test_a_state_is_worth_the_log_of_its_distance_to_the_kth_nearest_and_one_more() -> None:
    among = np.array([[0.0, 0.0], [3.0, 4.0], [6.0, 8.0], [0.0, 1.0]])
    points = np.array([[0.0, 0.0], [6.0, 8.0]])
    for k, distances in ((1, [0, 0]), (2, [1, 5]), (3, [5, math.sqrt(85)]), (4, [10, 10]), (9, [10, 10])):
        np.testing.assert_allclose(state_entropy(points, among, k), np.log1p(distances))


def test_what_was_seen_is_compared_with_its_five_nearest_others_in_units_of_its_spread() -> None:
    line = np.arange(7.0)[:, None]  # of std 2
    expected = np.log1p(np.array([5, 4, 3, 3, 3, 4, 5]) / 2)
    expected /= expected.std()
    novelty = StateEntropy()
    np.testing.assert_allclose(novelty.see(line), expected)
    # A new state is none of them: at 10 the fifth nearest is 2, and at 3 it is one of those at a distance of 2.
    scale = np.log1p(np.array([5, 4, 3, 3, 3, 4, 5]) / 2).std()
    new = novelty.rewards(np.array([[[10.0], [3.0]]]), np.zeros((1, 2, 1)))
    np.testing.assert_allclose(new, np.log1p(np.array([[8, 2]]) / 2) / scale)


def test_no_part_of_an_observation_counts_for_more_because_of_its_unit() -> None:
    seen = np.random.default_rng(0).normal(size=(40, 3))
    found = [StateEntropy().see(seen * np.array([1.0, unit, 0.0])) for unit in (1.0, 1000.0)]
    np.testing.assert_allclose(found[0], found[1])


def test_nothing_is_novel_before_anything_was_seen() -> None:
    assert not StateEntropy().rewards(np.ones((2, 3, 4)), np.ones((2, 3, 1))).any()


def test_exploring_leaves_the_actor_as_it_has_become_and_the_critic_as_it_was() -> None:
    learner = built()
    actor, critic = weights(learner, "actor"), weights(learner, "critic")
    with learner._learning(np.random.default_rng(0)):
        explore(learner.model, learner._learned, 120, 10)
    assert not equal(weights(learner, "actor"), actor)
    assert equal(weights(learner, "critic"), critic)
    assert not learner.model.critic.optimizer.state
    buffer = learner.model.replay_buffer
    seen = StateEntropy().see(buffer.observations[:60].reshape(120, 1))
    np.testing.assert_allclose(buffer.rewards[:60].ravel(), seen, rtol=1e-6)


def test_the_first_questions_are_about_exploring_which_happens_once_and_is_counted(store: Store[Segment]) -> None:
    spent: list[int] = []
    learner = built(spent=spent)
    pool = learner.sample(10, np.random.default_rng(0))
    assert (sum(spent), learner.steps) == (120, Steps(learn=120))
    kept = learner.model.replay_buffer.observations
    assert all(np.isin(s.observations, kept).all() for s in pool)
    learner.sample(10, np.random.default_rng(1))  # nobody has answered yet
    assert sum(spent) == 120
    learner.improve(Known(), store, np.random.default_rng(2))
    assert learner.steps == Steps(learn=200)
    # What was replayed while exploring is worth what the reward says of it now.
    buffer = learner.model.replay_buffer
    np.testing.assert_allclose(buffer.rewards[:60], 1 - 2 * np.abs(buffer.observations[:60, :, 0]), atol=1e-6)


def test_exploring_sees_no_gold_and_can_be_saved(store: Store[Segment]) -> None:
    learners = [built(hide) for hide in (False, True)]
    pools = [learner.sample(10, np.random.default_rng(0)) for learner in learners]
    assert [s.id for s in pools[0]] == [s.id for s in pools[1]]
    resumed = built()
    resumed.load(deepcopy(learners[0].state()))
    for learner in (*learners, resumed):
        learner.improve(Known(), store, np.random.default_rng(1))
    assert equal(weights(learners[0], ""), weights(learners[1], ""))
    assert equal(weights(learners[0], ""), weights(resumed, ""))


def test_an_algorithm_without_actor_or_replay_does_not_explore() -> None:
    with pytest.raises(
        ConfigError, match=r"explore_steps=80 needs an actor and a replay buffer: SAC, TD3, .*; PPO has"
    ):
        built(algorithm="PPO", options={"n_steps": 20}, explore_steps=80)


def test_exploring_takes_whole_steps_of_the_algorithm() -> None:
    with pytest.raises(ConfigError, match=r"learner.explore_steps must be a multiple of 10 .* got 125"):
        built(explore_steps=125)
