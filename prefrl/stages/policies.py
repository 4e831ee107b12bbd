"""Policies on their own: evaluate one, act with one, write one for others."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from prefrl.config import Config
from prefrl.policies.loaded import Loaded, check_leaves, outside
from prefrl.policies.zips import Zipped, read_zip
from prefrl.protocols import Acts, ControlTask, Settles, control
from prefrl.rundir import RunError, open_saved
from prefrl.seeding import streams
from prefrl.storage.checkpoints import load_state
from prefrl.types import Evaluation, Json


def evaluate(folder: Path, best: bool = False) -> tuple[Evaluation, int]:
    """Evaluate the newest policy of a run, or the best one by its newest reward; also returns the round that it is of.

    Raises `RunError` for the best one of a learner that keeps none.
    """
    saved = open_saved(folder)
    learner, task, round = _learner_of(folder, best)
    evaluation: Evaluation = learner.evaluate(saved.reward(task), streams(saved.config.seed, 0).evaluate)
    return evaluation, round


def load_policy(path: str | Path, best: bool = False) -> Loaded:
    """The last policy of a run of control, or the best one by its newest reward, or that of a zip of
    stable-baselines3, of which weights alone are read (`prefrl.policies.zips`); `predict` acts with it.

    Raises `RunError` for a run of text, for the best one of a learner that keeps none, and where nothing is there.
    """
    if Path(path).is_file():
        return _zipped(Path(path), best).loaded()
    learner, task, _ = _acting(_there(Path(path)), best)
    discrete = task.action_bounds is None
    return Loaded(learner.actor(), task.observation_size, task.action_size, discrete, outside(task))


def on_stage(path: Path, env: str | None, best: bool = False) -> tuple[Loaded, ControlTask]:
    """A policy, as `load_policy` gives it, and where it acts: in its run's task, or in gymnasium's `env`.

    Raises `RunError` for a zip without an `env`, which it does not name itself.
    """
    policy = load_policy(path, best)
    if env is None and path.is_file():
        raise RunError(f"{path} does not say which environment it is for: name it, as in --env Pendulum-v1")
    task = open_saved(path).config.build_task() if env is None else Config.parse(_of_env(env)).build_task()
    found = control(task, f"{path}: a policy of control is expected")
    policy.check(found, str(path))
    return policy, found


def export_sb3(folder: Path, to: Path, best: bool = False) -> int:
    """Write a run's policy of control as a zip of stable-baselines3; returns the round that it is of.

    Raises `RunError` as `load_policy` does.
    """
    learner, _, round = _acting(folder, best)
    learner.save(to)
    return round


def export_onnx(path: Path, to: Path, best: bool = False) -> None:
    """Write the mode of a policy of control as ONNX: that of a run with our own learner, or of a zip.

    Raises `RunError` for others.
    """
    from prefrl.improve.control import ControlLearner
    from prefrl.policies.mlp import MLPPolicy
    from prefrl.policies.to_onnx import ACTIVATIONS, save_onnx

    if path.is_file():
        save_onnx(_zipped(path, best).actor(), to)
        return
    learner, task, _ = _acting(_there(path), best)
    check_leaves(task)
    if not isinstance(learner, ControlLearner):
        raise RunError(
            f"{path}: expected a run with learner.kind=control, and its policy is that of a {type(learner).__name__}; "
            "export it with --form sb3, and from there as stable-baselines3's documentation says"
        )
    policy = learner.policy
    if not isinstance(policy, MLPPolicy) or policy.settings.activation not in ACTIVATIONS:
        wanted = " or ".join(ACTIVATIONS)
        raise RunError(f"{path}: expected learner.policy.kind=mlp with {wanted}; no other is written as ONNX")
    save_onnx(policy.numpy_actor(), to)


def shown_of(path: Path) -> str:
    """In words, in brackets, what a run's policy sees of its task's observations; empty where that is all of them."""
    found = outside(open_saved(path).config.build_task()) if path.is_dir() else None
    return f" ({found.shown})" if found is not None and found.shown else ""


def _zipped(path: Path, best: bool) -> Zipped:
    if best:
        raise RunError(f"{path}: a zip holds one policy, and no best one beside it; leave --best out")
    return read_zip(path)


def _there(path: Path) -> Path:
    if not path.exists():
        raise RunError(f"there is no {path}: expected the folder of a run, or a zip of stable-baselines3")
    return path


def _of_env(env: str) -> Json:
    return {"task": {"kind": "control", "env": env}, "reward": {"kind": "mlp"}, "learner": {"kind": "control"}}


def _acting(folder: Path, best: bool) -> tuple[Acts, Any, int]:
    from prefrl.improve.planner import Planner
    from prefrl.improve.tree import TreePlanner

    learner, task, round = _learner_of(folder, best)
    if isinstance(learner, Planner | TreePlanner):
        raise RunError(
            f"{folder}: learner.kind=planner has no policy to load: what to do is searched for in each step, in the "
            "run's learned world; `prefrl evaluate` plays its episodes"
        )
    if not isinstance(learner, Acts):
        raise RunError(f"{folder}: its policy does not act in an environment; expected a run of a control task")
    return learner, task, round


def _learner_of(folder: Path, best: bool) -> tuple[Any, Any, int]:
    """A run's learner with its last policy, or its best one; its task, and the round that the policy is of."""
    saved = open_saved(folder)
    task = saved.config.build_task()
    learner = saved.config.build_learner(task, streams(saved.config.seed, 0).build)
    try:
        learner.load(load_state(saved.folder, "learner"))
    except ValueError as error:
        raise RunError(f"{folder}: {error}") from error
    if not best:
        return learner, task, json.loads((saved.folder / "loop.json").read_text())["round"]
    if not isinstance(learner, Settles):
        raise RunError(f"{folder}: its learner ({type(learner).__name__}) keeps no best policy beside the last one")
    if (best_round := learner.go_back()) is None:
        raise RunError(
            f"{folder}: no best policy is kept beside the last one, since learner.rollback is null, or no fit was "
            "followed by an evaluation yet; leave --best out, or set learner.rollback=0.1 in a new run"
        )
    return learner, task, best_round
