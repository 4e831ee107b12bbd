"""The batched MuJoCo stepper is gymnasium's v5 environments, to the bit."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest

from prefrl.envs.control import ControlSettings
from prefrl.envs.fast.locomotion import BODIES, Locomotion
from prefrl.envs.fast.wrapped import Wrapped, make


def _envs(name: str, count: int, horizon: int = 1000, fixed_horizon: bool = True) -> Locomotion:
    return Locomotion(name, partial(make, name, disable_env_checker=True), count, horizon, fixed_horizon)


@pytest.mark.parametrize("name", list(BODIES))
def test_it_equals_gymnasium_to_the_bit_over_hundreds_of_steps(name: str) -> None:
    rng = np.random.default_rng(0)
    ours = _envs(name, 3)
    first = ours.reset(rng)
    options: dict[str, Any] = {} if name == "HalfCheetah-v5" else {"terminate_when_unhealthy": False}
    reference: list[Any] = [make(name, disable_env_checker=True, **options).unwrapped for _ in range(3)]
    for env, state, observation in zip(reference, ours.states(), first, strict=True):
        env.reset(seed=0)
        env.data.qacc_warmstart[:] = 0.0  # as after a reset of the simulator, from which ours starts
        env.set_state(state[: env.model.nq], state[env.model.nq :])
        assert np.array_equal(observation, env._get_obs().astype(np.float32))
    for _ in range(300):
        actions = rng.uniform(-1, 1, (3, len(ours._controls[0]))).astype(np.float32)
        step = ours.step(actions)
        theirs = [env.step(a) for env, a in zip(reference, actions, strict=True)]
        assert np.array_equal(step.observations, np.stack([t[0] for t in theirs]).astype(np.float32))
        assert np.array_equal(step.rewards, np.array([t[1] for t in theirs]))
        assert np.array_equal(ours.states(), np.stack([env.state_vector() for env in reference]))


@pytest.mark.parametrize("name", ["Hopper-v5", "Walker2d-v5"])
def test_it_terminates_where_gymnasium_does_when_asked_to(name: str) -> None:
    ours = _envs(name, 1, fixed_horizon=False)
    ours.reset(np.random.default_rng(0))
    env: Any = make(name, disable_env_checker=True).unwrapped
    env.reset(seed=0)
    env.data.qacc_warmstart[:] = 0.0
    env.set_state(ours.states()[0, : env.model.nq], ours.states()[0, env.model.nq :])
    for _ in range(300):
        action = np.ones(env.model.nu, np.float32)
        step, theirs = ours.step(action[None]), env.step(action)
        assert step.terminated[0] == theirs[2]
        assert step.rewards[0] == theirs[1]
        if theirs[2]:
            break
    assert step.terminated[0]
    assert not np.array_equal(step.observations, step.final_observations)


def test_first_states_are_drawn_as_gymnasium_draws_them() -> None:
    for name, body in BODIES.items():
        states = _envs(name, 150)
        states.reset(np.random.default_rng(0))
        noise = states.states() - np.concatenate(states._first)
        positions, velocities = np.split(noise, [states._model.nq], axis=1)
        assert positions.std() == pytest.approx(body.reset_noise / np.sqrt(3), rel=0.1)
        expected = body.reset_noise if body.normal_velocities else body.reset_noise / np.sqrt(3)
        assert velocities.std() == pytest.approx(expected, rel=0.1)


def test_the_task_takes_the_fast_stepper_and_others_the_general_one() -> None:
    assert isinstance(ControlSettings(env="Hopper-v5").build().environments(1), Locomotion)
    assert isinstance(ControlSettings(env="Swimmer-v5").build().environments(1), Wrapped)


def test_making_a_model_writes_no_log_file(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    make("Hopper-v5", disable_env_checker=True)
    assert list(tmp_path.iterdir()) == []
