"""A finished policy, wherever it lies: in the folder of a run, whatever its learner is, or in a zip."""

from __future__ import annotations

import json
from pathlib import Path
from typing import cast

import yaml

from prefrl.components import ConfigError, Role, Settings, settings_class, todays
from prefrl.policies.loaded import Loaded, outside
from prefrl.protocols import Acts, ControlTask, Learner, LearnerSettings, Settles, Task, TaskSettings, control
from prefrl.seeding import streams
from prefrl.storage.checkpoints import load_state, newest
from prefrl.types import Json


def loaded(path: Path, best: bool = False) -> Loaded:
    """The last policy of a run of control, or the best one by its newest reward, or that of a zip.

    Raises ValueError for what does not act in an environment, and for the best one where none is kept.
    """
    return of_zip(path, best) if path.is_file() else of_run(path, best)[0]


def expert(path: Path, task: ControlTask, who: str) -> Loaded:
    """The same for a task; `who` names the setting that wants it.

    Raises `ConfigError` for a policy of another task or of other spaces, and for what does not act at all.
    """
    if not path.exists():
        raise ConfigError(
            f"{who}: there is no {path}, seen from {Path.cwd()}; expected the folder of a run of control, or a zip of "
            "stable-baselines3"
        )
    try:
        found, of = (of_zip(path), task.name) if path.is_file() else of_run(path)
    except ValueError as error:
        raise ConfigError(f"{who}: {error}") from error
    if of != task.name:
        raise ConfigError(f"{who}: expected an expert for {task.name}, and {path} is a run of {of}: name another one")
    found.check(task, f"{who}={path}")
    return found


def of_run(folder: Path, best: bool = False) -> tuple[Loaded, str]:
    """The policy of a run, and the name of its task."""
    learner, task, _ = acting(folder, best)
    found = Loaded(learner.actor(), task.observation_size, task.action_size, task.action_bounds, outside(task))
    return found, task.name


def of_zip(path: Path, best: bool = False) -> Loaded:
    """The policy of a zip, whose pickles are not read."""
    check_zip(path, best)
    # Only here: a run of our own policies needs no stable-baselines3, which takes a second to load.
    from prefrl.policies.networks import read_policy

    return read_policy(path)


def check_zip(path: Path, best: bool) -> None:
    if best:
        raise ValueError(f"{path}: a zip holds one policy, and no best one beside it; leave --best out")


def acting(folder: Path, best: bool = False) -> tuple[Acts, ControlTask, int]:
    """As `learner_of`. Raises ValueError where the learner has no policy that acts."""
    checkpoint, said = _opened(folder)
    # Before anything is built: a language model takes its time.
    task = control(task_of(said), f"{folder}: expected a run of a control task")
    learner, round = _learned(folder, checkpoint, said, task, best)
    if not isinstance(learner, Acts):
        raise ValueError(
            f"{folder}: learner.kind={said['learner']['kind']} has no policy to load: a planner searches for what to "
            "do in each step, in the run's learned world; `prefrl evaluate` plays its episodes"
        )
    return learner, task, round


def learner_of(folder: Path, best: bool = False) -> tuple[Learner, Task, int]:
    """A run's learner with its last policy, or its best one; its task, and the round that the policy is of.

    Raises ValueError for the best one of a learner that keeps none, and for what is no run.
    """
    checkpoint, said = _opened(folder)
    task = task_of(said)
    learner, round = _learned(folder, checkpoint, said, task, best)
    return learner, task, round


def task_of(said: Json) -> Task:
    """The task of a run, from its saved settings."""
    return cast(TaskSettings, _settings("tasks", said["task"])).build()


def _opened(folder: Path) -> tuple[Path, Json]:
    """A run's newest good checkpoint, and its settings."""
    if not folder.exists():
        raise ValueError(f"there is no {folder}: expected the folder of a run, or a zip of stable-baselines3")
    checkpoint, _ = newest(folder)
    path = checkpoint / "config.yaml"
    if not path.is_file():
        raise ValueError(f"{checkpoint} holds no run: expected a file config.yaml in it")
    said: Json = yaml.safe_load(path.read_text(encoding="utf-8"))
    return checkpoint, said


def _settings(role: Role, saved: Json) -> Settings:
    """Those that this version or an earlier one saved."""
    said = todays(role, saved)
    return settings_class(role, said["kind"]).model_validate(said)


def _learned(folder: Path, checkpoint: Path, said: Json, task: Task, best: bool) -> tuple[Learner, int]:
    settings = cast(LearnerSettings, _settings("learners", said["learner"]))
    learner = settings.build(task, streams(said["seed"], 0).build)
    try:
        learner.load(load_state(checkpoint, "learner"))
    except ValueError as error:
        raise ValueError(f"{folder}: {error}") from error
    if not best:
        return learner, json.loads((checkpoint / "loop.json").read_text())["round"]
    if not isinstance(learner, Settles):
        raise ValueError(f"{folder}: its learner ({type(learner).__name__}) keeps no best policy beside the last one")
    if (round := learner.go_back()) is None:
        raise ValueError(
            f"{folder}: no best policy is kept beside the last one, since learner.rollback is null, or no fit was "
            "followed by an evaluation yet; leave --best out, or set learner.rollback=0.1 in a new run"
        )
    return learner, round


__all__ = ["acting", "check_zip", "expert", "learner_of", "loaded", "task_of"]
