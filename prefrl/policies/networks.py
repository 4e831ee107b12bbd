"""Policies of stable-baselines3 and sb3-contrib, of any algorithm, built anew from the words and the weights of a zip.

A plain perceptron is read as numbers (`zips.py`). Every other policy acts by its package's own class, which is chosen
from the tables below and is given the settings that the zip has in plain JSON: no pickle is read, and no name in the
file leads to code that is not named here. Weights have to fit to the last one.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from importlib import import_module
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch

from prefrl.components import ConfigError, missing
from prefrl.policies.acting import Actor, Memory
from prefrl.policies.loaded import Bounds, Loaded
from prefrl.policies.normaliser import CLIP, Scaling
from prefrl.policies.zips import (
    OTHERS,
    bounds_of,
    oddity,
    read_modules,
    read_words,
    read_zip,
    shape_of,
    statistics_beside,
)
from prefrl.seeding import draw_seed
from prefrl.types import Floats, Json, State

WANTED = "expected a zip of a policy of stable-baselines3 or sb3-contrib"
CLASSES = {
    "stable_baselines3.common.policies": "ActorCriticPolicy",  # PPO, A2C, TRPO
    "stable_baselines3.dqn.policies": "DQNPolicy",
    "stable_baselines3.sac.policies": "SACPolicy",
    "stable_baselines3.td3.policies": "TD3Policy",  # and DDPG
    "sb3_contrib.common.recurrent.policies": "RecurrentActorCriticPolicy",
    "sb3_contrib.crossq.policies": "CrossQPolicy",
    "sb3_contrib.qrdqn.policies": "QRDQNPolicy",
    "sb3_contrib.tqc.policies": "TQCPolicy",
}
"""Where the class of a policy is defined, which a zip says in words -> the class there that the others are kinds of."""
EXTRACTORS = ("FlattenExtractor", "NatureCNN")
"""What may see observations first, of `stable_baselines3.common.torch_layers`."""


def read_policy(path: Path) -> Loaded:
    """The policy of a zip of any algorithm, to act with. Statistics of observations are taken from beside it.

    Raises `ValueError` for a policy of a class of somebody's own, for spaces other than a Box or a Discrete, for an
    extractor of features of somebody's own, and for what cannot be read.
    """
    said, version = read_words(path, WANTED)
    modules, _ = read_modules(path, version)
    if not oddity(said, modules.get("policy", {})):
        return read_zip(path).loaded()
    bounds = bounds_of(path, said.get("action_space"))
    policy = _built(path, said, modules.get("policy", {}), bounds)
    shape = _pictures(policy.observation_space)
    size = gymnasium.spaces.flatdim(policy.observation_space)
    scaling = _scaling(statistics_beside(path, size))
    actions = gymnasium.spaces.flatdim(policy.action_space)
    return Loaded(_actor(policy, bool(said.get("use_sde")), shape, scaling), size, actions, bounds, shape=shape)


def predicted(model: Any, policy: Any, seen: np.ndarray, memory: Memory, mode: bool) -> tuple[np.ndarray, Memory]:
    """What a model, or its policy itself, does where it sees n observations, and what it remembers (n, M) if anything:
    the states of RecurrentPPO's LSTM."""
    state, count = None, len(seen)
    if memory is not None:
        layers = policy.lstm_actor.num_layers
        state = tuple(memory.reshape(count, 2, layers, -1).transpose(1, 2, 0, 3))  # 2 x (layers, n, H)
    chosen, state = model.predict(seen, state, deterministic=mode)
    return chosen, None if state is None else np.stack(state).transpose(2, 0, 1, 3).reshape(count, -1)


def _actor(policy: Any, sde: bool, shape: tuple[int, ...], scaling: Scaling | None) -> Actor:
    """It draws from torch's generator, seeded from the one that is given; noise that is a function of the state is
    drawn anew in every step."""
    seen, does = policy.observation_space, policy.action_space

    def act(observations: Floats, rng: np.random.Generator | None, memory: Memory) -> tuple[Floats, Memory]:
        rows = observations if scaling is None else scaling(observations)
        shown: np.ndarray = rows.reshape(-1, *(shape or seen.shape)).astype(seen.dtype)
        if isinstance(seen, gymnasium.spaces.Discrete):
            shown = rows.argmax(1)
        with nullcontext() if rng is None else torch.random.fork_rng(devices=()):
            if rng is not None:
                torch.manual_seed(draw_seed(rng))
            if rng is not None and sde:
                policy.reset_noise(len(shown))
            chosen, memory = predicted(policy, policy, shown, memory, rng is None)
        if isinstance(does, gymnasium.spaces.Discrete):
            return np.eye(int(does.n), dtype=np.float32)[chosen], memory
        actions: Floats = np.clip(chosen, does.low, does.high).astype(np.float32)
        return actions, memory

    return act


def _built(path: Path, said: Json, weights: Mapping[str, Any], bounds: Bounds | None) -> Any:
    """A policy with its weights, on the CPU."""
    made, kwargs = _class(path, said), _kwargs(path, said, weights)
    spaces = _seen(path, said.get("observation_space")), _does(said, bounds)
    try:
        # The weights that a new one draws are written over: what others draw is not to hang on it.
        with torch.random.fork_rng(devices=()):
            policy = made(*spaces, lr_schedule=lambda _: 0.0, **kwargs)
        policy.load_state_dict(weights)
    except (TypeError, ValueError, AssertionError, RuntimeError) as error:  # of its constructor, and of torch
        raise ValueError(
            f"{path}: its weights are not those of a {made.__name__} with policy_kwargs {kwargs}; {OTHERS}. {error}"
        ) from error
    policy.set_training_mode(False)
    return policy


def _class(path: Path, said: Json) -> Any:
    words = said.get("policy_class")
    module = words.get("__module__") if isinstance(words, dict) else None
    if module not in CLASSES:
        raise ValueError(f"{path}: {WANTED}, and the class of this one is of {module}; {OTHERS}")
    try:
        return getattr(import_module(module), CLASSES[module])
    except ModuleNotFoundError as error:
        raise ConfigError(f"{path}: {missing(error)}") from error


def _kwargs(path: Path, said: Json, weights: Mapping[str, Any]) -> dict[str, Any]:
    """The `policy_kwargs`, which are JSON but for classes. Raises `ValueError` for classes of somebody's own."""
    from stable_baselines3.common import torch_layers

    given = said.get("policy_kwargs")
    found: dict[str, Any] = dict(given) if isinstance(given, dict) else {}
    # How it was learned is of no use here.
    found = {name: x for name, x in found.items() if not name.startswith((":", "optimizer"))}
    if said.get("use_sde"):
        found["use_sde"] = True
    if any(".cnn." in name for name in weights):  # as the classes for pictures have it, without a word
        found.setdefault("features_extractor_class", f"<class '{torch_layers.__name__}.NatureCNN'>")
    known = {f"<class 'torch.nn.modules.activation.{name}'>": torch.nn for name in torch.nn.modules.activation.__all__}
    known |= {f"<class '{torch_layers.__name__}.{name}'>": torch_layers for name in EXTRACTORS}
    for name, value in found.items():
        if not isinstance(value, str):
            continue
        if value not in known:
            raise ValueError(f"{path}: {WANTED}, and this one has policy_kwargs {name}={value}; {OTHERS}")
        found[name] = getattr(known[value], value[:-2].rsplit(".", 1)[1])
    return found


def _seen(path: Path, words: Any) -> gymnasium.Space[Any]:
    """Observations. Of a Box the shape is what counts, and whether they are pictures."""
    words = words if isinstance(words, dict) else {}
    kind, shape = str(words.get(":type:")), shape_of(words)
    if "discrete.Discrete" in kind and str(words.get("start")) == "0":
        return gymnasium.spaces.Discrete(int(words["n"]))
    if "box.Box" not in kind or not shape:
        raise ValueError(f"{path}: expected observations of a Box, or a Discrete from 0, got {kind}; {OTHERS}")
    ends = [set(re.findall(r"[^\s\[\].,]+", str(words.get(side)))) for side in ("low", "high")]
    if len(shape) == 3 and words.get("dtype") == "uint8" and ends == [{"0"}, {"255"}]:
        return gymnasium.spaces.Box(0, 255, shape, np.uint8)
    return gymnasium.spaces.Box(-np.inf, np.inf, shape, np.float32)


def _does(said: Json, bounds: Bounds | None) -> gymnasium.Space[Any]:
    if bounds is None:
        return gymnasium.spaces.Discrete(int(said["action_space"]["n"]))
    return gymnasium.spaces.Box(*bounds)


def _pictures(seen: gymnasium.Space[Any]) -> tuple[int, ...]:
    """The shape of pictures as an environment shows them, with the channels last: stable-baselines3 turns them round,
    and keeps the space of what it made of them."""
    if not isinstance(seen, gymnasium.spaces.Box) or len(seen.shape) != 3 or seen.dtype != np.uint8:
        return ()
    channels, *rest = seen.shape
    return (*rest, channels)


def _scaling(statistics: State | None) -> Scaling | None:
    if statistics is None:
        return None
    mean, scale = statistics["mean"], 1.0 / np.sqrt(statistics["variance"] + 1e-8)
    return Scaling(mean.astype(np.float32), scale.astype(np.float32), CLIP)


__all__: Sequence[str] = ("predicted", "read_policy")
