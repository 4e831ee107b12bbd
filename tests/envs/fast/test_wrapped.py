"""Any gymnasium environment, through the generic stepper."""

from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest

from prefrl.envs.fast.classic import Pendulum
from prefrl.envs.fast.vectorised import Vectorised
from prefrl.envs.fast.wrapped import Wrapped

make_pendulum = partial(gymnasium.make, "Pendulum-v1", max_episode_steps=5, disable_env_checker=True)


def test_it_steps_as_gymnasium_does_and_keeps_final_observations() -> None:
    envs = Wrapped(make_pendulum, 2, fixed_horizon=True)
    first = envs.reset(np.random.default_rng(0))
    fast = Vectorised(Pendulum(), 2, 5)
    fast.reset(np.random.default_rng(0))
    fast._states = np.stack([np.arctan2(first[:, 1], first[:, 0]), first[:, 2]], 1).astype(np.float64)
    for t in range(5):
        actions = np.full((2, 1), 0.3, np.float32)
        slow, quick = envs.step(actions), fast.step(actions)
        np.testing.assert_allclose(slow.final_observations, quick.final_observations, atol=1e-4)
        np.testing.assert_allclose(slow.rewards, quick.rewards, atol=1e-4)
        assert slow.truncated.all() == (t == 4)
    assert not np.array_equal(slow.observations, slow.final_observations)


def test_a_termination_under_a_fixed_horizon_is_an_error_that_names_the_setting() -> None:
    envs = Wrapped(partial(gymnasium.make, "CartPole-v1", disable_env_checker=True), 1, fixed_horizon=True)
    envs.reset(np.random.default_rng(0))
    right = np.array([[0.0, 1.0]], np.float32)
    for _ in range(5):
        envs.step(right)
    with pytest.raises(ValueError, match=r"task\.variable_horizon=true"):
        [envs.step(right) for _ in range(50)]


def test_a_discrete_action_may_start_at_any_number() -> None:
    class Echo(gymnasium.Env[np.ndarray, Any]):
        observation_space = gymnasium.spaces.Box(-10.0, 10.0, (1,), np.float32)
        action_space = gymnasium.spaces.Discrete(3, start=-1)

        def reset(
            self, *, seed: int | None = None, options: dict[str, Any] | None = None
        ) -> tuple[np.ndarray, dict[str, Any]]:
            return np.zeros(1, np.float32), {}

        def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
            return np.array([action], np.float32), 0.0, False, False, {}

    envs = Wrapped(Echo, 3, fixed_horizon=True)
    envs.reset(np.random.default_rng(0))
    assert envs.step(np.eye(3, dtype=np.float32)).observations.ravel().tolist() == [-1.0, 0.0, 1.0]
    assert envs.states() is None
