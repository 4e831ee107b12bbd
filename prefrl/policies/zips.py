"""Policies of stable-baselines3, read from their zips without running anything that is in them.

A zip's file `data` holds pickles, which are never read: whoever loads one runs the code in it. Weights are read by
torch's own reader of weights alone. `data` is JSON, which says in words beside each pickle what it is (the type of a
space, its bounds); that is read as text, and what cannot be made out is refused.
"""

from __future__ import annotations

import json
import re
import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from prefrl.policies.heads import ActionSpace, Noise
from prefrl.policies.loaded import Bounds, Loaded
from prefrl.policies.mlp import NumpyActor
from prefrl.policies.normaliser import CLIP, Scaling
from prefrl.seeding import to_host, to_numpy
from prefrl.types import Floats, Json, State

WANTED = "expected a zip of stable-baselines3's PPO, A2C or TRPO with an MlpPolicy"
VERSION = "_stable_baselines3_version"
OTHERS = "load it with stable-baselines3 in a script of your own"
PICKLED = re.compile("vec_?norm", re.IGNORECASE)
"""Names of files with the statistics of `VecNormalize`."""


@dataclass(frozen=True, eq=False)
class Zipped:
    """An actor and a critic of stable-baselines3, and by which statistics they see observations."""

    weights: Mapping[str, Tensor]
    """As stable-baselines3 names them."""
    bounds: Bounds | None
    """(low (A,), high (A,)), or None where actions are discrete."""
    normaliser: State | None = None
    """`mean` (O,), `variance` (O,) and `count`; None where observations are seen as they are."""
    squash: bool = False
    """Whether actions are the tanh of what is drawn."""
    noise_steps: int = 1
    """After how many steps noise that is a function of the state is drawn anew."""

    @property
    def space(self) -> ActionSpace:
        return ActionSpace.within(len(self.weights["action_net.bias"]), self.bounds, self.squash)

    @property
    def observation_size(self) -> int:
        return int(self.weights["mlp_extractor.policy_net.0.weight"].shape[1])

    def state(self) -> State:
        """What `MLPPolicy.load` reads."""
        return state_of(self.weights, self.space) | (self.normaliser or {})

    def actor(self) -> NumpyActor:
        state = self.state()
        named = {name: to_numpy(p) for name, p in state["parameters"].items()}
        count = sum(name.startswith("actor") for name in named) // 2
        layers = [
            (np.ascontiguousarray(named[f"actor_{2 * i}"].T), named[f"actor_{2 * i + 1}"][None]) for i in range(count)
        ]
        noise = None if self.bounds is None else Noise(named["log_std"], self.noise_steps)
        mean, scale = (x.astype(np.float32) for x in (state["mean"], 1.0 / np.sqrt(state["variance"] + 1e-8)))
        scaling = Scaling(mean, scale, np.inf if self.normaliser is None else CLIP)
        return NumpyActor(self.space, layers, "tanh", noise, scaling)

    def loaded(self) -> Loaded:
        """To act with."""
        actor = self.actor()
        return Loaded(
            lambda observations, rng, memory: (actor(observations, rng)[1], memory),
            self.observation_size,
            self.space.size,
            self.bounds,
        )


def state_of(weights: Mapping[str, Tensor], space: ActionSpace) -> State:
    """Weights of stable-baselines3 as `MLPPolicy.load` reads them, of a policy that sees observations as they are.

    The box of the bounds, which is part of our policy, is taken out of the actor's last layer: `to_sb3` puts it in.
    """
    found: dict[str, Floats] = {}
    for net, body, head in (("actor", "policy_net", "action_net"), ("critic", "value_net", "value_net")):
        names = [*_hidden_layers(weights, body), head]
        layers = [
            [to_numpy(weights[f"{name}.{part}"]).astype(np.float64) for part in ("weight", "bias")] for name in names
        ]
        if net == "actor" and space.middle is not None and space.half is not None:
            found["log_std"] = to_numpy(weights["log_std"])
            if not space.squash:  # what is squashed lies in [-1, 1] there too
                weight, bias = layers[-1]
                layers[-1] = [weight / space.half[:, None], (bias - space.middle) / space.half]
                found["log_std"] = found["log_std"] - np.log(space.half)
        found |= {f"{net}_{i}": x for i, x in enumerate(x for layer in layers for x in layer)}
    parameters = {name: torch.from_numpy(np.ascontiguousarray(x, np.float32)) for name, x in found.items()}
    size = parameters["actor_0"].shape[1]
    return {"parameters": parameters, "mean": np.zeros(size), "variance": np.ones(size), "count": 0.0, "raw": True}


def _hidden_layers(weights: Mapping[str, Tensor], body: str) -> list[str]:
    named = sorted(int(k.split(".")[2]) for k in weights if re.fullmatch(rf"mlp_extractor\.{body}\.\d+\.weight", k))
    return [f"mlp_extractor.{body}.{i}" for i in named]


def read_zip(path: Path) -> Zipped:
    """A policy in a zip. Statistics of observations are taken from `<name>.npz` beside it, if there is one.

    That file holds `mean`, `var` and `count`, those of `VecNormalize`'s `obs_rms`. Raises `ValueError` for other
    policies than perceptrons with tanh, and for what cannot be read.
    """
    said, version = read_words(path, WANTED)
    weights = _weights(path, version)
    if odd := oddity(said, weights):
        raise ValueError(f"{path}: {odd}; {OTHERS}")
    found = Zipped(weights, bounds_of(path, said.get("action_space")))
    sizes = found.space.size, found.observation_size
    if found.bounds is not None and found.bounds[0].shape != (sizes[0],):
        raise ValueError(f"{path}: {WANTED}; its bounds do not fit its {sizes[0]} actions")
    # Steps that are -1 there are a rollout, and here there is none.
    steps = said.get("sde_sample_freq")
    steps = steps if isinstance(steps, int) and steps > 0 else 1
    return Zipped(found.weights, found.bounds, statistics_beside(path, sizes[1]), squashes(said), steps)


def squashes(said: Json) -> bool:
    """Whether actions are the tanh of what is drawn, by a zip's words, or by a run's `learner`."""
    kwargs = said.get("policy_kwargs", said.get("policy"))
    return isinstance(kwargs, dict) and bool(kwargs.get("squash_output", kwargs.get("squash")))


def read_words(path: Path, wanted: str) -> tuple[Json, str]:
    """What a zip says of itself, and the version that it was saved by. Raises `ValueError` for what is no such zip."""
    try:
        with zipfile.ZipFile(path) as archive:
            said, version = json.loads(archive.read("data")), archive.read(VERSION).decode()
    except (zipfile.BadZipFile, KeyError, ValueError) as error:
        raise ValueError(f"{path}: {wanted}, and this is none ({error})") from error
    if not isinstance(said, dict):
        raise ValueError(f"{path}: {wanted}, and this is none (its `data` is no object)")
    return said, version


def _weights(path: Path, version: str) -> dict[str, Tensor]:
    modules, _ = read_modules(path, version)
    return {name: to_host(p) for name, p in modules.get("policy", {}).items() if isinstance(p, Tensor)}


def read_modules(path: Path, version: str) -> tuple[State, State]:
    """What a zip of any algorithm holds of networks and optimisers, and of single variables, by their names there.

    Raises `ValueError` for what cannot be read.
    """
    import stable_baselines3
    from stable_baselines3.common.save_util import load_from_zip_file

    try:
        _, modules, variables = load_from_zip_file(path, load_data=False)  # so nothing is unpickled but weights
    except Exception as error:  # torch raises many kinds of its own
        here = stable_baselines3.__version__
        raise ValueError(
            f"{path}: its weights cannot be read (saved by stable-baselines3 {version}, and here is {here}): {error}"
        ) from error
    if not all(isinstance(one, Mapping) for one in modules.values()):
        raise ValueError(f"{path}: its weights cannot be read: expected a mapping of tensors in each of its files")
    return modules, variables or {}


def activation_of(said: Json, default: str) -> str:
    """The name of the activation that a zip's words have, as torch has it; `default` where they have none."""
    found: list[str] = re.findall(r"\w+", _words(said.get("policy_kwargs")).get("activation_fn", ""))
    return found[-1] if found else default


def oddity(said: Json, weights: Mapping[str, Tensor]) -> str:
    """In words, why a policy is no plain perceptron with tanh over a row of numbers; empty where it is one."""
    known = re.compile(r"(mlp_extractor\.(policy|value)_net\.\d+|action_net|value_net)\.(weight|bias)|log_std")
    strange = sorted(name for name in weights if not known.fullmatch(name))
    if strange or not _hidden_layers(weights, "policy_net") or not _hidden_layers(weights, "value_net"):
        came = f"a layer {strange[0]!r}" if strange else "no hidden layers"
        return f"{WANTED}, and this policy has {came}"
    activation = activation_of(said, "Tanh")
    if activation != "Tanh":
        return f"expected a policy with tanh, and this one has {activation}"
    kwargs = said.get("policy_kwargs")
    if isinstance(kwargs, dict) and (kwargs.get("use_expln") or kwargs.get("full_std") is False):
        return f"{WANTED}, and this policy has use_expln, or not full_std"
    space = _words(said.get("observation_space"))
    if "Box" not in space.get(":type:", "") or len(shape_of(said.get("observation_space"))) != 1:
        return f"expected observations in one row of numbers (a Box), got {_told(said.get('observation_space'))}"
    return ""


def bounds_of(path: Path, space: Any) -> Bounds | None:
    """Of actions, as a zip says them in words; None of discrete ones. Raises `ValueError` for other spaces."""
    words = _words(space)
    if "discrete.Discrete" in words.get(":type:", "") and words.get("start") == "0":
        return None
    try:
        if "Box" not in words[":type:"]:
            raise ValueError("no Box")
        low, high = (np.array(re.sub(r"[\[\]]", " ", words[k]).split(), np.float32) for k in ("low", "high"))
    except (KeyError, ValueError) as error:
        raise ValueError(f"{path}: expected actions of a Box or Discrete, got {_told(space)}; {OTHERS}") from error
    return low, high


def shape_of(space: Any) -> tuple[int, ...]:
    """Of a space, by a zip's words, which are a list or, of earlier versions, the text of a tuple."""
    return tuple(map(int, re.findall(r"\d+", str(space.get("_shape"))))) if isinstance(space, dict) else ()


def _words(told: Any) -> dict[str, str]:
    """What `data` says of an object in words."""
    return {k: v for k, v in told.items() if isinstance(v, str)} if isinstance(told, dict) else {}


def _told(space: Any) -> str:
    return f"{_words(space).get(':type:', 'nothing')} of shape {shape_of(space)}"


def statistics_beside(path: Path, size: int) -> State | None:
    """Statistics that lie beside a zip. Raises `ValueError` for those of another size, and for pickled ones."""
    beside = path.with_suffix(".npz")
    if not beside.exists():
        pickled = [p for p in sorted(path.parent.glob("*.pkl")) if PICKLED.search(p.name)]
        if pickled:
            raise ValueError(
                f"{pickled[0]} lies beside {path.name}: without these statistics its policy may see nothing that it "
                "knows, and prefrl reads no pickle. In a script of your own write them as numbers, env being what "
                f'VecNormalize.load gives: numpy.savez("{beside}", mean=env.obs_rms.mean, var=env.obs_rms.var, '
                "count=env.obs_rms.count); or move the file away if it belongs to another policy"
            )
        return None
    with np.load(beside, allow_pickle=False) as given:
        if missing := [name for name in ("mean", "var", "count") if name not in given]:
            raise ValueError(
                f"{beside}: expected mean, var and count of VecNormalize's obs_rms, {missing[0]} is missing"
            )
        mean, variance, count = (np.asarray(given[name], np.float64) for name in ("mean", "var", "count"))
    if mean.shape != (size,) or variance.shape != (size,) or count.shape != ():
        raise ValueError(
            f"{beside}: expected mean and var of {size} numbers, got shapes {mean.shape}, {variance.shape}"
        )
    return {"mean": mean, "variance": variance, "count": float(count), "raw": False}


__all__: Sequence[str] = (
    "Zipped",
    "activation_of",
    "bounds_of",
    "oddity",
    "read_modules",
    "read_words",
    "read_zip",
    "shape_of",
    "squashes",
    "state_of",
    "statistics_beside",
)
