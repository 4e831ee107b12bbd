"""Which networks an algorithm of stable-baselines3 starts from."""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from control_stubs import Known, point
from stable_baselines3 import PPO, SAC

from prefrl.components import ConfigError
from prefrl.config import Config
from prefrl.envs.control import GymnasiumTask
from prefrl.improve.sb3 import SB3, SB3Settings
from prefrl.improve.vec_env import TaskEnv
from prefrl.rundir import Run
from prefrl.stages import shrink
from prefrl.storage.checkpoints import load_state, newest
from prefrl.store import Store
from prefrl.types import Segment

NET = {"net_arch": [8]}
OPTIONS = {"train_freq": 5, "gradient_steps": 2, "learning_starts": 20, "batch_size": 16, "buffer_size": 150}


def build(task: GymnasiumTask, **settings: Any) -> SB3:
    small = {"algorithm": "SAC", "environments": 2, "steps_per_round": 80, "policy": NET, "options": OPTIONS}
    return SB3Settings.model_validate(small | settings).build(task, np.random.default_rng(7))


@pytest.fixture
def zipped(tmp_path: Path) -> Path:
    """Of a user's own script, with a temperature that was learned."""
    model = SAC("MlpPolicy", TaskEnv(point(), 1), policy_kwargs=dict(NET), seed=3)
    with torch.no_grad():
        model.log_ent_coef.fill_(-1.5)
        for parameter in model.critic_target.parameters():
            parameter.add_(1.0)
    model.save(tmp_path / "policy.zip")
    return tmp_path / "policy.zip"


def test_networks_targets_and_the_temperature_are_those_of_the_zip(zipped: Path) -> None:
    theirs, ours = SAC.load(zipped), build(point(), start=zipped)
    expected, found = theirs.policy.state_dict(), ours.model.policy.state_dict()
    assert all(torch.equal(found[name], value) for name, value in expected.items())
    assert ours.model.log_ent_coef.item() == -1.5
    seen = np.random.default_rng(0).normal(size=(5, point().observation_size)).astype(np.float32)
    acted, _ = ours.actor()(seen, None, None)
    assert np.allclose(acted, theirs.predict(seen, deterministic=True)[0], atol=1e-6)


def test_learning_goes_on_from_there_and_a_run_that_was_saved_no_longer_needs_it(
    zipped: Path, store: Store[Segment]
) -> None:
    ours = build(point(), start=zipped)
    before = ours.model.log_ent_coef.item()
    ours.improve(Known(), store, np.random.default_rng(0))
    assert ours.model.log_ent_coef.item() != before  # the optimiser has the very parameter that was taken over
    zipped.unlink()
    again = build(point(), start=zipped)
    again.load(ours.state())
    expected = ours.model.policy.state_dict()
    assert all(torch.equal(value, expected[name]) for name, value in again.model.policy.state_dict().items())


def test_first_questions_are_about_the_policy_that_it_starts_from(tmp_path: Path) -> None:
    """TD3 draws nothing; without a start its first questions are about random actions."""
    settings: dict[str, Any] = {"algorithm": "TD3"}
    build(point(), **settings).save(tmp_path / "td3.zip")
    learner = build(point(), **settings, start=tmp_path / "td3.zip")
    for segment in learner.sample(4, np.random.default_rng(0)):
        acted, _ = learner.actor()(segment.observations, None, None)
        assert np.allclose(segment.actions, acted, atol=1e-5)


def test_a_run_with_the_same_algorithm_is_a_start_and_one_of_another_kind_says_how_it_becomes_one(
    finished_tiny: dict[str, Path], tmp_path: Path
) -> None:
    learner = {"kind": "sb3", "steps_per_round": 128, "policy": NET, "options": {"batch_size": 16}}
    config = shrink(Config.load("control/toy", [f"learner={json.dumps(learner)}"]))
    with Run(config, tmp_path / "run") as run:
        list(run)
    assert isinstance(config.learner, SB3Settings)
    task = config.build_task()
    settings = config.learner.model_copy(update={"start": tmp_path / "run"})
    started = settings.build(task, np.random.default_rng(5)).model.policy.state_dict()
    finished = load_state(newest(tmp_path / "run")[0], "learner")["modules"]["policy"]
    assert all(torch.equal(started[name], value) for name, value in finished.items())
    a2c = settings.model_copy(
        update={"start": tmp_path / "run", "algorithm": "A2C", "options": {}, "steps_per_round": 160}
    )
    with pytest.raises(ConfigError, match=r"is a run with learner\.kind=sb3, learner\.algorithm=PPO"):
        _ = a2c.build(task, np.random.default_rng(5)).model
    other = settings.model_copy(update={"start": finished_tiny["control/toy"]})
    with pytest.raises(
        ConfigError, match=r"learner\.kind=control, learner\.algorithm=ppo \(of a run of control `prefrl export"
    ):
        _ = other.build(task, np.random.default_rng(5)).model


def test_what_weights_do_not_show_is_refused(zipped: Path, tmp_path: Path) -> None:
    SAC("MlpPolicy", TaskEnv(point(), 1), policy_kwargs=NET | {"activation_fn": torch.nn.Tanh}).save(tmp_path / "tanh")
    with pytest.raises(ConfigError, match=r"tanh\.zip have Tanh, and those of SAC here have ReLU"):
        _ = build(point(), start=tmp_path / "tanh.zip").model
    ppo: dict[str, Any] = {"algorithm": "PPO", "options": {"n_steps": 20, "use_sde": True, "batch_size": 40}}
    PPO("MlpPolicy", TaskEnv(point(), 1), policy_kwargs=NET | {"squash_output": True}, use_sde=True).save(
        tmp_path / "squashed"
    )
    with pytest.raises(ConfigError, match=r"squash_output=True: set learner\.policy\.squash_output"):
        _ = build(point(), start=tmp_path / "squashed.zip", **ppo).model
    wide = replace(point(), action_bounds=(np.array([-20.0], np.float32), np.array([20.0], np.float32)))
    with pytest.raises(ConfigError, match=r"expected a policy for .*\[20\.0\].*policy\.zip has one with"):
        _ = build(wide, start=zipped).model


def test_a_start_that_cannot_be_read_is_refused_each_time(zipped: Path, tmp_path: Path) -> None:
    for number, data in enumerate(("[1]", "{}")):
        path = tmp_path / f"{number}.zip"
        with zipfile.ZipFile(zipped) as old, zipfile.ZipFile(path, "w") as new:
            for name in old.namelist():
                new.writestr(name, data if name == "data" else old.read(name))
        learner = build(point(), start=path)
        for _ in range(2):
            with pytest.raises(ConfigError, match=rf"learner\.start: .*{number}\.zip"):
                _ = learner.model


def test_what_is_no_start_is_refused_and_says_what_to_do(zipped: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"there is no .*nothing\.zip, seen from .*zip of .*SAC"):
        _ = build(point(), start=tmp_path / "nothing.zip").model
    with pytest.raises(ConfigError, match=r"has no 'log_ent_coef'|has no|are others than those"):
        _ = build(point(), start=zipped, algorithm="TQC").model
    with pytest.raises(ConfigError, match=r"networks of .* are others than those of SAC .*same task and widths"):
        _ = build(point(), start=zipped, policy={"net_arch": [9]}).model
    (tmp_path / "text.zip").write_text("no zip")
    with pytest.raises(ConfigError, match=r"text\.zip: expected a zip of stable-baselines3's SAC.*this is none"):
        _ = build(point(), start=tmp_path / "text.zip").model
    np.savez(zipped.with_suffix(".npz"), mean=np.zeros(2), var=np.ones(2), count=1.0)
    with pytest.raises(ConfigError, match=r"policy\.npz"):
        _ = build(point(), start=zipped).model
