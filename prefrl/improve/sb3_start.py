"""What an algorithm of stable-baselines3 begins with: the networks of a zip, or of a run of prefrl."""

from __future__ import annotations

from inspect import signature
from pathlib import Path
from typing import Any, NamedTuple

import torch
import yaml

from prefrl.components import ConfigError
from prefrl.policies.loaded import Bounds, bounds_told, same_bounds
from prefrl.policies.saved import task_of
from prefrl.policies.zips import (
    activation_of,
    bounds_of,
    read_modules,
    read_words,
    squashes,
    statistics_beside,
)
from prefrl.protocols import ControlTask, control
from prefrl.storage.checkpoints import load_state, newest
from prefrl.types import State


class _Found(NamedTuple):
    modules: State
    variables: State
    activation: str
    squash: bool


def take_over(model: Any, path: Path, task: ControlTask) -> None:
    """Give a model its networks and learned variables (SAC's temperature); its optimisers begin anew.

    Of a zip weights alone are read (`policies/zips.py`). It does not say whose it is, and PPO, A2C and TRPO have the
    same networks. Raises `ConfigError` for those of another algorithm, of other networks or spaces, and for a policy
    that sees observations through `VecNormalize`.
    """
    name = type(model).__name__
    wanted = f"a zip of stable-baselines3's {name}, or a run with learner.kind=sb3 and that algorithm"
    if not path.exists():
        raise ConfigError(f"learner.start: there is no {path}, seen from {Path.cwd()}; expected {wanted}")
    try:
        plain = signature(type(model.policy)).parameters["activation_fn"].default.__name__
        found = _of_run(path, name, wanted, task) if path.is_dir() else _of_zip(path, wanted, task)
        _check_functions(found, path, model, plain)
        _load(found, path, model, wanted)
    except ValueError as error:
        raise ConfigError(f"learner.start: {error}") from error


def _load(found: _Found, path: Path, model: Any, wanted: str) -> None:
    names, variables = model._get_torch_save_params()
    networks = [name for name in names if not name.endswith("optimizer")]
    if missing := [x for x in networks if x not in found.modules] + [x for x in variables if x not in found.variables]:
        raise ValueError(f"expected {wanted}; {path} has no {missing[0]!r}")
    try:
        for name in networks:
            getattr(model, name).load_state_dict(found.modules[name])
    except RuntimeError as error:  # torch says which layers, each on a line of its own
        raise ValueError(
            f"the networks of {path} are others than those of {type(model).__name__} with this learner.policy; "
            f"expected {wanted}, of the same task and widths. {error}"
        ) from error
    with torch.no_grad():
        for name in variables:
            there, here = found.variables[name], getattr(model, name)
            if there.shape != here.shape:
                raise ValueError(f"{name} of {path} has shape {tuple(there.shape)}, expected {tuple(here.shape)}")
            here.copy_(there)


def _check_functions(found: _Found, path: Path, model: Any, plain: str) -> None:
    """What weights alone do not show."""
    if found.activation not in ("", plain):
        raise ValueError(
            f"the networks of {path} have {found.activation}, and those of {type(model).__name__} here have {plain}: "
            "go on with it in a script of your own, on prefrl's LearnedReward"
        )
    squash = bool((model.policy_kwargs or {}).get("squash_output"))
    if found.squash != squash:
        raise ValueError(f"the policy of {path} has squash_output={found.squash}: set learner.policy.squash_output")


def _of_zip(path: Path, wanted: str, task: ControlTask) -> _Found:
    said, version = read_words(path, f"expected {wanted}")
    _check_bounds(bounds_of(path, said.get("action_space")), path, task)
    if statistics_beside(path, task.observation_size) is not None:
        raise ValueError(
            f"{path.with_suffix('.npz')} lies beside {path.name}, and learner.kind=sb3 shows observations as they are: "
            "start learner.kind=control from it, or move the file away if it belongs to another policy"
        )
    return _Found(*read_modules(path, version), activation_of(said, ""), squashes(said))


def _of_run(folder: Path, name: str, wanted: str, task: ControlTask) -> _Found:
    checkpoint, _ = newest(folder)
    said = yaml.safe_load((checkpoint / "config.yaml").read_text(encoding="utf-8"))
    learner = said["learner"]
    if learner["kind"] != "sb3" or learner["algorithm"] != name:
        came = ", ".join(f"learner.{key}={learner[key]}" for key in ("kind", "algorithm") if key in learner)
        export = f" (of a run of control `prefrl export {folder} --form sb3 --to policy.zip` makes a zip of PPO)"
        raise ValueError(f"expected {wanted}; {folder} is a run with {came}{export if name == 'PPO' else ''}")
    there = control(task_of(said), f"{folder}: expected a run of a control task")
    _check_bounds(there.action_bounds, folder, task)
    state = load_state(checkpoint, "learner")
    return _Found(state["modules"], state["variables"], "", squashes(learner))


def _check_bounds(bounds: Bounds | None, path: Path, task: ControlTask) -> None:
    if not same_bounds(bounds, task.action_bounds):
        raise ValueError(
            f"expected a policy for {task.name}, with {bounds_told(task.action_bounds)}; {path} has one with "
            f"{bounds_told(bounds)}"
        )


__all__ = ["take_over"]
