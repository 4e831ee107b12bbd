"""Dyna: it learns in its world, counts real and imagined steps apart, goes on as it was, and says when it stops."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from control_stubs import Known, point
from corridor import corridor
from test_loop import leaves

from prefrl.components import ConfigError
from prefrl.improve.dyna import Dyna, DynaSettings
from prefrl.store import Store
from prefrl.types import Segment, Steps

INSIDE: dict[str, Any] = {
    "environments": 8, "steps_per_round": 800, "rollout_steps": 25, "minibatch": 100, "epochs": 4, "critic_epochs": 2,
    "discount": 0.9, "learning_rate": 3e-3, "policy": {"hidden": (16, 16)},
}  # fmt: skip
WORLD: dict[str, Any] = {"members": 2, "hidden": (16,), "fit_steps": 200, "minibatch": 64, "learning_rate": 1e-2}


@pytest.fixture
def store(tmp_path: Path) -> Store[Segment]:
    return Store[Segment](tmp_path / "store")


def dyna(task: Any = None, **settings: Any) -> Dyna:
    given = {"inside": INSIDE, "world": WORLD, "episodes": 4, "evaluation_episodes": 5, "device": "cpu", **settings}
    return DynaSettings.model_validate(given).build(task or point(), np.random.default_rng(0))


def rounds(learner: Dyna, store: Store[Segment], numbers: range) -> dict[str, float]:
    for number in numbers:
        learner.sample(8, np.random.default_rng([number, 0]))
        found = learner.improve(Known(), store, np.random.default_rng([number, 1]))
    return found


def test_it_learns_in_its_world_to_stay_at_the_origin(store: Store[Segment]) -> None:
    learner = dyna()
    before = learner.evaluate(Known(), np.random.default_rng(9)).metrics
    metrics = rounds(learner, store, range(4))
    after = learner.evaluate(Known(), np.random.default_rng(9)).metrics
    assert before["gold"] < -8.0
    assert after["gold"] > -2.5
    assert "imagined" not in before
    assert after["imagined"] == pytest.approx(after["learned"], abs=1.5)  # the same policy, from the same states
    assert metrics["branch"] > 10
    assert metrics["world_held_out"] < 0.05


@pytest.mark.parametrize("discrete", [False, True])
def test_real_and_imagined_steps_are_counted_apart(store: Store[Segment], discrete: bool) -> None:
    spent: list[int] = []
    learner = dyna(point(discrete, spent=spent))
    learner.sample(8, np.random.default_rng(0))
    first = sum(spent)
    assert learner.steps == Steps(learn=first)
    learner.improve(Known(), store, np.random.default_rng(1))
    assert (sum(spent), learner.steps) == (first, Steps(learn=first, imagined=800))  # what was asked about is enough
    learner.sample(8, np.random.default_rng(2))
    assert (sum(spent), learner.steps) == (first + 80, Steps(learn=first + 80, imagined=800))
    learner.improve(Known(), store, np.random.default_rng(3))
    learner.improve(Known(), store, np.random.default_rng(4))  # nobody was asked: it plays by itself
    assert (sum(spent), learner.steps) == (first + 160, Steps(learn=first + 160, imagined=2400))
    learner.evaluate(Known(), np.random.default_rng(5))
    assert learner.steps == Steps(learn=first + 160, evaluate=100, imagined=2500)
    assert sum(spent) == first + 260


def test_only_who_dreams_has_imagined_steps_in_its_ledger() -> None:
    assert Steps(1, 2, 3).counted() == {"learn": 1, "query": 2, "evaluate": 3}
    assert Steps(1, imagined=4).counted()["imagined"] == 4


def test_gold_never_touches_what_is_learned(store: Store[Segment]) -> None:
    states = []
    for hide in (False, True):
        learner = dyna(point(hide_gold=hide), inside=INSIDE | {"steps_per_round": 200})
        rounds(learner, store, range(2))
        state = learner.state()
        for one in state["ground"]["plays"]:
            del one["gold"]  # of what was done, for oracles
        state["inside"]["recent"].pop("gold")
        states.append([*leaves(state)])
    assert states[0] == states[1]


def test_a_saved_learner_goes_on_to_equal_bytes(store: Store[Segment]) -> None:
    first = dyna()
    rounds(first, store, range(2))
    again = dyna()
    again.load(deepcopy(first.state()))
    for one in (first, again):
        rounds(one, store, range(2, 3))
    assert [*leaves(first.state())] == [*leaves(again.state())]
    assert first.steps == again.steps


def test_a_run_says_that_it_has_stopped_dreaming_and_goes_on_when_the_world_is_better(store: Store[Segment]) -> None:
    learner = dyna()
    rounds(learner, store, range(3))
    acted = learner.actor()(np.linspace(-1, 1, 9, dtype=np.float32)[:, None], None, None)[0]
    real = learner.ground.data
    assert real is not None
    learner.ground.data = replace(real, following=np.random.default_rng(0).permutation(real.following))
    metrics = learner.improve(Known(), store, np.random.default_rng(1))
    assert (metrics["reach"], metrics["branch"]) == (0, 0)
    assert learner.steps.imagined == 2400
    still = learner.actor()(np.linspace(-1, 1, 9, dtype=np.float32)[:, None], None, None)[0]
    assert acted.tobytes() == still.tobytes()
    (note,) = learner.evaluate(Known(), np.random.default_rng(2)).notes
    assert "has stopped dreaming" in note
    learner.ground.data = real
    assert learner.improve(Known(), store, np.random.default_rng(3))["reach"] > 10
    assert not learner.evaluate(Known(), np.random.default_rng(2)).notes


def test_questions_after_the_first_are_about_the_policy_as_it_is(store: Store[Segment]) -> None:
    learner = dyna()
    pools = []
    for number in range(3):
        pools.append(learner.sample(8, np.random.default_rng(number)))
        assert {one.episode for one in learner.sample(8, np.random.default_rng(9))} & {one.episode for one in pools[-1]}
        learner.improve(Known(), store, np.random.default_rng(number))
    names = [{one.episode for one in pool} for pool in pools]
    assert not names[0] & names[1]
    assert not names[1] & names[2]
    assert all(one.gold is not None and one.states is not None for pool in pools for one in pool)


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"inside": {"device": "cpu"}}, r"inside\.device: write it as learner\.device"),
        ({"inside": {"evaluation_episodes": 3}}, r"write it as learner\.evaluation_episodes"),
        ({"inside": {"rollback": 0.3}}, r"inside\.rollback: the learner inside keeps no best policy"),
        ({"inside": {"clone": {"keep": 0.1}}}, r"give its run as learner\.inside\.start"),
    ],
)
def test_what_belongs_outside_is_refused_inside(settings: dict[str, Any], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        DynaSettings.model_validate(settings)


class Texts:
    """A task of another kind."""

    name, kind = "texts", "text"


def test_other_tasks_are_refused() -> None:
    with pytest.raises(ConfigError, match="'dyna' plays real episodes of control"):
        DynaSettings().build(Texts(), np.random.default_rng(0))
    with pytest.raises(ConfigError, match=r"in Corridor not all of them always are: use learner\.kind=control"):
        dyna(corridor())


def test_real_steps_grow_by_episodes_and_work_by_what_is_imagined() -> None:
    settings = DynaSettings.model_validate({"episodes": 3, "inside": {"steps_per_round": 6400}})
    assert (settings.work(), settings.real_work()) == (6400, 3)


def test_a_shrunk_run_can_be_read_again() -> None:
    small = DynaSettings().shrunk()
    assert DynaSettings.model_validate(small.model_dump()) == small
