"""Our own policy as a zip of stable-baselines3's PPO: the same actions from raw observations."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.spaces import Box, Space
from stable_baselines3 import PPO
from torch import Tensor

from prefrl.components import ConfigError
from prefrl.improve.vec_env import TaskEnv
from prefrl.policies.loaded import check_leaves
from prefrl.policies.mlp import MLPPolicy
from prefrl.protocols import ControlTask
from prefrl.seeding import to_numpy
from prefrl.types import Floats

ACTIVATIONS = {"tanh": torch.nn.Tanh, "relu": torch.nn.ReLU, "silu": torch.nn.SiLU}


def save_ppo(policy: MLPPolicy, task: ControlTask, path: Path) -> None:
    """Write what `PPO.load` reads.

    The observation's normaliser is folded into the first layers and the bounds' box into the actor's last, since PPO
    has neither. Two things are lost: our clip of observations at 10 standard deviations, and Adam's moments.
    Raises `ConfigError` for an environment that gives or takes other things than PPO would (`check_leaves`).
    """
    check_leaves(task)
    widths = {"pi": list(policy.widths["actor"]), "vf": list(policy.widths["critic"])}
    settings: dict[str, Any] = {"net_arch": widths, "activation_fn": ACTIVATIONS[policy.settings.activation]}
    if policy.space.squash:
        _check_squash(policy)
        settings["squash_output"] = True
    noise = {"use_sde": policy.settings.sde, "sde_sample_freq": policy.settings.sde_steps or -1}
    model = PPO("MlpPolicy", TaskEnv(task, 1), policy_kwargs=settings, **noise)
    model.observation_space = model.policy.observation_space = _observations(task, model.observation_space)
    model.policy.load_state_dict(_folded(policy))
    model.save(path)


def _observations(task: ControlTask, plain: Space[Any]) -> Space[Any]:
    """The environment's own space where the task shows all of it as it is: PPO compares it with that of an `env`."""
    if task.name in gymnasium.registry:
        env = gymnasium.make(task.name)
        own = env.observation_space
        env.close()
        if isinstance(own, Box) and own.shape == plain.shape:
            return own
    return plain


def _check_squash(policy: MLPPolicy) -> None:
    """Raises `ConfigError` for what PPO cannot do: squash without gSDE, and where there are no bounds."""
    clip = policy.space.clip
    if not policy.settings.sde or clip is None or not np.isfinite(clip).all():
        raise ConfigError(
            "stable-baselines3's PPO squashes actions only together with sde, and only where all have bounds: train "
            "with learner.policy.sde=true as well, or act with this policy through prefrl.load_policy"
        )


def _folded(policy: MLPPolicy) -> dict[str, Tensor]:
    """PPO's state, worked out in float64."""
    named: dict[str, Floats] = {k: to_numpy(p).astype(np.float64) for k, p in policy.named().items()}
    mean, scale = policy.normaliser.mean, policy.normaliser.scale
    found: dict[str, Floats] = {}
    for net, body, head in (("actor", "policy_net", "action_net"), ("critic", "value_net", "value_net")):
        hidden = len(policy.widths[net])
        layers = [(named[f"{net}_{2 * i}"], named[f"{net}_{2 * i + 1}"]) for i in range(hidden + 1)]
        weight, bias = layers[0]
        layers[0] = weight * scale, bias - weight @ (mean * scale)
        if net == "actor" and not policy.space.discrete:
            found["log_std"] = named["log_std"]
        # What is squashed PPO brings from [-1, 1] into the bounds by itself.
        boxed = net == "actor" and not policy.space.squash
        if boxed and policy.space.middle is not None and policy.space.half is not None:
            weight, bias = layers[-1]
            half = policy.space.half.astype(np.float64)
            layers[-1] = weight * half[:, None], bias * half + policy.space.middle
            found["log_std"] = named["log_std"] + np.log(half)
        for i, (weight, bias) in enumerate(layers):
            name = head if i == hidden else f"mlp_extractor.{body}.{2 * i}"
            found[f"{name}.weight"], found[f"{name}.bias"] = weight, bias
    return {name: torch.from_numpy(np.ascontiguousarray(x)).float() for name, x in found.items()}


__all__ = ["save_ppo"]
