"""What an algorithm of stable-baselines3 begins with: the networks of a zip, or of a run of prefrl."""

from __future__ import annotations

from pathlib import Path
from typing import Any, NamedTuple

import torch
import yaml

from prefrl.components import ConfigError
from prefrl.policies.zips import bounds_of, bounds_told, read_modules, read_words, same_bounds, statistics_beside
from prefrl.protocols import ControlTask
from prefrl.storage.checkpoints import load_state, newest
from prefrl.types import State


class _Found(NamedTuple):
    modules: State
    variables: State


def take_over(model: Any, path: Path, task: ControlTask) -> None:
    """Give a model its networks and learned variables (SAC's temperature); its optimisers begin anew.

    Of a zip weights alone are read (`policies/zips.py`). Raises `ConfigError` for those of another algorithm, of other
    widths or spaces, and for a policy that sees observations through `VecNormalize`.
    """
    wanted = f"a zip of stable-baselines3's {type(model).__name__}, or a run with learner.kind=sb3 and that algorithm"
    if not path.exists():
        raise ConfigError(f"learner.start: there is no {path}, seen from {Path.cwd()}; expected {wanted}")
    try:
        found = _of_run(path, wanted) if path.is_dir() else _of_zip(path, wanted, task)
    except ValueError as error:
        raise ConfigError(f"learner.start: {error}") from error
    names, variables = model._get_torch_save_params()
    networks = [name for name in names if not name.endswith("optimizer")]
    if missing := [x for x in networks if x not in found.modules] + [x for x in variables if x not in found.variables]:
        raise ConfigError(f"learner.start: expected {wanted}; {path} has no {missing[0]!r}")
    try:
        for name in networks:
            getattr(model, name).load_state_dict(found.modules[name])
    except RuntimeError as error:  # torch says which layers, each on a line of its own
        raise ConfigError(
            f"learner.start: the networks of {path} are others than those of {type(model).__name__} on {task.name} "
            f"with this learner.policy; expected {wanted}, of the same task and widths. {error}"
        ) from error
    with torch.no_grad():
        for name in variables:
            getattr(model, name).copy_(found.variables[name])


def _of_zip(path: Path, wanted: str, task: ControlTask) -> _Found:
    said, version = read_words(path, f"expected {wanted}")
    bounds = bounds_of(path, said["action_space"])
    if not same_bounds(bounds, task.action_bounds):
        raise ValueError(
            f"expected a policy for {task.name}, with {bounds_told(task.action_bounds)}; {path} has one with "
            f"{bounds_told(bounds)}"
        )
    if statistics_beside(path, task.observation_size) is not None:
        raise ValueError(
            f"{path.with_suffix('.npz')} lies beside {path.name}, and learner.kind=sb3 shows observations as they are: "
            "start learner.kind=control from it, or move the file away if it belongs to another policy"
        )
    return _Found(*read_modules(path, version))


def _of_run(folder: Path, wanted: str) -> _Found:
    checkpoint, _ = newest(folder)
    said = yaml.safe_load((checkpoint / "config.yaml").read_text(encoding="utf-8"))
    kind = said["learner"]["kind"]
    if kind != "sb3":
        raise ValueError(
            f"expected {wanted}; {folder} is a run with learner.kind={kind}: what it learned is a zip after "
            f"`prefrl export {folder} --form sb3 --to policy.zip`"
        )
    state = load_state(checkpoint, "learner")
    return _Found(state["modules"], state["variables"])


__all__ = ["take_over"]
