"""Policies on their own: evaluate one, act with one, write one for others."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from prefrl.config import Config
from prefrl.policies import saved
from prefrl.policies.loaded import Loaded, check_leaves, outside
from prefrl.policies.zips import read_zip
from prefrl.protocols import ControlTask, control
from prefrl.rundir import RunError, open_saved
from prefrl.seeding import streams
from prefrl.types import Evaluation, Json


def evaluate(folder: Path, best: bool = False) -> tuple[Evaluation, int]:
    """Evaluate the newest policy of a run, or the best one by its newest reward; also returns the round that it is of.

    Raises `RunError` for the best one of a learner that keeps none.
    """
    run = open_saved(folder)
    with _of_runs():
        learner, task, round = saved.learner_of(folder, best)
    evaluation: Evaluation = learner.evaluate(run.reward(task), streams(run.config.seed, 0).evaluate)
    return evaluation, round


def load_policy(path: str | Path, best: bool = False) -> Loaded:
    """The last policy of a run of control, or the best one by its newest reward, or that of a zip of
    stable-baselines3 or sb3-contrib, of which weights and words alone are read (`prefrl.policies.zips` and `networks`);
    `predict` acts with it.

    Raises `RunError` for a run of text, for the best one of a learner that keeps none, and where nothing is there.
    """
    with _of_runs():
        return saved.loaded(Path(path), best)


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
    with _of_runs():
        learner, _, round = saved.acting(folder, best)
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
        with _of_runs():
            saved.check_zip(path, best)
            actor = read_zip(path).actor()
        save_onnx(actor, to)
        return
    with _of_runs():
        learner, task, _ = saved.acting(path, best)
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


def _of_env(env: str) -> Json:
    return {"task": {"kind": "control", "env": env}, "reward": {"kind": "mlp"}, "learner": {"kind": "control"}}


@contextmanager
def _of_runs() -> Iterator[None]:
    """What is wrong with what was named is said as a `RunError`."""
    try:
        yield
    except ValueError as error:
        raise RunError(str(error)) from error
