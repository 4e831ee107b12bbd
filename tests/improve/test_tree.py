"""Tree search in a world that is learned by counting: it takes the actions of value iteration."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from control_stubs import Known, Point, point
from corridor import corridor
from small_worlds import world
from test_loop import leaves

from prefrl.components import ConfigError
from prefrl.envs import exact
from prefrl.envs.counted import Counted
from prefrl.envs.fast.vectorised import Vectorised
from prefrl.envs.tabular import GridworldSettings
from prefrl.envs.toys import ToyTask
from prefrl.improve.planner import PlannerSettings
from prefrl.improve.tree import TreePlanner, tree_search
from prefrl.policies.rollout import Rollout, collect
from prefrl.store import Store
from prefrl.types import Floats, Segment

GRID = GridworldSettings(rows=("S..", ".#x", "..G"), slip=0.2, horizon=20)
MDP = replace(GRID.world().mdp, discount=0.8)
TRUE = Known(lambda observations, actions: np.einsum("...s,...a,sa", observations, actions, MDP.rewards))
SMALL: dict[str, Any] = {"simulations": 150, "plan": 20, "discount": 0.8, "episodes": 8, "evaluation_episodes": 20}


def at_random(task: ToyTask, steps: int, seed: int = 0) -> Rollout:
    rng, envs = np.random.default_rng(seed), task.environments(10)

    def act(observations: Floats, *_: object) -> tuple[Floats, Floats]:
        chosen = np.eye(4, dtype=np.float32)[rng.integers(4, size=len(observations))]
        return chosen, chosen

    return collect(envs, envs.reset(rng), steps, act)[0]


def planner(task: Any = None, **settings: Any) -> TreePlanner:
    given = {"algorithm": "mcts"} | SMALL | settings
    found = PlannerSettings.model_validate(given).build(task or GRID.build(), np.random.default_rng(0))
    assert isinstance(found, TreePlanner)
    return found


@pytest.fixture
def store(tmp_path: Path) -> Store[Segment]:
    return Store[Segment](tmp_path / "store")


def test_counts_come_to_the_true_tables_and_what_was_not_tried_changes_nothing() -> None:
    found = Counted(8, 4)
    with pytest.raises(ValueError, match="nothing was counted yet"):
        found.mdp(MDP.rewards, 0.8)
    found.add(at_random(GRID.build(), 600))
    learned = found.mdp(MDP.rewards, 0.8)
    assert np.abs(learned.transitions - MDP.transitions).max() < 0.12
    assert np.abs(learned.start - MDP.start).max() < 0.15
    assert found.seen == 1
    found.counts[3, 2] = 0
    assert found.seen == pytest.approx(31 / 32)
    assert found.mdp(MDP.rewards, 0.8).transitions[3, 2, 3] == 1


@pytest.mark.parametrize("seed", range(3))
def test_in_a_learned_world_it_takes_the_actions_of_value_iteration(seed: int) -> None:
    """In at least 95 % of all states, of ten worlds of twelve states each; those that are as good count as well."""
    taken = []
    for number in range(3):
        true = world(seed * 10 + number, states=12, actions=3, discount=0.8)
        rng = np.random.default_rng(number)
        counts = Counted(12, 3)
        counts.starts += 1
        for state, action in np.ndindex(12, 3):
            counts.counts[state, action] = rng.multinomial(30, true.transitions[state, action])
        learned = counts.mdp(true.rewards, 0.8)
        best, found = exact.value_iteration(learned), tree_search(learned, np.arange(12), 150, 25, 0.3, rng)
        taken.append(best[np.arange(12), found.argmax(1)] >= best.max(1) - 1e-6)
    assert np.mean(taken) >= 0.95


def test_a_search_looks_no_farther_than_its_depth_and_by_discount() -> None:
    line = GridworldSettings(rows=("S..G",), slip=0).world().mdp
    right = 1
    far, near = (tree_search(line, np.arange(4), 200, d, 0.3, np.random.default_rng(0)) for d in (4, 3))
    assert far[0, right] == pytest.approx(line.discount**3)
    assert near[0, right] == 0
    assert far[3].max() == pytest.approx(1.0)
    assert far[0].argmax() == right


def test_it_comes_to_the_best_policy_with_few_real_steps(store: Store[Segment]) -> None:
    learner = planner(simulations=300)
    for number in range(3):
        learner.sample(20, np.random.default_rng([number, 0]))
        metrics = learner.improve(TRUE, store, np.random.default_rng([number, 1]))
    policy = exact.greedy(learner.values)
    assert exact.regret(MDP, policy) < 0.02
    assert metrics["pairs_seen"] > 0.5  # what is seldom met is seldom tried
    assert learner.steps.learn < 1000
    assert learner.steps.imagined == 3 * 8 * 300 * 20
    found = learner.evaluate(TRUE, np.random.default_rng(0)).metrics
    assert found["learned"] == pytest.approx(found["gold"])


def test_a_saved_search_goes_on_to_equal_bytes_and_gold_never_touches_it(store: Store[Segment]) -> None:
    first, again = planner(), planner()
    first.sample(20, np.random.default_rng(0))
    first.improve(TRUE, store, np.random.default_rng(1))
    again.load(deepcopy(first.state()))
    for one in (first, again):
        one.sample(20, np.random.default_rng(2))
        one.improve(TRUE, store, np.random.default_rng(3))
    assert [*leaves(first.state())] == [*leaves(again.state())]
    hidden = planner()
    rollout = at_random(GRID.build(), 50)
    for one, gold in ((hidden, rollout.gold * np.nan), (again, rollout.gold)):
        one.world = Counted(8, 4)
        one.world.add(replace(rollout, gold=gold))
    assert hidden.world.counts.tobytes() == again.world.counts.tobytes()


def test_the_last_round_plays_nothing_more(store: Store[Segment]) -> None:
    learner = planner()
    learner.pace(0.5, 1.0)
    learner.improve(TRUE, store, np.random.default_rng(0))
    assert learner.steps.learn == 8 * 20  # at random, since nothing was known


class Begins(Point):
    """Every episode begins where it is seen one-hot."""

    def start(self, count: int, rng: np.random.Generator) -> Floats:
        return np.ones((count, 1))


def test_tasks_that_cannot_be_counted_are_refused() -> None:
    with pytest.raises(ConfigError, match="have to be seen one-hot"):
        planner(point(discrete=True))
    later = replace(point(discrete=True), make=lambda n: Vectorised(Begins(), n, 20))
    with pytest.raises(ConfigError, match=r"Point shows \[0\.8\]: use learner\.kind=dyna"):
        planner(later)
    with pytest.raises(ConfigError, match=r"those of Point are continuous: use learner\.algorithm=cem"):
        planner(point())
    with pytest.raises(ConfigError, match=r"in Corridor not all of them always are: use learner\.kind=control"):
        planner(corridor())
