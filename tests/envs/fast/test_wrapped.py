"""Any gymnasium environment, through the generic stepper."""

from functools import partial
from typing import Any

import gymnasium
import numpy as np
import pytest

from prefrl.envs.fast.classic import Pendulum
from prefrl.envs.fast.vectorised import Vectorised
from prefrl.envs.fast.wrapped import AfterEnd, Wrapped
from prefrl.protocols import Transition

make_pendulum = partial(gymnasium.make, "Pendulum-v1", max_episode_steps=5, disable_env_checker=True)


def test_it_steps_as_gymnasium_does_and_keeps_final_observations() -> None:
    envs = Wrapped(make_pendulum, 2, 5, "absorb")
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


def fallen(after: AfterEnd, steps: int) -> list[Transition]:
    """A pole that is pushed to one side until it falls, after 9 or 10 steps."""
    envs = Wrapped(partial(gymnasium.make, "CartPole-v1", disable_env_checker=True), 1, 30, after)
    envs.reset(np.random.default_rng(0))
    return [envs.step(np.array([[0.0, 1.0]], np.float32)) for _ in range(steps)]


def test_an_episode_that_the_environment_ends_goes_on_where_it_ended_for_nothing() -> None:
    steps = fallen("absorb", 31)
    rewards = np.array([step.rewards[0] for step in steps])
    length = int(rewards[:30].sum())
    assert 8 <= length <= 11
    assert rewards[:30].tolist() == [1.0] * length + [0.0] * (30 - length)
    for step in steps[length:30]:
        np.testing.assert_array_equal(step.final_observations, steps[length - 1].final_observations)
    assert not any(step.terminated.any() for step in steps)
    assert [i for i, step in enumerate(steps) if step.truncated.any()] == [29]
    assert abs(steps[29].observations[0, 2]) < 0.05  # a fresh start
    assert rewards[30] == 1.0


def test_an_episode_that_the_environment_ends_may_go_on_from_a_fresh_start() -> None:
    steps = fallen("restart", 30)
    assert [step.rewards[0] for step in steps] == [1.0] * 30
    assert max(abs(step.final_observations[0, 2]) for step in steps) < 0.3
    assert [i for i, step in enumerate(steps) if step.truncated.any()] == [29]
    assert not any(step.terminated.any() for step in steps)


def test_an_episode_may_end() -> None:
    steps = fallen("end", 20)
    first = next(i for i, step in enumerate(steps) if step.terminated.any())
    assert 8 <= first + 1 <= 11
    assert abs(steps[first].final_observations[0, 2]) > 0.2
    assert abs(steps[first].observations[0, 2]) < 0.05


class Limited(gymnasium.Env[np.ndarray, Any]):
    """Counts its steps, and says after each `limit` of them that time is up."""

    observation_space = gymnasium.spaces.Box(0.0, 99.0, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, limit: int) -> None:
        self._limit, self._count = limit, 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        self._count = 0
        return np.zeros(1, np.float32), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self._count += 1
        return np.array([self._count], np.float32), 1.0, False, self._count == self._limit, {}


@pytest.mark.parametrize(
    ("after", "limit", "counts", "rewards"),
    [
        ("absorb", 3, [1, 2, 3, 3, 3, 3, 3], [1, 1, 1, 0, 0, 0, 0]),
        ("restart", 3, [1, 2, 0, 1, 2, 0, 1], [1] * 7),
        ("absorb", 7, [1, 2, 3, 4, 5, 6, 7], [1] * 7),
        ("restart", 7, [1, 2, 3, 4, 5, 6, 7], [1] * 7),
    ],
)
def test_a_limit_of_the_environments_own_does_not_shorten_an_episode(
    after: AfterEnd, limit: int, counts: list[int], rewards: list[int]
) -> None:
    envs = Wrapped(partial(Limited, limit), 2, 7, after)
    envs.reset(np.random.default_rng(0))
    for _ in range(2):  # the second episode is as long
        steps = [envs.step(np.zeros((2, 1), np.float32)) for _ in range(7)]
        assert [step.final_observations.tolist() for step in steps] == [[[count]] * 2 for count in counts]
        assert [step.rewards.tolist() for step in steps] == [[reward] * 2 for reward in rewards]
        assert [step.truncated.tolist() for step in steps] == [[False] * 2] * 6 + [[True] * 2]
        assert not any(step.terminated.any() for step in steps)
        assert steps[-1].observations.tolist() == [[0.0], [0.0]]


def test_where_episodes_may_end_a_limit_of_the_environments_own_is_a_time_limit() -> None:
    envs = Wrapped(partial(Limited, 3), 1, 7, "end")
    envs.reset(np.random.default_rng(0))
    steps = [envs.step(np.zeros((1, 1), np.float32)) for _ in range(6)]
    assert [bool(step.truncated[0]) for step in steps] == [False, False, True] * 2
    assert not any(step.terminated.any() for step in steps)


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

    envs = Wrapped(Echo, 3, 10, "absorb")
    envs.reset(np.random.default_rng(0))
    assert envs.step(np.eye(3, dtype=np.float32)).observations.ravel().tolist() == [-1.0, 0.0, 1.0]
    assert envs.states() is None
