"""Tabular Q-learning: it comes to the exact values, keeps and saves its table, and refuses what has no table."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from control_stubs import Known, Watched, point
from stable_baselines3 import DQN

from prefrl.components import ConfigError
from prefrl.envs import exact
from prefrl.envs.fast.vectorised import Vectorised
from prefrl.envs.tabular import GridworldSettings, table
from prefrl.envs.toys import ToyTask
from prefrl.improve.q_learning import QLearning, QLearningSettings
from prefrl.policies.rollout import collect
from prefrl.store import Store
from prefrl.types import Floats, Segment

GRID = GridworldSettings(rows=("S..", ".#x", "..G"), slip=0.2, horizon=20)
MDP = replace(GRID.world().mdp, discount=0.8)
TRUE = Known(lambda observations, actions: np.einsum("...s,...a,sa", observations, actions, MDP.rewards))


def learner(task: Any = None, **settings: object) -> QLearning:
    small = {"steps_per_round": 1600, "epsilon": 1.0, "discount": 0.8, "evaluation_episodes": 5, **settings}
    return QLearningSettings.model_validate(small).build(task or GRID.build(), np.random.default_rng(0))


@pytest.fixture
def store(tmp_path: Path) -> Store[Segment]:
    return Store[Segment](tmp_path / "store")


def learned(store: Store[Segment], rounds: int = 12, **settings: object) -> QLearning:
    found = learner(**settings)
    for number in range(rounds):
        found.improve(TRUE, store, np.random.default_rng(number))
    return found


def test_it_comes_to_the_best_policy_and_near_its_exact_values(store: Store[Segment]) -> None:
    found = learned(store, rate=0.05)
    policy = table(lambda observed: found.actor()(observed, None, None)[0], len(MDP.start))
    assert exact.regret(MDP, policy) < 1e-9
    off = np.abs(found.values - exact.value_iteration(MDP))
    assert off.mean() < 0.04
    assert off.max() < 0.25  # a constant rate never comes to rest
    metrics = found.evaluate(TRUE, np.random.default_rng(0)).metrics
    assert metrics["learned"] == pytest.approx(metrics["gold"])
    at_random = exact.objective(MDP, np.full(policy.shape, 0.25), GRID.horizon)
    assert metrics["gold"] > (at_random + exact.objective(MDP, policy, GRID.horizon)) / 2


def test_without_chance_and_with_a_rate_of_one_the_values_are_exact(store: Store[Segment]) -> None:
    world = GridworldSettings(rows=GRID.rows, slip=0).world()
    found = learner(replace(GRID.build(), world=world), rate=1.0, passes=40)
    found.improve(TRUE, store, np.random.default_rng(0))
    wanted = exact.value_iteration(replace(world.mdp, discount=0.8))
    np.testing.assert_allclose(found.values, wanted, atol=1e-6)


def test_gold_never_touches_the_table(store: Store[Segment]) -> None:
    class Blind(ToyTask):
        def environments(self, count: int) -> Any:
            return Watched(Vectorised(self.world, count, self.horizon), count, [], hide=True)

    seeing = GRID.build()
    blind = Blind(**{name: getattr(seeing, name) for name in seeing.__dataclass_fields__})
    tables = []
    for task in (seeing, blind):
        found = learner(task)
        found.improve(TRUE, store, np.random.default_rng(1))
        tables.append(found.values.tobytes())
    assert tables[0] == tables[1]


def test_a_saved_table_goes_on_as_it_was_and_counts_every_step(store: Store[Segment]) -> None:
    first = learned(store, rounds=1)
    again = learner()
    again.load(first.state())
    for one in (first, again):
        one.improve(TRUE, store, np.random.default_rng(5))
    assert first.values.tobytes() == again.values.tobytes()
    assert first.steps == again.steps
    assert first.steps.learn == 3200


def test_first_questions_are_about_random_actions() -> None:
    pool = learner(epsilon=0.0).sample(40, np.random.default_rng(0))
    share = np.concatenate([one.actions for one in pool]).mean(0)
    assert share == pytest.approx(np.full(4, 0.25), abs=0.1)


def test_dqn_reads_the_table_that_is_saved_and_acts_by_it(store: Store[Segment], tmp_path: Path) -> None:
    found, observed = learned(store, rounds=2), np.eye(len(MDP.start), dtype=np.float32)
    found.save(tmp_path / "table.zip")
    actions, _ = DQN.load(tmp_path / "table.zip").predict(observed, deterministic=True)
    assert actions.tolist() == _chosen(found, observed)


def _chosen(found: QLearning, observed: Floats) -> list[int]:
    return [int(action) for action in found.actor()(observed, None, None)[0].argmax(1)]


@pytest.mark.parametrize(
    ("task", "settings", "says"),
    [
        (point(), {}, "needs discrete actions, and Point has continuous ones"),
        (point(discrete=True), {}, "needs states that are seen one-hot.* Point shows"),
        (None, {"steps_per_round": 1601}, "a multiple of learner.environments=16, got 1601"),
    ],
)
def test_what_has_no_table_is_refused(task: Any, settings: dict[str, Any], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        learner(task, **settings)


def test_one_pass_carries_a_reward_all_the_way_back() -> None:
    grid = GridworldSettings(rows=("S..G",), slip=0, horizon=4, segment_steps=2)
    task, right = grid.build(), np.eye(4, dtype=np.float32)[[1]]
    found = learner(task, rate=1.0, passes=1)
    envs = task.environments(1)
    rollout, _ = collect(envs, envs.reset(np.random.default_rng(0)), 4, lambda *_: (right, right))
    assert rollout.gold.tolist() == [[0, 0, 0, 1]]
    errors = found._pass(rollout, rollout.gold)
    np.testing.assert_allclose(errors[:, 0], [0.8**3, 0.8**2, 0.8, 1])
    np.testing.assert_allclose(found.values[:, 1], [0.8**3, 0.8**2, 0.8, 1])
