"""Zips of every algorithm act here as they do in stable-baselines3, and nothing in them is run."""

from __future__ import annotations

import inspect
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import gymnasium
import numpy as np
import pytest
import sb3_contrib
import stable_baselines3
import torch
from gymnasium.spaces import Box, Dict, Discrete
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from prefrl import load_policy
from prefrl.components import ConfigError
from prefrl.policies.networks import read_policy
from prefrl.protocols import ControlTask
from prefrl.types import Json

PENDULUM, CARTPOLE = "Pendulum-v1", "CartPole-v1"
LSTM = {"lstm_hidden_size": 8, "net_arch": [8]}
SMALL: dict[str, Any] = {"net_arch": [8]}


class Pictures(gymnasium.Env[Any, Any]):
    def __init__(self, space: gymnasium.Space[Any]) -> None:
        self.observation_space, self.action_space = space, Discrete(3)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return self.observation_space.sample(), {}


def saved(path: Path, name: str, env: Any = PENDULUM, kind: str = "MlpPolicy", **policy: Any) -> Any:
    """A model whose policy acts unlike in unlike states, in a zip."""
    made = getattr(stable_baselines3, name, None) or getattr(sb3_contrib, name)
    options: dict[str, Any] = {"buffer_size": 10} if "buffer_size" in inspect.signature(made).parameters else {}
    options |= {"use_sde": True} if policy.pop("sde", False) else {}
    model = made(kind, env, seed=1, device="cpu", policy_kwargs=policy or None, **options)
    order = torch.Generator().manual_seed(3)
    with torch.no_grad():
        for layer, parameter in model.policy.named_parameters():
            width = 0.02 if ".cnn." in layer else 0.5
            parameter += width * torch.randn(parameter.shape, generator=order)
    model.save(path)
    return model


def told_otherwise(path: Path, change: Callable[[Json], object], pickles: bool = True) -> None:
    """Rewrite what a zip says of itself; without `pickles`, with nothing in their place that could be read."""
    with zipfile.ZipFile(path) as old:
        files = {name: old.read(name) for name in old.namelist()}
    said = json.loads(files["data"])
    change(said)
    files["data"] = json.dumps(said).replace("gAWV", "gAWV" if pickles else "!!!!").encode()
    with zipfile.ZipFile(path, "w") as new:
        for name, content in files.items():
            new.writestr(name, content)


def seen(count: int = 40) -> np.ndarray:
    return np.random.default_rng(0).normal(0.0, 1.0, (count, 4)).astype(np.float32)


@pytest.mark.parametrize(
    ("name", "env", "kind", "policy"),
    [
        ("SAC", PENDULUM, "MlpPolicy", SMALL),
        ("SAC", PENDULUM, "MlpPolicy", {"sde": True, "net_arch": {"pi": [8], "qf": [4]}, "n_critics": 3}),
        ("TD3", PENDULUM, "MlpPolicy", {"net_arch": [8], "activation_fn": torch.nn.Tanh}),
        ("DDPG", PENDULUM, "MlpPolicy", SMALL),
        ("TQC", PENDULUM, "MlpPolicy", SMALL),
        ("CrossQ", PENDULUM, "MlpPolicy", SMALL),
        ("DQN", CARTPOLE, "MlpPolicy", SMALL),
        ("QRDQN", CARTPOLE, "MlpPolicy", SMALL),
        ("PPO", PENDULUM, "MlpPolicy", {"activation_fn": torch.nn.ReLU, "net_arch": {"pi": [8, 4], "vf": [3]}}),
        ("A2C", CARTPOLE, "MlpPolicy", {"net_arch": []}),
        ("RecurrentPPO", CARTPOLE, "MlpLstmPolicy", LSTM),
        ("RecurrentPPO", PENDULUM, "MlpLstmPolicy", LSTM | {"n_lstm_layers": 2}),
    ],
)
def test_a_zip_acts_as_its_model_does(name: str, env: str, kind: str, policy: Json, tmp_path: Path) -> None:
    model = saved(tmp_path / "policy.zip", name, env, kind, **policy)
    told_otherwise(tmp_path / "policy.zip", lambda said: None, pickles=False)
    loaded, rows = load_policy(tmp_path / "policy.zip"), seen()[:, : 3 if env == PENDULUM else 4]
    state: Any = None
    memory = None
    for _ in range(3):
        expected, state = model.predict(rows, state, deterministic=True)
        found, memory = loaded.predict(rows, memory)
        np.testing.assert_array_equal(found, expected)
    assert len(np.unique(found)) > 1
    assert (memory is not None) == (name == "RecurrentPPO")


@pytest.mark.parametrize("sde", [False, True])
def test_what_is_drawn_comes_from_the_generator_alone(sde: bool, tmp_path: Path) -> None:
    saved(tmp_path / "policy.zip", "SAC", **SMALL, sde=sde)
    loaded, rows, before = load_policy(tmp_path / "policy.zip"), seen()[:, :3], torch.random.get_rng_state()
    drawn = [loaded.predict(rows, deterministic=False, rng=np.random.default_rng(seed))[0] for seed in (0, 0, 1)]
    np.testing.assert_array_equal(drawn[0], drawn[1])
    assert not np.allclose(drawn[0], drawn[2])
    assert not np.allclose(drawn[0], loaded.predict(rows)[0])
    assert torch.equal(torch.random.get_rng_state(), before)


def test_choices_are_seen_one_hot(tmp_path: Path) -> None:
    model = saved(tmp_path / "policy.zip", "DQN", "FrozenLake-v1", **SMALL)
    found, _ = load_policy(tmp_path / "policy.zip").predict(np.eye(16))
    np.testing.assert_array_equal(found, model.predict(np.arange(16))[0])


@pytest.mark.parametrize("kind", ["CnnPolicy", "MlpPolicy"])
def test_pictures_are_seen_as_the_environment_shows_them(kind: str, tmp_path: Path) -> None:
    space = Box(0, 255, (36, 40, 3), np.uint8)
    policy: Json = {"features_extractor_kwargs": {"features_dim": 16}} if kind == "CnnPolicy" else SMALL
    model = saved(tmp_path / "policy.zip", "PPO", Pictures(space), kind, **policy)
    pictures = np.random.default_rng(1).integers(0, 256, (30, 36, 40, 3)).astype(np.uint8)
    pictures[::3] //= 8
    expected, _ = model.predict(pictures, deterministic=True)
    loaded = load_policy(tmp_path / "policy.zip")
    np.testing.assert_array_equal(loaded.predict(pictures)[0], expected)
    np.testing.assert_array_equal(loaded.predict(pictures.reshape(30, -1))[0], expected)  # as a task's row has them
    assert loaded.predict(pictures[0])[0] == expected[0]
    spaces: Json = {"name": "pictures", "observation_size": 4320, "action_size": 3, "action_bounds": None}
    shows = [
        cast(ControlTask, _Shows(**spaces, outside=SimpleNamespace(shape=shape)))
        for shape in ((36, 40, 3), (3, 36, 40))
    ]
    loaded.check(shows[0], "policy.zip")
    with pytest.raises(ConfigError, match=r"observations have the shape \(3, 36, 40\); this one was made for \(36, 40"):
        loaded.check(shows[1], "policy.zip")


class _Shows(SimpleNamespace):
    variable_horizon = False


def test_statistics_beside_any_zip_count_and_pickled_ones_are_refused(tmp_path: Path) -> None:
    env = VecNormalize(DummyVecEnv([lambda: gymnasium.make(PENDULUM)]))
    env.obs_rms.update(np.random.default_rng(0).normal(0.3, 2.0, (400, 3)))
    model = saved(tmp_path / "policy.zip", "TD3", env, **SMALL)
    env.save(tmp_path / "vecnormalize.pkl")
    with pytest.raises(ValueError, match="prefrl reads no pickle"):
        load_policy(tmp_path / "policy.zip")
    rms = env.obs_rms
    np.savez(tmp_path / "policy.npz", mean=rms.mean, var=rms.var, count=rms.count)
    rows = 3 * seen()[:, :3]
    expected = model.predict(env.normalize_obs(rows), deterministic=True)[0]
    np.testing.assert_allclose(load_policy(tmp_path / "policy.zip").predict(rows)[0], expected, atol=1e-5)


def test_what_has_code_of_its_own_or_other_weights_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "policy.zip"
    for change, says in (
        (lambda said: said["policy_class"].update(__module__="mine.policies"), "the class of this one is of mine"),
        (lambda said: said.pop("policy_class"), "the class of this one is of None"),
        (lambda said: said["policy_kwargs"].update(activation_fn="<class 'mine.ReLU'>"), "activation_fn=<class 'mine"),
        (lambda said: said["policy_kwargs"].update(features_extractor_class="<class 'mine.CNN'>"), "'mine.CNN'"),
        (lambda said: said["policy_kwargs"].update(net_arch=[9]), "its weights are not those of a SACPolicy"),
        (lambda said: said["policy_kwargs"].update(wide=True), "not those of a SACPolicy.* unexpected keyword"),
        (lambda said: said["observation_space"].update({":type:": "Dict"}), "expected observations of a Box"),
        (lambda said: said["action_space"].update({":type:": "MultiBinary"}), "expected actions of a Box or Discrete"),
    ):
        saved(path, "SAC", **SMALL)
        told_otherwise(path, change)
        with pytest.raises(ValueError, match=says):
            read_policy(path)
    parts = Pictures(Dict({"a": Box(-1, 1, (2,)), "b": Box(-1, 1, (2,))}))
    saved(path, "DQN", parts, "MultiInputPolicy", **SMALL)
    with pytest.raises(ValueError, match=r"expected observations of a Box, or a Discrete from 0, got .*dict\.Dict"):
        read_policy(path)
