"""Policies come in from runs and zips, and go out: nothing of what they do is lost, and nothing in a zip is run."""

from __future__ import annotations

import shutil
import zipfile
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
import pytest
import torch
from shell import Shell
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from prefrl import load_policy
from prefrl.components import ConfigError
from prefrl.config import Config
from prefrl.envs.control import ControlSettings
from prefrl.improve.control import ControlLearner, ControlLearnerSettings
from prefrl.policies.mlp import MLPPolicy, MLPPolicySettings
from prefrl.policies.zips import read_zip
from prefrl.rundir import Run, RunError, open_saved
from prefrl.stages import shrink
from prefrl.stages.policies import export_sb3
from prefrl.store import Store
from prefrl.types import Segment

TASK = ControlSettings(env="Pendulum-v1", horizon=60)
SEEN = np.array([[0.6, -0.8, 3.0], [-1.0, 0.1, -7.5], [0.0, 1.0, 0.2]], np.float32)


def saved(path: Path, env: Any = "Pendulum-v1", **policy: Any) -> PPO:
    model = PPO("MlpPolicy", env, n_steps=64, seed=1, device="cpu", policy_kwargs={"net_arch": [16, 8]} | policy)
    with torch.no_grad():
        for parameter in model.policy.parameters():  # new ones hardly act at all
            parameter += 0.3 * torch.randn(parameter.shape, generator=torch.Generator().manual_seed(parameter.numel()))
    model.save(path)
    return model


def started(path: Path, hidden: tuple[int, ...] = (16, 8), task: ControlSettings = TASK) -> ControlLearner:
    settings = ControlLearnerSettings(start=path, policy=MLPPolicySettings(hidden=hidden), device="cpu")
    return settings.build(task.build(), np.random.default_rng(5))


def test_a_learner_that_starts_from_a_zip_does_what_it_does(tmp_path: Path) -> None:
    theirs = saved(tmp_path / "policy.zip")
    learner = started(tmp_path / "policy.zip")
    expected = theirs.predict(SEEN, deterministic=True)[0]
    np.testing.assert_allclose(learner.actor()(SEEN, None, None)[0], expected, atol=1e-5)
    policy = cast(MLPPolicy, learner.policy)
    values = policy.values_of(torch.from_numpy(policy.normalise(SEEN)))
    with torch.no_grad():
        np.testing.assert_allclose(values, theirs.policy.predict_values(torch.from_numpy(SEEN))[:, 0], atol=1e-5)
    np.testing.assert_allclose(load_policy(tmp_path / "policy.zip").predict(SEEN)[0], expected, atol=1e-5)
    learner.policy.observe(50 + 20 * SEEN)  # a rollout without gradient steps
    np.testing.assert_allclose(learner.actor()(SEEN, None, None)[0], expected, atol=1e-5)


def test_the_statistics_beside_a_zip_are_taken_over_and_pickled_ones_are_refused(tmp_path: Path) -> None:
    env = VecNormalize(DummyVecEnv([lambda: gymnasium.make("Pendulum-v1")]))
    env.obs_rms.update(np.random.default_rng(0).normal(0.3, 2.0, (400, 3)))
    theirs = saved(tmp_path / "policy.zip", env)
    env.save(tmp_path / "vecnormalize.pkl")
    with pytest.raises(ValueError, match="prefrl reads no pickle"):
        load_policy(tmp_path / "policy.zip")
    rms = env.obs_rms
    np.savez(tmp_path / "policy.npz", mean=rms.mean, var=rms.var, count=rms.count)
    learner = started(tmp_path / "policy.zip")
    expected = theirs.predict(env.normalize_obs(SEEN), deterministic=True)[0]
    np.testing.assert_allclose(learner.actor()(SEEN, None, None)[0], expected, atol=1e-5)
    learner.policy.observe(np.random.default_rng(1).normal(0.0, 25.0, (400, 3)))
    np.testing.assert_allclose(learner.actor()(SEEN, None, None)[0], expected, atol=1e-5)
    np.testing.assert_array_equal(cast(MLPPolicy, learner.policy).normaliser.mean, rms.mean)  # frozen


def test_a_learner_that_starts_from_a_run_does_what_it_does_and_goes_on_without_it(
    finished_tiny: dict[str, Path], tmp_path: Path
) -> None:
    run = shutil.copytree(finished_tiny["control/toy"], tmp_path / "run")
    config = open_saved(run).config
    assert isinstance(config.learner, ControlLearnerSettings)
    settings = config.learner.model_copy(update={"start": run})
    task, observations = config.build_task(), np.array([[0.3, -0.2], [0.9, 0.1]], np.float32)
    learner = settings.build(task, np.random.default_rng(9))
    expected = load_policy(run).predict(observations)[0]
    np.testing.assert_array_equal(learner.actor()(observations, None, None)[0], expected)
    shutil.rmtree(run)
    again = settings.build(task, np.random.default_rng(3))
    again.load(learner.state())
    np.testing.assert_array_equal(again.actor()(observations, None, None)[0], expected)
    with pytest.raises(ConfigError, match="there is no "):
        settings.build(task, np.random.default_rng(3)).actor()


def test_what_cannot_be_a_start_is_refused(finished_tiny: dict[str, Path], tmp_path: Path) -> None:
    saved(tmp_path / "policy.zip")
    saved(tmp_path / "relu.zip", activation_fn=torch.nn.ReLU)
    saved(tmp_path / "uneven.zip", net_arch={"pi": [16, 8], "vf": [8]})
    (tmp_path / "no.zip").write_text("nothing")
    cartpole = ControlSettings(env="CartPole-v1")
    for path, task, hidden, message in (
        (tmp_path / "policy.zip", TASK, (64, 64), r"set learner.policy.hidden=\[16, 8\]"),
        (tmp_path / "policy.zip", cartpole, (16, 8), "expected a policy for CartPole-v1, with observations of 4"),
        (tmp_path / "relu.zip", TASK, (16, 8), "expected a policy with tanh, and this one has ReLU"),
        (tmp_path / "uneven.zip", TASK, (16, 8), "of the same widths"),
        (tmp_path / "no.zip", TASK, (16, 8), "expected a zip of stable-baselines3"),
        (finished_tiny["text/toy"], TASK, (16, 8), "holds no policy of control"),
        (finished_tiny["control/toy"], TASK, (16, 8), "expected a policy for Pendulum-v1"),
    ):
        with pytest.raises(ConfigError, match=message):
            started(path, hidden, task).actor()
    with pytest.raises(RunError, match="a zip holds one policy"):
        load_policy(tmp_path / "policy.zip", best=True)


def test_nothing_that_is_pickled_in_a_zip_is_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    saved(tmp_path / "policy.zip")
    with zipfile.ZipFile(tmp_path / "policy.zip") as old, zipfile.ZipFile(tmp_path / "other.zip", "w") as new:
        for name in old.namelist():
            # What cloudpickle left is replaced by what no reader of it would survive.
            new.writestr(name, old.read(name).replace(b"gAWV", b"!!!!") if name == "data" else old.read(name))
    there = read_zip(tmp_path / "policy.zip").actor()(SEEN, None)[1]
    np.testing.assert_array_equal(read_zip(tmp_path / "other.zip").actor()(SEEN, None)[1], there)


@pytest.mark.parametrize(("env", "squash"), [("Pendulum-v1", False), ("Pendulum-v1", True), ("CartPole-v1", False)])
def test_onnx_acts_as_the_policy_does(env: str, squash: bool, tmp_path: Path) -> None:
    pytest.importorskip("onnx")
    from onnx.reference import ReferenceEvaluator

    from prefrl.policies.to_onnx import save_onnx

    learner = ControlLearnerSettings(policy=MLPPolicySettings(hidden=(16, 8), squash=squash), device="cpu").build(
        ControlSettings(env=env).build(), np.random.default_rng(0)
    )
    rng, size = np.random.default_rng(1), 3 if env == "Pendulum-v1" else 4
    learner.policy.observe(rng.normal(0.3, 2.0, (500, size)))
    for parameter in learner.policy.parameters():
        parameter.data += 0.5 * torch.from_numpy(rng.standard_normal(parameter.shape)).float()
    observations = (3 * rng.standard_normal((50, size))).astype(np.float32)
    actor = cast(MLPPolicy, learner.policy).numpy_actor()
    save_onnx(actor, tmp_path / "policy.onnx")
    found = ReferenceEvaluator(str(tmp_path / "policy.onnx")).run(None, {"observations": observations})[0]
    actions = actor(observations, None)[1]
    if env == "Pendulum-v1":
        np.testing.assert_allclose(found, actions, atol=1e-5)
    else:
        np.testing.assert_array_equal(found, actions.argmax(1))


def test_a_video_of_a_zip_is_recorded(prefrl: Shell) -> None:
    pytest.importorskip("av")
    saved(Path("policy.zip"))
    assert prefrl("record policy.zip --episodes 1") == 2
    assert "name it, as in --env Pendulum-v1" in prefrl.err
    assert prefrl("record policy.zip --env CartPole-v1 --episodes 1") == 2
    assert "expected a policy for CartPole-v1" in prefrl.err
    assert prefrl("record policy.zip --env Pendulum-v1 --episodes 2 --out film.mp4") == 0
    assert "episode 2: return -" in prefrl.out
    assert Path("film.mp4").stat().st_size > 1000
    import av

    with av.open("film.mp4") as film:
        assert sum(1 for _ in film.decode(video=0)) == 2 * 200


def test_a_run_of_text_is_not_recorded(prefrl: Shell, finished_tiny: dict[str, Path]) -> None:
    assert prefrl(f"record {finished_tiny['text/toy']}") == 2
    assert "expected a run of a control task" in prefrl.err


def test_every_query_of_several_policies_mixes_them(prefrl: Shell) -> None:
    for name in ("a", "b"):
        saved(Path(f"{name}.zip"))
    ask = "label control/pendulum --out labels task.horizon=60"
    assert prefrl(f"{ask} loop.labels=6 --policy a.zip --policy b.zip") == 0
    assert "6 of 6 queries answered" in prefrl.out
    with Store[Segment](Path("labels"), write=False) as store:
        asked = [[c.episode.split("/")[0] for c in one.query.candidates] for one in store.judged()]
    assert [sorted(names) for names in asked] == [["a.zip", "b.zip"]] * 6
    assert len({tuple(names) for names in asked}) == 2  # sides are random
    assert prefrl(f"{ask} loop.labels=8 --policy a.zip --given labels/config.yaml") == 2
    assert "two sources of candidates" in prefrl.err
    assert prefrl("label control/cartpole --policy a.zip --out other") == 2
    assert "expected a policy for CartPole-v1" in prefrl.err


def test_a_planner_has_no_policy_to_load_and_says_so(tmp_path: Path) -> None:
    with Run(shrink(Config.load("control/gridworld-planner")), tmp_path / "run") as run:
        list(run)
    with pytest.raises(RunError, match=r"learner\.kind=planner has no policy to load"):
        load_policy(tmp_path / "run")
    with pytest.raises(RunError, match=r"learner\.kind=planner has no policy to load"):
        export_sb3(tmp_path / "run", tmp_path / "policy.zip")
