"""Any policy that can be loaded can show: it acts as it does by itself, with what it remembers."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from runs import finish
from sb3_contrib import RecurrentPPO
from shell import Shell
from stable_baselines3 import DQN, SAC
from stable_baselines3.common.base_class import BaseAlgorithm

from prefrl import Config, load_policy
from prefrl.components import ConfigError
from prefrl.envs.control import ControlSettings
from prefrl.evaluate.shift import FILE
from prefrl.label.expert import Expert, ExpertSettings
from prefrl.protocols import ControlTask, Learner
from prefrl.seeding import streams
from prefrl.storage.checkpoints import save_state
from prefrl.storage.files import whole_folder, write_file
from prefrl.store import Store
from prefrl.types import Floats, Query, Segment

SHORT = ["task.horizon=20", "task.segment_seconds=0.25", "learner.evaluation_episodes=1"]
GRU = [*SHORT, "task.hide=[2]", "learner.policy={kind: gru, width: 8, hidden: 8}"]
FLOW = [*SHORT, "learner.policy={kind: flow, hidden: [8], chunk: 4, execute: 3, steps: 2}"]


@pytest.fixture(scope="module")
def zips(tmp_path_factory: pytest.TempPathFactory) -> dict[str, BaseAlgorithm]:
    """Trained for a few steps, each saved under its path."""
    folder, small = tmp_path_factory.mktemp("zips"), {"seed": 0, "device": "cpu"}
    sac = SAC("MlpPolicy", "Pendulum-v1", learning_starts=20, policy_kwargs={"net_arch": [16]}, **small)
    dqn = DQN("MlpPolicy", "CartPole-v1", learning_starts=20, policy_kwargs={"net_arch": [16]}, **small)
    lstm = {"lstm_hidden_size": 8, "net_arch": [8]}
    recurrent = RecurrentPPO("MlpLstmPolicy", "Pendulum-v1", n_steps=16, policy_kwargs=lstm, **small)
    found = {}
    for name, model in (("sac", sac), ("dqn", dqn), ("recurrent", recurrent)):
        model.learn(40)
        model.save(folder / f"{name}.zip")
        found[name] = model, folder / f"{name}.zip"
    return cast("dict[str, BaseAlgorithm]", found)


def task_of(env: str, **settings: object) -> ControlTask:
    return ControlSettings.model_validate({"env": env, "horizon": 20, "segment_steps": 5, **settings}).build()


def saved(
    folder: Path, preset: str, settings: list[str], louder: Callable[[Any], None] = lambda parameters: None
) -> Path:
    """A run with a policy that was not trained; `louder` changes its weights."""
    config = Config.load(preset, settings)
    learner: Learner = config.build_learner(config.build_task(), streams(0, 0).build)
    state = learner.state()
    if "policy" in state:
        louder(state["policy"]["parameters"])
    with whole_folder(folder) as work:
        save_state(work, "learner", state)
        write_file(work / "config.yaml", config.dump().encode())
        write_file(work / "loop.json", json.dumps({"round": 1}).encode())
    return folder


def gru(folder: Path) -> Path:
    # A new head says next to nothing.
    return saved(folder, "control/pendulum", GRU, lambda p: p["actor_weight"].mul_(100))


def shown(expert: Expert, folder: Path) -> list[Segment]:
    with Store[Segment](folder) as store:
        expert.answer(store, np.random.default_rng(0))
        return [one.like for one in store.demonstrations()]


def corrected(expert: Expert, own: Segment) -> Floats:
    return expert._corrected(Query((own,))).actions


def alone(path: Path, observations: Floats) -> tuple[Floats, Floats]:
    """(n, T, O) -> (n, T, A) what the policy does by itself, and what it would do if it forgot after every step."""
    policy, state, does, forgets = load_policy(path), None, [], []
    for now in observations.swapaxes(0, 1):
        forgets.append(policy.predict(now)[0])
        action, state = policy.predict(now, state)
        does.append(action)
    return np.stack(does, 1), np.stack(forgets, 1)


def stacked(segments: list[Segment]) -> tuple[Floats, Floats]:
    return np.stack([one.observations for one in segments]), np.stack([one.actions for one in segments])


@pytest.mark.parametrize(("name", "env", "noise"), [("sac", "Pendulum-v1", 0.5), ("dqn", "CartPole-v1", 0.3)])
def test_a_zip_of_any_algorithm_shows_what_its_model_does(
    name: str, env: str, noise: float, zips: dict[str, Any], tmp_path: Path
) -> None:
    model, path = zips[name]
    task = task_of(env, variable_horizon=env == "CartPole-v1")
    expert = ExpertSettings(policy=path, episodes=3, noise=noise).build(task)
    own = Segment(
        np.random.default_rng(0).normal(size=(5, task.observation_size)).astype(np.float32), np.zeros((5, 1)), "own", 7
    )
    for observations, actions in (
        *((one.observations, one.actions) for one in shown(expert, tmp_path)),
        (own.observations, corrected(expert, own)),
    ):
        expected, _ = model.predict(observations, deterministic=True)
        if task.action_bounds is None:
            np.testing.assert_array_equal(actions, np.eye(2)[expected])
        else:
            # To the rounding of observations that went through a batch of another shape.
            np.testing.assert_allclose(actions, expected, atol=1e-6)
    assert not expert.wavers


def test_a_recurrent_run_shows_what_it_does_with_what_it_remembers(tmp_path: Path) -> None:
    path, task = gru(tmp_path / "run"), task_of("Pendulum-v1", hide=[2])
    settings = ExpertSettings(policy=path, episodes=3)
    clean = shown(settings.build(task), tmp_path / "clean")
    noisy = shown(settings.model_copy(update={"noise": 0.5}).build(task), tmp_path / "noisy")
    assert not np.allclose(stacked(clean)[0], stacked(noisy)[0], atol=0.01)
    for segments in (clean, noisy):  # noise is executed, the clean action is shown, and what was seen is remembered
        observations, actions = stacked(segments)
        does, forgets = alone(path, observations)
        np.testing.assert_array_equal(actions, does)
        assert np.abs(does - forgets)[:, 1:].max() > 0.01


@pytest.mark.parametrize("of", ["gru", "flow", "recurrent"])
def test_a_correction_remembers_from_the_segments_first_step_on(of: str, zips: dict[str, Any], tmp_path: Path) -> None:
    made = {"gru": gru, "flow": flow}
    path = made[of](tmp_path / "run") if of in made else zips[of][1]
    task = task_of("Pendulum-v1", hide=[2] if of == "gru" else [])
    expert = ExpertSettings(policy=path).build(task)
    own = Segment(
        np.random.default_rng(1).normal(size=(9, task.observation_size)).astype(np.float32), np.zeros((9, 1)), "own", 0
    )
    does, forgets = alone(path, own.observations[None])
    found = corrected(expert, own)
    np.testing.assert_array_equal(found, does[0])
    assert not np.allclose(found, forgets[0], atol=1e-4)
    assert expert.wavers


def flow(folder: Path) -> Path:
    return saved(folder, "control/pendulum", FLOW, lambda p: p["velocity_2"].mul_(100))


def test_a_flow_shows_the_step_of_the_plan_that_it_is_in(tmp_path: Path) -> None:
    path = flow(tmp_path / "run")
    expert = ExpertSettings(policy=path, episodes=2, noise=0.5).build(task_of("Pendulum-v1"))
    observations, actions = stacked(shown(expert, tmp_path / "shown"))
    does, plans_anew = alone(path, observations)
    np.testing.assert_array_equal(actions, does)
    begins = np.arange(20) % 3 == 0
    np.testing.assert_array_equal(actions[:, begins], plans_anew[:, begins])
    assert np.abs(actions - plans_anew)[:, ~begins].max() > 0.01


def test_a_policy_is_measured_beside_an_expert_that_remembers_nothing_alone(
    zips: dict[str, Any], tmp_path: Path
) -> None:
    clone = [*SHORT, "learner.cloning_epochs=1", "labeler.episodes=1"]
    for name in ("sac", "recurrent"):
        finish(Config.load("control/pendulum-demos", [*clone, f"labeler.policy={zips[name][1]}"]), tmp_path / name)
    assert (tmp_path / "sac" / FILE).exists()
    assert not (tmp_path / "recurrent" / FILE).exists()


def test_what_does_not_fit_or_does_not_act_is_refused(
    zips: dict[str, Any], finished_tiny: dict[str, Path], tmp_path: Path
) -> None:
    saved(tmp_path / "planner", "control/gridworld-planner", [])
    (tmp_path / "no.zip").write_text("nothing")
    pendulum = task_of("Pendulum-v1")
    for path, task, says in (
        (zips["dqn"][1], pendulum, "dqn.zip: expected a policy for Pendulum-v1, with observations of 3 .* has .* of 4"),
        (zips["sac"][1], task_of("Pendulum-v1", hide=[2]), "with observations of 2 numbers"),
        (
            zips["sac"][1],
            task_of("MountainCarContinuous-v0"),
            r"1 actions from \[-1.0\] to \[1.0\]; .* \[-2.0\] to \[2.0\]",
        ),
        (gru(tmp_path / "run"), task_of("CartPole-v1"), "expected an expert for CartPole-v1, and .* of Pendulum-v1"),
        (tmp_path / "planner", pendulum, "learner.kind=planner has no policy to load"),
        (finished_tiny["text/toy"], pendulum, "expected a run of a control task, but the task is of kind"),
        (tmp_path / "no.zip", pendulum, "expected a zip of a policy of stable-baselines3"),
        (tmp_path, pendulum, "holds neither a run with a checkpoint nor a saved model"),
    ):
        with pytest.raises(ConfigError, match=f"labeler.policy.*{says}"):
            ExpertSettings(policy=path).build(task)


def test_demonstrate_takes_any_zip(prefrl: Shell, zips: dict[str, Any]) -> None:
    path = zips["recurrent"][1]
    assert prefrl(f"demonstrate control/pendulum --expert {path} --episodes 2 --out shown task.horizon=60") == 0
    with Store[Segment](Path("shown")) as store:
        observations, actions = stacked([one.like for one in store.demonstrations()])
    np.testing.assert_array_equal(actions, alone(path, observations)[0])
