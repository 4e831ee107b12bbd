"""The vectorised classic-control environments are gymnasium's."""

from typing import Any

import gymnasium
import numpy as np
import pytest

from prefrl.envs.fast.classic import CartPole, Pendulum
from prefrl.envs.fast.vectorised import Vectorised


def _reference(name: str, states: np.ndarray) -> list[Any]:
    envs = [gymnasium.make(name, disable_env_checker=True).unwrapped for _ in states]
    for env, state in zip(envs, states, strict=True):
        env.reset(seed=0)
        env.state = state.copy()  # type: ignore[attr-defined]
    return envs


def test_pendulum_moves_as_gymnasiums_to_the_bit_and_rewards_to_rounding() -> None:
    rng = np.random.default_rng(0)
    ours = Vectorised(Pendulum(), 16, 1000)
    ours.reset(rng)
    reference = _reference("Pendulum-v1", ours.states())
    for _ in range(300):
        actions = rng.uniform(-2.5, 2.5, (16, 1)).astype(np.float32)
        step = ours.step(actions)
        theirs = [env.step(a) for env, a in zip(reference, actions, strict=True)]
        assert np.array_equal(step.observations, np.stack([t[0] for t in theirs]))
        # gymnasium squares scalars with pow(), which is off by a last bit now and then.
        np.testing.assert_allclose(step.rewards, np.array([t[1] for t in theirs]), rtol=1e-9)
        assert np.array_equal(ours.states(), np.stack([env.state for env in reference]))


@pytest.mark.parametrize("terminate", [False, True])
def test_cartpole_equals_gymnasium_to_the_bit_until_it_falls(terminate: bool) -> None:
    rng = np.random.default_rng(1)
    ours = Vectorised(CartPole(terminate), 16, 1000)
    ours.reset(rng)
    reference = _reference("CartPole-v1", ours.states())
    alive = np.ones(16, bool)
    for _ in range(200):
        actions = np.eye(2, dtype=np.float32)[rng.integers(2, size=16)]
        step = ours.step(actions)
        for i in np.flatnonzero(alive):
            observation, reward, terminated, *_ = reference[i].step(int(actions[i].argmax()))
            assert np.array_equal(step.final_observations[i], observation)
            assert step.terminated[i] == (terminated and terminate)
            assert step.rewards[i] == (reward if terminate else 1.0 - terminated)
            alive[i] = not terminated
    assert not alive.any()


def test_an_ended_episode_is_reset_in_the_same_step_and_its_last_observation_kept() -> None:
    envs = Vectorised(Pendulum(), 2, 3)
    envs.reset(np.random.default_rng(0))
    steps = [envs.step(np.zeros((2, 1), np.float32)) for _ in range(6)]
    assert [s.truncated.tolist() for s in steps] == [[t] * 2 for t in (False, False, True) * 2]
    assert np.array_equal(steps[1].observations, steps[1].final_observations)
    assert not np.array_equal(steps[2].observations, steps[2].final_observations)
    assert np.array_equal(steps[2].observations, Pendulum().observe(envs_states_at(2)))


def envs_states_at(steps: int) -> np.ndarray:
    envs = Vectorised(Pendulum(), 2, 3)
    envs.reset(np.random.default_rng(0))
    for _ in range(steps + 1):
        envs.step(np.zeros((2, 1), np.float32))
    return envs.states()


def test_an_end_at_the_horizon_that_is_also_a_fall_counts_as_a_termination() -> None:
    envs = Vectorised(CartPole(terminate=True), 4, 10)
    envs.reset(np.random.default_rng(0))
    right = np.tile(np.array([0.0, 1.0], np.float32), (4, 1))
    steps = [envs.step(right) for _ in range(10)]
    ends = [int(s.terminated.sum() + s.truncated.sum()) for s in steps]
    assert sum(ends) == 4
    assert not any((s.terminated & s.truncated).any() for s in steps)


def test_same_seed_gives_equal_bytes() -> None:
    def run() -> bytes:
        envs = Vectorised(CartPole(), 4, 5)
        first = envs.reset(np.random.default_rng(3))
        left = np.tile(np.array([1.0, 0.0], np.float32), (4, 1))
        return first.tobytes() + b"".join(envs.step(left).observations.tobytes() for _ in range(12))

    assert run() == run()
