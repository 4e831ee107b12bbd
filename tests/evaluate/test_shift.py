"""A policy beside an expert: errors by hand, an expert that meets itself, and what a run leaves of it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from prefrl.config import Config
from prefrl.envs.control import ControlSettings
from prefrl.envs.experts import EXPERTS
from prefrl.evaluate.card import Mistakes, Shift, read_part
from prefrl.evaluate.shift import FILE, Yardstick, errors, every, keep_mistakes
from prefrl.policies.acting import Actor
from prefrl.policies.rollout import Rollout
from prefrl.protocols import Acts, ControlTask
from prefrl.rundir import Run
from prefrl.types import Floats, Segment

_, swing_up = EXPERTS["Pendulum-v1"]


def spaces(bounds: tuple[list[float], list[float]] | None) -> ControlTask:
    return cast("ControlTask", SimpleNamespace(action_bounds=bounds, horizon=3))


def acting(act: Callable[[Floats], Floats]) -> Acts:
    def actor(observations: Floats, rng: object, memory: Floats | None) -> tuple[Floats, Floats | None]:
        return act(observations), memory

    return cast("Acts", SimpleNamespace(actor=lambda: cast("Actor", actor)))


def test_an_error_is_a_share_of_the_range_or_one_where_actions_are_discrete() -> None:
    discrete = np.eye(3)[[0, 1, 2]]
    np.testing.assert_array_equal(errors(spaces(None), discrete, np.eye(3)[[0, 2, 2]]), [0, 1, 0])
    bounded = spaces(([-2.0, 0.0], [2.0, np.inf]))
    # A quarter of the range of 4, and of what has no bounds half of 2; far beyond it no more than 1.
    found = errors(bounded, np.array([[1.0, 1.0], [0.0, 9.0]]), np.array([[0.0, 2.0], [0.0, 0.0]]))
    np.testing.assert_allclose(found, [(0.25 + 0.5) / 2, (0 + 1) / 2])


def test_errors_are_averaged_over_the_episodes_that_go_on_and_eps_over_the_experts_own() -> None:
    def seen(rows: list[list[int]]) -> Floats:
        return np.array(rows, np.float32)[..., None]

    def one_hot(at: Floats) -> Floats:
        found: Floats = np.eye(2, dtype=np.float32)[(at[..., 0] > 0).astype(int)]
        return found

    task = spaces(None)
    states = seen([[1, 0, 1], [0, 0, 0]])
    ends = np.array([[0, 0, 1], [0, 1, 0]], bool)
    rest: dict[str, Any] = {"final_observations": states, "terminated": ends, "truncated": ends, "gold": ends}
    own = Rollout(states, one_hot(states), one_hot(states), **rest, states=None)
    yardstick = Yardstick(task, one_hot, own)
    episodes = [
        Segment(seen([[1, 1, 0]])[0], np.eye(2, dtype=np.float32)[[0, 1, 1]], "a", 0),
        Segment(seen([[0]])[0], np.eye(2, dtype=np.float32)[[0]], "b", 0),
    ]
    always_right = acting(lambda at: np.eye(2, dtype=np.float32)[np.ones(len(at), int)])
    found = yardstick.mistakes(4, always_right, episodes)
    # It is wrong in the states 0: one of three in the first episode, both of the two before the end in the second.
    assert found == Mistakes(round=4, eps=3 / 5, error=[0.5, 0.0, 1.0], running=[1.0, 0.5, 0.5])


def test_an_expert_beside_itself_makes_no_mistake() -> None:
    task = ControlSettings(env="Pendulum-v1", horizon=6, segment_steps=3).build()
    yardstick = Yardstick.of(task, swing_up, 2, np.random.default_rng(0))
    episodes = [Segment(yardstick.own.observations[i], yardstick.own.actions[i], str(i), 0) for i in range(2)]
    own, other = (yardstick.mistakes(1, acting(act), episodes) for act in (swing_up, lambda x: -swing_up(x)))
    assert (own.eps, own.error, own.running) == (0.0, [0.0] * 6, [1.0] * 6)
    assert other.eps == pytest.approx(np.abs(2 * yardstick.own.actions).mean() / 4)


def test_a_round_that_is_done_again_takes_the_place_of_itself_and_of_later_ones(tmp_path: Path) -> None:
    for number, eps in ((0, 0.5), (1, 0.4), (2, 0.3), (1, 0.2)):
        keep_mistakes(tmp_path, Mistakes(round=number, eps=eps, error=[eps], running=[1.0]), 3, 2500)
    shift = read_part(Shift, tmp_path / FILE)
    assert shift is not None
    assert [(one.round, one.eps) for one in shift.rounds] == [(0, 0.5), (1, 0.2)]
    assert (shift.episodes, shift.every, every(1000)) == (3, 3, 1)
    (tmp_path / "shift.json").write_text("{")
    assert read_part(Shift, tmp_path / FILE) is None


def test_a_run_with_an_expert_measures_mistakes_and_fits_on_demonstrations_alone(tmp_path: Path) -> None:
    small = (
        "task.horizon=20",
        "task.segment_seconds=0.25",
        "learner.cloning_epochs=1",
        "learner.evaluation_episodes=2",
    )
    fits = ("fitting.demonstrations=1", "fitting.epochs=1", "loop.labels=8", "loop.rounds=2", "loop.pool=4")
    config = Config.load("control/pendulum-dagger", [*small, *fits])
    with Run(config, tmp_path / "run") as run:
        rounds = list(run)
        run.report()
    shift = read_part(Shift, tmp_path / "run" / FILE)
    assert shift is not None
    assert [(one.round, len(one.error)) for one in shift.rounds] == [(0, 20), (1, 20), (2, 20)]
    assert shift.rounds[0].eps != shift.rounds[1].eps
    assert rounds[-1].metrics["label/demonstrations"] == 9 == rounds[-1].metrics["label/answered"]
    assert json.loads((tmp_path / "run" / "summary.json").read_text())["labels"]["demonstrations"] == 9
    # What an expert does to be measured by is no step of the learner's.
    assert rounds[0].metrics["steps/evaluate"] == 2 * 20
    page = (tmp_path / "run" / "report.html").read_text()
    assert "Does it follow the expert?" in page
    assert "9 demonstrations" in page
