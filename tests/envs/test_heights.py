"""Heights of classic control, by gymnasium's own word."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

from prefrl.envs.fast.classic import Acrobot
from prefrl.envs.heights import HEIGHTS


def test_an_acrobot_is_above_1_where_it_has_reached_its_goal() -> None:
    height = HEIGHTS["Acrobot-v1"]
    poses = np.array([[0.0, 0.0, 0, 0], [np.pi / 2, 0.0, 0, 0], [0.0, np.pi, 0, 0], [np.pi, 0.0, 0, 0]])
    np.testing.assert_allclose(height(poses), [-2, 0, 0, 2], atol=1e-12)
    states = np.random.default_rng(0).uniform(-3, 3, (500, 4))
    states[:, 2:] = 0
    rewards = Acrobot(terminate=True).advance(states, np.eye(3)[np.ones(500, int)], np.random.default_rng(0))[1]
    assert (rewards[height(states) > 1] == 0).all()


@pytest.mark.parametrize("env", ["MountainCar-v0", "MountainCarContinuous-v0"])
def test_a_car_is_as_high_as_gymnasium_draws_it(env: str) -> None:
    drawn: Any = gymnasium.make(env).unwrapped
    x = np.linspace(-1.2, 0.6, 50)
    found = HEIGHTS[env](np.stack([x, 0 * x], 1))
    np.testing.assert_allclose(drawn._height(x), 0.45 * found + 0.55)
