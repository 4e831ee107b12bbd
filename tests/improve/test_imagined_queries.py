"""Questions about what the policy would do: imagined, whole, judged and drawn as if it had happened."""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from test_dyna import INSIDE, WORLD

from prefrl.components import ConfigError
from prefrl.config import Config
from prefrl.improve.backprop import BackpropSettings
from prefrl.improve.dyna import DynaSettings
from prefrl.protocols import DrawnTask, Task
from prefrl.store import Store
from prefrl.types import Segment

BACKPROP: dict[str, Any] = {"world": WORLD, "episodes": 2, "updates": 2, "branches": 4, "steps": 5, "device": "cpu"}
DYNA: dict[str, Any] = {"inside": INSIDE, "world": WORLD, "episodes": 2, "evaluation_episodes": 2, "device": "cpu"}


def toy(**settings: Any) -> Config:
    parts: dict[str, Any] = {
        "task": {"kind": "point"},
        "reward": {"kind": "mlp", "hidden": [8], "members": 1},
        "learner": {"kind": "dyna", **DYNA},
        "select": {"kind": "uniform", "imagined": True},
        "loop": {"rounds": 2, "labels": 8},
    }
    return Config.parse({name: part | settings.get(name, {}) for name, part in parts.items()})


def point() -> Task:
    return toy().build_task()


@pytest.mark.parametrize("settings", [DynaSettings(**DYNA), BackpropSettings(**BACKPROP)])
def test_segments_are_imagined_judged_by_the_true_world_and_cost_no_real_step(settings: Any) -> None:
    learner = settings.build(point(), np.random.default_rng(0))
    learner.imagine(12, np.random.default_rng(1))
    real, dreamt = learner.steps.learn, learner.steps.imagined
    pool = learner.imagine(12, np.random.default_rng(2))
    assert (learner.steps.learn, learner.steps.imagined) == (real, dreamt + 12 * 5)
    assert real > 0
    assert len({one.id for one in pool}) == len({one.episode for one in pool}) == 12  # none overlaps another
    assert len({one.observations[0].tobytes() for one in pool}) > 6  # from wherever it was
    seen = {row.tobytes() for row in learner.ground.data.observations}
    for one in pool:
        assert [row.tobytes() in seen for row in one.observations] == [True] + [False] * 4  # from a real state on
        np.testing.assert_allclose(one.states, one.observations)
        following = np.clip(one.observations + 0.1 * np.clip(one.actions, -1, 1), -1.5, 1.5)
        np.testing.assert_allclose(one.gold, -np.linalg.norm(following, axis=1), rtol=1e-5)


def test_a_world_that_cannot_be_followed_is_not_asked_about() -> None:
    learner = DynaSettings(**DYNA | {"world": WORLD | {"longest": 4}}).build(point(), np.random.default_rng(0))
    pool = learner.imagine(12, np.random.default_rng(1))
    assert all(one.episode.startswith("play") for one in pool)
    (note,) = learner.ground.notes
    assert "learner.world.longest (now 4)" in note
    assert note.startswith("12 of 12 segments to ask about are real ones: the learned world cannot be followed")
    again = DynaSettings(**DYNA).build(point(), np.random.default_rng(0))
    again.load(deepcopy(learner.state()))
    assert list(again.ground.notes) == [note]
    again.imagine(12, np.random.default_rng(1))
    assert not again.ground.notes


def test_a_run_asks_about_what_was_imagined_and_draws_it(tmp_path: Path) -> None:
    with Store[Segment](tmp_path / "store") as store:
        loop = toy().build(store)
        rounds = [done.metrics for done in loop.run()]
        asked = [one for judged in store.judged() for one in judged.query.candidates]
        assert len(asked) == 16
        assert all(one.episode.startswith("imagined ") for one in asked)
        assert cast(DrawnTask[Segment], loop.task).frames(asked[0]).shape == (5, 120, 120, 3)
        # The first episodes, and two in each round: nobody asked for more.
        assert rounds[2]["steps/learn"] - rounds[1]["steps/learn"] == 2 * 40


@pytest.mark.parametrize(
    ("settings", "says"),
    [
        ({"learner": {"kind": "control"}}, r"learner\.kind=control has no policy in a learned world"),
        ({"task": {"kind": "tmaze"}}, r"what is imagined of tmaze can neither be drawn nor judged"),
        ({"task": {"kind": "control", "hide": [2]}}, r"of Pendulum-v1 can neither .* as long as nothing is hidden"),
        ({"task": {"kind": "control", "after_end": "restart"}}, r"of Pendulum-v1 can neither .* or restarted"),
    ],
)
def test_what_nobody_could_imagine_or_judge_is_refused_before_it_begins(
    settings: dict[str, Any], says: str, tmp_path: Path
) -> None:
    config = Config.parse(toy().model_dump() | settings)
    with Store[Segment](tmp_path / "store") as store, pytest.raises(ConfigError, match=says):
        config.build(store)


def test_real_stand_ins_are_played_where_the_last_plays_hold_too_few() -> None:
    learner = DynaSettings(**DYNA | {"world": WORLD | {"longest": 4}}).build(point(), np.random.default_rng(0))
    assert len(learner.imagine(12, np.random.default_rng(1))) == 12
    spent = learner.steps.learn
    assert len({one.id for one in learner.imagine(400, np.random.default_rng(2))}) == 400
    assert learner.steps.learn > spent
    with pytest.raises(ValueError, match=r"plays hold \d+ segments of 5 steps .* raise learner\.episodes"):
        learner.ground.segments(4000, np.random.default_rng(3))
