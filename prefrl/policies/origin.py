"""Which policy another one starts from: that of a run, or one of stable-baselines3."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple, TypeAlias

import yaml
from torch import Tensor

from prefrl.components import ConfigError
from prefrl.policies.flow import FlowPolicySettings
from prefrl.policies.gru import GRUPolicySettings
from prefrl.policies.heads import ActionSpace
from prefrl.policies.loaded import Bounds, bounds_told, same_bounds
from prefrl.policies.mlp import MLPPolicySettings
from prefrl.policies.saved import task_of
from prefrl.policies.transformer import TransformerPolicySettings
from prefrl.policies.zips import read_zip, squashes, state_of
from prefrl.protocols import ControlTask, control
from prefrl.storage.checkpoints import load_state, newest
from prefrl.types import State

OURS = "a run of control with learner.kind=control, or with learner.kind=sb3 and PPO, A2C or TRPO"

OF_NETWORKS = {
    *("kind", "hidden", "critic_hidden", "activation", "chunk"),
    *("width", "layers", "heads", "context", "squash", "sde"),
}
"""Settings of a flow, or of networks with a memory, that have to be alike for one to be taken over."""
Owned: TypeAlias = FlowPolicySettings | GRUPolicySettings | TransformerPolicySettings
"""Kinds of policies that are taken over from runs alone."""


class _Found(NamedTuple):
    state: State
    bounds: Bounds | None
    squash: bool


def starting_state(path: Path, task: ControlTask, settings: MLPPolicySettings | Owned) -> State:
    """What the policy's `load` reads: the last policy of a run, or for an mlp that of a zip (`read_zip`).

    Raises `ConfigError` for a policy of other spaces, widths or noise, and for what is no policy of control.
    """
    if not isinstance(settings, MLPPolicySettings):
        return _owned(path, task, settings)
    found = _found(path)
    _check_spaces(found, path, task)
    _check_widths(found, path, settings.hidden)
    _check_noise(found, path, settings)
    return found.state


def _owned(folder: Path, task: ControlTask, settings: Owned) -> State:
    """The policy of a run. Raises `ConfigError` where it is of another kind, or another one."""
    if not folder.is_dir():
        raise ConfigError(
            f"learner.start: there is no {folder}, seen from {Path.cwd()}; expected the folder of a run with a policy "
            f"of kind {settings.kind}"
        )
    checkpoint, _ = newest(folder)
    said = yaml.safe_load((checkpoint / "config.yaml").read_text(encoding="utf-8"))
    there, wanted = said["learner"].get("policy") or {}, settings.model_dump(mode="json")
    if there.get("kind") != settings.kind:
        raise ConfigError(
            f"learner.start: expected a policy of kind {settings.kind}, and that of {folder} is of kind "
            f"{there.get('kind', 'mlp')}: set learner.policy.kind to it, or name another run"
        )
    # How a plan is made and measured is no part of the network.
    other = [name for name in sorted(OF_NETWORKS & set(wanted)) if there.get(name) != wanted[name]]
    if other:
        theirs, here = ({name: said.get(name) for name in other} for said in (there, wanted))
        raise ConfigError(
            f"learner.start: the policy of {folder} has learner.policy {theirs}, and here they are {here}: "
            "set them alike"
        )
    if (found := task_of(said)).name != task.name:
        raise ConfigError(f"learner.start: expected a policy for {task.name}, and {folder} is a run of {found.name}")
    state: State = load_state(checkpoint, "learner")["policy"]
    return state


def _found(path: Path) -> _Found:
    if not path.exists():
        raise ConfigError(
            f"learner.start: there is no {path}, seen from {Path.cwd()}; expected the folder of {OURS}, or a zip"
        )
    try:
        return _of_run(path) if path.is_dir() else _of_zip(path)
    except ValueError as error:
        raise ConfigError(f"learner.start: {error}") from error


def _of_zip(path: Path) -> _Found:
    zipped = read_zip(path)
    return _Found(zipped.state(), zipped.bounds, zipped.squash)


def _of_run(folder: Path) -> _Found:
    checkpoint, _ = newest(folder)
    state = load_state(checkpoint, "learner")
    ours, theirs = state.get("policy", {}), state.get("modules", {}).get("policy", {})
    said = yaml.safe_load((checkpoint / "config.yaml").read_text(encoding="utf-8"))
    network = said["learner"].get("policy") or {}  # null for the perceptron of a clone
    if ours and (network.get("kind", "mlp"), network.get("activation", "tanh")) != ("mlp", "tanh"):
        named = " with ".join(network[name] for name in ("kind", "activation") if network.get(name))
        raise ConfigError(
            f"{folder} has a policy of kind {named}; expected kind mlp with tanh: a flow, a gru or a transformer is "
            "taken over where learner.policy is set as that run has it"
        )
    if "mean" not in ours and "mlp_extractor.policy_net.0.weight" not in theirs:
        raise ConfigError(f"{folder} holds no policy of control that can be taken over; expected {OURS}")
    task = control(task_of(said), f"{folder}: expected a run of a control task")
    squash = squashes(said["learner"])
    space = ActionSpace.within(task.action_size, task.action_bounds, squash)
    return _Found(ours if "mean" in ours else state_of(theirs, space), task.action_bounds, squash)


def _check_spaces(found: _Found, path: Path, task: ControlTask) -> None:
    sizes = _sizes(found.state["parameters"], "actor")
    seen, acts = sizes[0], sizes[-1]
    if (seen, acts) != (task.observation_size, task.action_size) or not same_bounds(found.bounds, task.action_bounds):
        here = _told(task.observation_size, task.action_size, task.action_bounds)
        came = _told(seen, acts, found.bounds)
        raise ConfigError(
            f"learner.start: expected a policy for {task.name}, with {here}; {path} has one with {came}: take another "
            "one, or choose the task that it was made for"
        )


def _check_widths(found: _Found, path: Path, hidden: tuple[int, ...]) -> None:
    there = [_sizes(found.state["parameters"], net) for net in ("actor", "critic")]
    widths = [tuple(sizes[1:-1]) for sizes in there]
    if widths[0] != widths[1]:
        raise ConfigError(
            f"learner.start: expected an actor and a critic of the same widths, and those of {path} are "
            f"{list(widths[0])} and {list(widths[1])}: train one with net_arch of equal pi and vf"
        )
    if widths[0] != tuple(hidden):
        raise ConfigError(
            f"learner.start: expected hidden layers of {list(hidden)}, and those of {path} are {list(widths[0])}: set "
            f"learner.policy.hidden={list(widths[0])}"
        )


def _check_noise(found: _Found, path: Path, settings: MLPPolicySettings) -> None:
    log_std = found.state["parameters"].get("log_std")
    there = {"squash": found.squash, "sde": log_std is not None and log_std.dim() == 2}
    for name, value in there.items():
        if value != getattr(settings, name):
            raise ConfigError(
                f"learner.start: the policy of {path} has learner.policy.{name}={str(value).lower()}: set it so"
            )


def _sizes(parameters: Mapping[str, Tensor], net: str) -> list[int]:
    """Of a network's layers, from the observation to what it gives."""
    weights = [p for name, p in parameters.items() if name.startswith(net) and p.dim() == 2]
    return [int(weights[0].shape[1]), *(int(p.shape[0]) for p in weights)]


def _told(seen: int, acts: int, bounds: Bounds | None) -> str:
    return f"observations of {seen} numbers and {acts} {bounds_told(bounds)}"


__all__ = ["Owned", "starting_state"]
