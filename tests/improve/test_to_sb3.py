"""Policies leave prefrl: a zip that stable-baselines3 loads acts alike, and `load_policy` acts in a script."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.evaluation import evaluate_policy

from prefrl import Config, Run, load_policy
from prefrl.envs.control import ControlSettings
from prefrl.improve.control import ControlLearnerSettings
from prefrl.policies.mlp import MLPPolicy, MLPPolicySettings
from prefrl.rundir import RunError
from prefrl.stages import export_sb3, shrink

PLAIN = MLPPolicySettings(hidden=(16, 8))
OTHER = MLPPolicySettings(hidden=(16, 8), critic_hidden=(12,), activation="relu")
POLICIES = {"Pendulum-v1": PLAIN, "CartPole-v1": PLAIN, "Hopper-v5": OTHER}


def run(folder: Path, name: str, *settings: str) -> Path:
    with Run(shrink(Config.load(name, settings)), folder) as made:
        list(made)
    return folder


@pytest.mark.parametrize("env", ["Pendulum-v1", "CartPole-v1", "Hopper-v5"])
def test_the_zip_acts_as_the_policy_does(env: str, tmp_path: Path) -> None:
    task, rng = ControlSettings(env=env, horizon=200).build(), np.random.default_rng(0)
    learner = ControlLearnerSettings(policy=POLICIES[env], device="cpu").build(task, rng)
    assert isinstance(learner.policy, MLPPolicy)
    learner.policy.observe(rng.normal(0.3, 2.0, (500, task.observation_size)))
    for _, parameter in learner.policy.named().items():
        parameter.data += 0.2 * torch.from_numpy(rng.standard_normal(parameter.shape)).float()
    learner.save(tmp_path / "policy.zip")
    loaded = PPO.load(tmp_path / "policy.zip", env=gymnasium.make(env), device="cpu")
    observations = rng.normal(0.3, 2.0, (300, task.observation_size)).astype(np.float32)
    ours, theirs = learner.actor()(observations, None, None)[0], loaded.predict(observations, deterministic=True)[0]
    if env == "CartPole-v1":
        np.testing.assert_array_equal(ours.argmax(1), theirs)
    else:
        np.testing.assert_allclose(ours, theirs, atol=5e-6)
    values = learner.policy.values_of(torch.from_numpy(learner.policy.normalise(observations)))
    with torch.no_grad():
        found = loaded.policy.predict_values(torch.from_numpy(observations))
    np.testing.assert_allclose(values.detach(), found[:, 0], atol=1e-5)
    loaded.learn(2048)  # and goes on learning


def test_a_policy_is_loaded_from_a_run_and_evaluated_by_stable_baselines3(tmp_path: Path) -> None:
    folder = run(tmp_path / "run", "control/cartpole", "learner.rollback=0.1")
    policy = load_policy(folder)
    action, nothing = policy.predict(np.zeros(4))
    assert action in (0, 1)
    assert nothing is None
    many, _ = policy.predict(np.zeros((3, 4)))
    assert many.tolist() == [action] * 3
    returns = evaluate_policy(policy, gymnasium.make("CartPole-v1"), 2, warn=False)
    assert float(np.mean(returns[0])) > 5
    drawn = [policy.predict(np.zeros(4), deterministic=False, rng=np.random.default_rng(i))[0] for i in range(20)]
    assert len(set(map(int, drawn))) == 2
    with pytest.raises(ValueError, match=r"observations must be \(4,\) or \(n, 4\), got \(3,\)"):
        policy.predict(np.zeros(3))
    assert export_sb3(folder, tmp_path / "policy.zip", best=True) <= 1
    assert PPO.load(tmp_path / "policy.zip").predict(np.zeros(4), deterministic=True)[0] in (0, 1)


def test_a_run_with_stable_baselines3_leaves_its_own_zip(tmp_path: Path) -> None:
    settings = ("learner.kind=sb3", "learner.algorithm=SAC", "learner.steps_per_round=512")
    folder = run(tmp_path / "run", "control/toy", *settings)
    export_sb3(folder, tmp_path / "policy.zip")
    observation = np.array([[0.3, -0.2], [0.9, 0.1]], np.float32)
    theirs: Any = SAC.load(tmp_path / "policy.zip").predict(observation, deterministic=True)[0]
    np.testing.assert_allclose(load_policy(folder).predict(observation)[0], theirs, atol=1e-6)


def test_a_policy_of_text_does_not_act(tmp_path: Path) -> None:
    folder = run(tmp_path / "run", "text/toy")
    with pytest.raises(RunError, match="expected a run of a control task"):
        load_policy(folder)
    with pytest.raises(RunError, match="expected a run of a control task"):
        export_sb3(folder, tmp_path / "policy.zip")
