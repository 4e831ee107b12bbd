"""Several tasks as one: what is seen of each, what is compared, what is measured, and what is refused by name."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from prefrl import Config, Run
from prefrl.components import ConfigError
from prefrl.envs.several import SeveralSettings, SeveralTask
from prefrl.label.demonstrator import Demonstrator
from prefrl.label.expert import ExpertSettings, play
from prefrl.policies.acting import forgetful
from prefrl.sample.segments import piece
from prefrl.store import Store
from prefrl.types import Floats, Query, Segment

LENGTHS: dict[str, Any] = {"horizon": 12, "segment_steps": 3}
CAR: dict[str, Any] = {"env": "MountainCar-v0", **LENGTHS}
ARM: dict[str, Any] = {"env": "Acrobot-v1", **LENGTHS}


def several(**tasks: Any) -> SeveralTask:
    return SeveralSettings.model_validate({"tasks": tasks}).build()


def test_observations_are_padded_and_end_in_the_number_of_their_task() -> None:
    task, rng = several(car=CAR, arm=ARM), np.random.default_rng(0)
    assert (task.observation_size, task.action_size, task.action_bounds) == (6 + 2, 3, None)
    envs = task.environments(5)
    seen = envs.reset(rng)
    np.testing.assert_array_equal(task.which(seen), [0, 1, 0, 1, 0])
    np.testing.assert_array_equal(seen[:, 6:], np.eye(2)[[0, 1, 0, 1, 0]])
    np.testing.assert_array_equal(seen[::2, 2:6], 0)
    # What happens in each task is what happens in it alone, one after the other on the same numbers.
    again = np.random.default_rng(0)
    alone = [one.environments(n) for one, n in zip(task.tasks, (3, 2), strict=True)]
    own = [one.reset(again) for one in alone]
    np.testing.assert_array_equal(seen[::2, :2], own[0])
    np.testing.assert_array_equal(seen[1::2, :6], own[1])
    actions = np.eye(3, dtype=np.float32)[[0, 1, 2, 2, 1]]
    step, parts = envs.step(actions), [one.step(actions[at::2]) for at, one in enumerate(alone)]
    np.testing.assert_array_equal(step.observations[::2, :2], parts[0].observations)
    np.testing.assert_array_equal(step.final_observations[1::2, :6], parts[1].final_observations)
    np.testing.assert_array_equal(step.rewards[1::2], parts[1].rewards)
    np.testing.assert_array_equal(step.final_observations[:, 6:], seen[:, 6:])
    states = envs.states()
    assert states is not None
    for at, name in enumerate(("car", "arm")):
        one = Segment(step.observations[at : at + 1], actions[at : at + 1], "e", 0, states[at : at + 1])
        assert task.frames(one).shape[0] == 1, name


def test_fewer_environments_than_tasks_are_of_some_that_are_drawn() -> None:
    envs, rng = several(car=CAR, arm=ARM).environments(1), np.random.default_rng(0)
    assert {int(envs.reset(rng)[0, -1]) for _ in range(20)} == {0, 1}


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ({"env": "CartPole-v1", **LENGTHS}, "actions of car and other differ, 3 choices and 2 choices"),
        ({"env": "Pendulum-v1", **LENGTHS}, r"actions .*3 choices and 1 numbers from \[-2.0\] to \[2.0\]"),
        (ARM | {"horizon": 20}, "horizon of car and other differ, 12 and 20.*set horizon for each"),
        (ARM | {"segment_steps": 4}, "segment_steps of car and other differ, 3 and 4"),
        (ARM | {"options": {"gravity": 3}}, r"task\.tasks\.other: task\.options: Acrobot-v1 has no option 'gravity'"),
    ],
)
def test_what_cannot_be_combined_is_refused_by_name(other: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        several(car=CAR, other=other)


def test_names_and_numbers_of_tasks_are_checked_when_the_settings_are_read() -> None:
    for tasks, said in (({"a/b": CAR, "c": ARM}, "letters, digits"), ({"a": CAR}, "at least 2")):
        with pytest.raises(ConfigError, match=said):
            Config.load("control/toy", [f"task={{kind: several, tasks: {tasks}}}"])
    both = several(car=CAR, arm=ARM)
    with pytest.raises(ConfigError, match="no expert is known for several: car, arm"):
        ExpertSettings().build(both)


def test_a_run_compares_within_a_task_and_reports_each(tmp_path: Path) -> None:
    few = ("loop.labels=12", "loop.rounds=2", "learner.steps_per_round=480", "learner.evaluation_episodes=5")
    short = ("fitting.epochs=1", *(f"task.tasks.{name}.horizon=20" for name in ("moon", "mars", "earth")))
    length = (f"task.tasks.{name}.segment_seconds=0.25" for name in ("moon", "mars", "earth"))
    config = Config.load("control/pendulum-several", (*few, *short, *length))
    with Run(config, tmp_path / "run") as run:
        last = list(run)[-1].metrics
    golds = [last[f"evaluate/gold/{name}"] for name in ("moon", "mars", "earth")]
    assert last["evaluate/gold"] == pytest.approx(np.mean(golds))  # of two, two and one episode
    assert len(set(golds)) == 3
    with Store[Segment](tmp_path / "run", write=False) as store:
        judged = store.judged()
    assert len(judged) == 12
    contexts = [{one.context for one in each.query.candidates} for each in judged]
    assert all(len(each) == 1 for each in contexts)
    assert set.union(*contexts) == {"moon", "mars", "earth"}


def test_what_was_shown_in_a_task_answers_queries_of_that_task_alone(tmp_path: Path) -> None:
    task, rng = several(car=CAR, arm=ARM), np.random.default_rng(0)

    def waits(observations: Floats) -> Floats:
        return np.eye(3, dtype=np.float32)[np.zeros(len(observations), int)]

    shown = play(task, forgetful(waits), 4, rng, ExpertSettings())
    assert {one.context for one in shown} == {"car", "arm"}
    with Store[Segment](tmp_path) as store:
        own = [replace(piece(one, 2, 3), actions=one.actions[2:5] * 0 + [0, 1, 0]) for one in shown]
        store.ask([Query((one,)) for one in own])
        Demonstrator("known", shown).answer(store, rng)
        answered = store.demonstrations()
    assert [one.like.context for one in answered] == [one.context for one in own]
