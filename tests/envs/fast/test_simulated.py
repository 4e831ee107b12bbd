"""The batched MuJoCo stepper is gymnasium's v5 environments, to the bit."""

from __future__ import annotations

import gc
import inspect
import os
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mujoco.batch import SimulationError

from prefrl.envs.control import ControlSettings
from prefrl.envs.fast.bodies import BODIES, _always
from prefrl.envs.fast.simulated import Simulated
from prefrl.envs.fast.wrapped import Wrapped, make

TASKS = Path("/proc/self/task")


def _envs(name: str, count: int, horizon: int = 1000, fixed_horizon: bool = True, **others: Any) -> Simulated:
    return Simulated(name, partial(make, name, disable_env_checker=True), count, horizon, fixed_horizon, **others)


def _reference(name: str, count: int, fixed_horizon: bool, rng: np.random.Generator) -> list[Any]:
    """gymnasium's own, which draw their first states from `rng`, one after another."""
    envs: list[Any] = [make(name, disable_env_checker=True).unwrapped for _ in range(count)]
    if fixed_horizon and "terminate_when_unhealthy" in inspect.signature(type(envs[0]).__init__).parameters:
        options: dict[str, Any] = {"terminate_when_unhealthy": False}
        envs = [make(name, disable_env_checker=True, **options).unwrapped for _ in range(count)]
    for env in envs:
        env.np_random = rng
    return envs


def _rows(observations: list[Any]) -> np.ndarray:
    return np.stack(observations).astype(np.float32)


@pytest.mark.parametrize("fixed_horizon", [True, False])
@pytest.mark.parametrize("name", list(BODIES))
def test_it_equals_gymnasium_to_the_bit_over_a_thousand_steps_and_their_resets(name: str, fixed_horizon: bool) -> None:
    ours = _envs(name, 4, 300, fixed_horizon)
    reference = _reference(name, 4, fixed_horizon, np.random.default_rng(0))
    assert np.array_equal(ours.reset(np.random.default_rng(0)), _rows([env.reset()[0] for env in reference]))
    box, rng, elapsed = reference[0].action_space, np.random.default_rng(1), np.zeros(4, int)
    for _ in range(1000):
        actions = rng.uniform(box.low, box.high, (4, len(box.low))).astype(np.float32)
        step = ours.step(actions)
        observations, rewards, terminated = zip(
            *(env.step(a)[:3] for env, a in zip(reference, actions, strict=True)), strict=True
        )
        elapsed += 1
        assert np.array_equal(step.final_observations, _rows(list(observations)))
        assert np.array_equal(step.rewards, np.array(rewards))
        assert np.array_equal(step.terminated, np.array(terminated) & (not fixed_horizon))
        assert np.array_equal(step.truncated, (elapsed >= 300) & ~step.terminated)
        ended = step.terminated | step.truncated
        elapsed[ended] = 0
        following = [env.reset()[0] if e else o for env, e, o in zip(reference, ended, observations, strict=True)]
        assert np.array_equal(step.observations, _rows(following))
        assert np.array_equal(ours.states(), np.stack([env.state_vector() for env in reference]))


@pytest.mark.parametrize("fixed_horizon", [True, False])
@pytest.mark.parametrize("name", list(BODIES))
def test_any_number_of_threads_steps_to_the_same_bits(name: str, fixed_horizon: bool) -> None:
    one = _envs(name, 5, 25, fixed_horizon)
    several = [_envs(name, 5, 25, fixed_horizon, threads=threads) for threads in (2, 3, 9)]
    part = _envs(name, 5, 25, mine=range(1, 4), threads=2) if fixed_horizon else None
    everyone = [(one, slice(5)), *((envs, slice(5)) for envs in several), *([(part, slice(1, 4))] if part else [])]
    first = [envs.reset(np.random.default_rng(0)) for envs, _ in everyone]
    assert all(np.array_equal(found, first[0][rows]) for found, (_, rows) in zip(first, everyone, strict=True))
    rng, width = np.random.default_rng(1), one._bodies._controls.shape[1]
    for _ in range(60):  # past two ends of episodes at least
        actions = rng.uniform(-1, 1, (5, width)).astype(np.float32)
        steps = [envs.step(actions[rows]) for envs, rows in everyone]
        for step, (envs, rows) in zip(steps, everyone, strict=True):
            assert all(np.array_equal(found, wanted[rows]) for found, wanted in zip(step, steps[0], strict=True))
            assert np.array_equal(envs.states(), one.states()[rows])


@pytest.mark.skipif(not TASKS.exists(), reason="counts threads as Linux lists them")
def test_threads_end_with_the_environments_that_they_step() -> None:
    before = len(list(TASKS.iterdir()))
    envs = _envs("HalfCheetah-v5", 4, threads=3)
    assert len(list(TASKS.iterdir())) == before + 2  # the third is the caller's
    del envs
    gc.collect()
    assert len(list(TASKS.iterdir())) == before


def test_a_forked_process_is_told_that_it_has_no_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    actions = np.zeros((2, 6), np.float32)
    single, several = _envs("HalfCheetah-v5", 2), _envs("HalfCheetah-v5", 2, threads=2)
    for envs in (single, several):
        envs.reset(np.random.default_rng(0))
    monkeypatch.setattr(os, "getpid", lambda: -1)
    single.step(actions)
    with pytest.raises(RuntimeError, match="a forked process does not have"):
        several.step(actions)


def test_an_error_of_a_simulator_reaches_the_caller() -> None:
    envs = _envs("HalfCheetah-v5", 4, threads=2)
    envs.reset(np.random.default_rng(0))
    envs._bodies._batch.expand("opt.integrator")[3] = 99
    with pytest.raises(SimulationError, match=r"in 1 of 4 simulations \(3\); simulation 3: .*integrator"):
        envs.step(np.zeros((4, 6), np.float32))


@pytest.mark.parametrize("name", [name for name, body in BODIES.items() if body.healthy is not _always])
def test_an_unhealthy_body_ends_its_episode_only_when_asked_to(name: str) -> None:
    ending, going = _envs(name, 4, fixed_horizon=False), _envs(name, 4)
    for envs in (ending, going):
        envs.reset(np.random.default_rng(0))
    rng = np.random.default_rng(1)
    for _ in range(999):
        actions = rng.uniform(-1, 1, (4, len(going._bodies._controls[0]))).astype(np.float32)
        one, other = ending.step(actions), going.step(actions)
        assert np.array_equal(one.rewards, other.rewards)
        assert not other.terminated.any()
        if one.terminated.any():
            break
    assert one.terminated.any()
    fallen = int(one.terminated.argmax())
    assert np.array_equal(other.observations[fallen], one.final_observations[fallen])
    assert not np.array_equal(one.observations[fallen], one.final_observations[fallen])
    still = going.states().copy()
    going.step(actions)
    assert not np.array_equal(going.states()[fallen], still[fallen])


def test_a_fallen_pole_earns_nothing_and_a_fallen_double_pole_only_penalties() -> None:
    rewards = {}
    for name in ("InvertedPendulum-v5", "InvertedDoublePendulum-v5"):
        envs = _envs(name, 2)
        envs.reset(np.random.default_rng(0))
        rewards[name] = np.stack([envs.step(np.ones((2, 1), np.float32)).rewards for _ in range(60)])
    single, double = rewards.values()
    assert (single[0] == 1.0).all()
    assert (single[-1] == 0.0).all()
    assert (double[0] > 9.0).all()
    assert (double[-1] < 0.0).all()


def test_what_is_to_be_reached_or_pushed_lies_where_it_can_be() -> None:
    for name, nearest, furthest in (("Reacher-v5", 0.0, 0.2), ("Pusher-v5", 0.17, np.hypot(0.3, 0.2))):
        envs = _envs(name, 40)
        envs.reset(np.random.default_rng(0))
        joints = slice(2, 4) if name == "Reacher-v5" else slice(7, 9)
        apart = np.hypot(*envs._bodies.now.positions[:, joints].T)
        assert nearest < apart.min() < apart.max() < furthest
        assert not envs._bodies.now.velocities[:, joints].any()


def test_the_task_takes_the_fast_stepper_and_others_the_general_one() -> None:
    for name in BODIES:
        assert isinstance(ControlSettings(env=name, segment_steps=5).build().environments(1), Simulated)
    assert isinstance(ControlSettings(env="HumanoidStandup-v5").build().environments(1), Wrapped)


def test_making_a_model_writes_no_log_file(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    make("Hopper-v5", disable_env_checker=True)
    assert list(tmp_path.iterdir()) == []
