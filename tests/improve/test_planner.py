"""Planning in a learned world: what is found is best there, by CEM and MPPI, and it needs no policy to get there."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from control_stubs import Known, point
from corridor import corridor
from test_loop import leaves

from prefrl.components import ConfigError
from prefrl.config import Config
from prefrl.improve.planner import Planner, PlannerSettings, Search
from prefrl.stages.trial import estimate
from prefrl.store import Store
from prefrl.types import Floats, Segment, Steps

WORLD: dict[str, Any] = {"members": 2, "hidden": (16,), "fit_steps": 300, "minibatch": 64, "learning_rate": 1e-2}
SMALL: dict[str, Any] = {"candidates": 40, "plan": 6, "episodes": 2, "evaluation_episodes": 5, "device": "cpu"}

FOLLOWS: dict[str, dict[str, Any]] = {"cem": {}, "mppi": {"temperature": 0.1}}
"""With which each follows what is best."""


@pytest.fixture
def store(tmp_path: Path) -> Store[Segment]:
    return Store[Segment](tmp_path / "store")


def planner(task: Any = None, **settings: Any) -> Planner:
    given = SMALL | {"world": WORLD} | settings
    found = PlannerSettings.model_validate(given).build(task or point(), np.random.default_rng(0))
    assert isinstance(found, Planner)
    return found


def rounds(learner: Planner, store: Store[Segment], numbers: range) -> None:
    for number in numbers:
        learner.sample(8, np.random.default_rng([number, 0]))
        learner.improve(Known(), store, np.random.default_rng([number, 1]))


@pytest.mark.parametrize("algorithm", ["cem", "mppi"])
def test_it_comes_to_the_middle_without_a_policy(store: Store[Segment], algorithm: str) -> None:
    learner = planner(algorithm=algorithm, **FOLLOWS[algorithm])
    before = learner.evaluate(Known(), np.random.default_rng(9)).metrics["gold"]
    rounds(learner, store, range(3))
    after = learner.evaluate(Known(), np.random.default_rng(9)).metrics["gold"]
    assert before < -8.0
    assert after > -2.6


@dataclass(frozen=True)
class Line:
    """A world whose members move a point by 0.1 and by 0.3 of the action."""

    reach: int = 4
    members: int = 2
    device = torch.device("cpu")

    def predict(self, observations: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        moved = observations + torch.tensor([0.1, 0.3])[:, None, None] * actions
        return torch.cat([moved, torch.zeros_like(moved)], -1)


def search(**settings: Any) -> Search:
    bounds = np.array([0.0], np.float32), np.array([4.0], np.float32)  # the middle is 2, half of the range 2
    given = PlannerSettings.model_validate(SMALL | {"plan": 9, "discount": 0.5} | settings)
    return Search(given, Line(), Known(lambda o, a: o[..., 0] + 10 * a[..., 0]), bounds)  # type: ignore[arg-type]


def test_a_plan_is_worth_its_discounted_rewards_by_the_member_of_its_turn() -> None:
    found = search()
    plans = np.zeros((2, 4, 4, 1))
    plans[1, :, 0] = 0.5  # an action of 3 first, where 0 is one of 2
    worth = found.worth(np.array([[0.0], [5.0]], np.float32), plans)
    assert worth.shape == (2, 4)
    discounts = 0.5 ** np.arange(4)
    for state, start, first in ((0, 0.0, 2.0), (1, 5.0, 3.0)):
        actions = np.array([first, 2.0, 2.0, 2.0])
        for sequence in range(4):
            step = (0.1, 0.3)[sequence % 2]
            states = start + step * np.concatenate([[0.0], actions[:-1].cumsum()])
            np.testing.assert_allclose(worth[state, sequence], discounts @ (states + 10 * actions), rtol=1e-5)


def test_plans_are_no_longer_than_the_world_reaches_and_count_what_they_imagine() -> None:
    found = search(candidates=7, iterations=3)
    assert found.length == 4
    assert found.cost(5) == 5 * 8 * 3 * 4  # as many sequences for each of two members
    plans = found(np.zeros((5, 1), np.float32), np.random.default_rng(0), None)
    assert plans.shape == (5, 4, 1)
    assert np.abs(plans).max() <= 1


@pytest.mark.parametrize("algorithm", ["cem", "mppi"])
def test_the_best_plan_is_found_and_a_plan_before_is_gone_on_from(algorithm: str) -> None:
    found = search(algorithm=algorithm, iterations=5, candidates=60, **FOLLOWS[algorithm])
    states = np.zeros((1, 1), np.float32)
    plans = found(states, np.random.default_rng(0), None)
    assert plans[0, 0, 0] > 0.7  # as much as there is
    good, bad = (found(states, np.random.default_rng(1), np.full((1, 4), at, np.float32)) for at in (0.9, -0.9))
    assert good.mean() > bad.mean()


def test_cem_fits_the_best_sequences_and_mppi_weighs_all() -> None:
    plans, worth = np.arange(20.0).reshape(1, 20, 1, 1), np.arange(20.0)[None]
    mean, std = search(elites=0.1)._best(plans, worth)
    assert (mean.item(), std.item()) == (18.5, 0.5)
    sharp, blunt = (search(algorithm="mppi", temperature=t)._weighted(plans, worth).item() for t in (1e-3, 1e6))
    assert (sharp, blunt) == pytest.approx((19.0, 9.5), rel=1e-3)


def test_every_step_is_counted_and_the_last_round_plays_nothing_more(store: Store[Segment]) -> None:
    spent: list[int] = []
    learner = planner(point(spent=spent), world=WORLD | {"fit_steps": 100})
    learner.sample(8, np.random.default_rng(0))
    first = sum(spent)
    learner.improve(Known(), store, np.random.default_rng(1))
    step = 40 * 3 * 6  # candidates, iterations, steps of a plan
    assert (sum(spent), learner.steps) == (first + 40, Steps(learn=first + 40, imagined=40 * step))
    learner.sample(8, np.random.default_rng(2))
    learner.pace(0.5, 1.0)
    learner.improve(Known(), store, np.random.default_rng(3))
    assert learner.steps == Steps(learn=first + 40, imagined=40 * step)
    learner.evaluate(Known(), np.random.default_rng(4))
    assert learner.steps == Steps(learn=first + 40, evaluate=100, imagined=140 * step)
    assert sum(spent) == first + 140


def test_gold_never_touches_what_is_learned(store: Store[Segment]) -> None:
    states = []
    for hide in (False, True):
        learner = planner(point(hide_gold=hide), world=WORLD | {"fit_steps": 50})
        rounds(learner, store, range(2))
        state = learner.state()
        for one in state["ground"]["plays"]:
            del one["gold"]  # of what was done, for oracles
        states.append([*leaves(state)])
    assert states[0] == states[1]


def test_a_saved_planner_goes_on_to_equal_bytes(store: Store[Segment]) -> None:
    first, again = planner(), planner()
    rounds(first, store, range(1))
    again.load(deepcopy(first.state()))
    for one in (first, again):
        rounds(one, store, range(1, 2))
    assert [*leaves(first.state())] == [*leaves(again.state())]
    evaluated = [one.evaluate(Known(), np.random.default_rng(1)).metrics for one in (first, again, first)]
    assert evaluated[0] == evaluated[1] == evaluated[2]  # no draws but fixed ones


def test_where_the_world_is_not_to_be_trusted_nothing_is_planned_and_it_says_so(store: Store[Segment]) -> None:
    learner = planner()
    learner.sample(400, np.random.default_rng(0))
    assert learner.ground.data is not None
    rng = np.random.default_rng(1)
    learner.ground.data.following[:] = rng.normal(size=learner.ground.data.following.shape)
    assert learner.improve(Known(), store, rng)["reach"] == 0
    found = learner.evaluate(Known(), np.random.default_rng(2))
    assert learner.steps.imagined == 0
    assert "cannot be trusted" in found.notes[0]
    assert "has stopped dreaming" in found.notes[0]
    again = planner()
    again.load(deepcopy(learner.state()))
    assert again.evaluate(Known(), np.random.default_rng(2)).notes == found.notes


def test_a_world_that_cannot_be_tested_is_not_trusted_and_the_note_has_numbers_or_none() -> None:
    ground = planner().ground
    ground.play(1, lambda observations, *_: (np.zeros_like(observations),) * 2, np.random.default_rng(0))
    assert ground.learn(np.random.default_rng(1)) == {"world_steps": 0.0, "reach": 0.0}
    assert "no held-out step says how good it is" in ground.notes[0]
    assert "nan" not in ground.notes[0]


def test_a_dry_run_scales_real_steps_by_real_episodes_alone() -> None:
    given = "learner.kind=planner", "learner.evaluation_episodes=1"
    narrow, wide, longer = (
        estimate(Config.load("control/toy", [*given, more]))
        for more in ("learner.candidates=20", "learner.candidates=1000", "learner.episodes=3")
    )
    assert narrow.steps == wide.steps
    assert longer.steps > 2 * narrow.steps
    assert wide.machine > narrow.machine


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        (
            {"algorithm": "mcts", "candidates": 40},
            "candidates is a setting of cem and mppi, and algorithm=mcts has none",
        ),
        ({"algorithm": "mcts", "elites": 0.3}, "elites is a setting of cem, and algorithm=mcts has none"),
        ({"algorithm": "mcts", "world": {"members": 2}}, "world is a setting of cem and mppi"),
        ({"algorithm": "mppi", "elites": 0.3}, "elites is a setting of cem, and algorithm=mppi has none"),
        ({"temperature": 0.1}, "temperature is a setting of mppi, and algorithm=cem has none"),
        ({"simulations": 9}, "simulations is a setting of mcts"),
        ({"algorithm": "mppi", "epsilon": 0.0}, "epsilon is a setting of mcts"),
    ],
)
def test_settings_of_another_algorithm_are_refused_by_name(settings: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        PlannerSettings.model_validate(settings)


@pytest.mark.parametrize("algorithm", ["cem", "mppi", "mcts"])
def test_what_was_saved_or_shrunk_can_be_read_again(algorithm: str) -> None:
    given = PlannerSettings.model_validate({"algorithm": algorithm})
    for one in (given, given.shrunk()):
        assert PlannerSettings.model_validate(one.model_dump()) == one


def test_what_a_search_takes_grows_by_what_it_tries() -> None:
    tree = PlannerSettings.model_validate({"algorithm": "mcts", "simulations": 50, "plan": 7, "episodes": 3})
    assert (tree.work(), tree.real_work()) == (350, 3)
    assert PlannerSettings(plan=5, candidates=10, iterations=2).work() == 100


class Unbounded:
    """A task whose actions have no bounds."""

    name, kind, observation_size, action_size = "Free", "control", 1, 1
    action_bounds: tuple[Floats, Floats] = -np.full(1, np.inf), np.full(1, np.inf)


def test_actions_that_cannot_be_drawn_are_refused() -> None:
    with pytest.raises(ConfigError, match=r"those of Point are discrete: use learner\.kind=dyna"):
        planner(point(discrete=True))
    with pytest.raises(ConfigError, match="those of Free have none"):
        planner(Unbounded())
    with pytest.raises(ConfigError, match=r"in Corridor not all of them always are: use learner\.kind=control"):
        planner(corridor())
