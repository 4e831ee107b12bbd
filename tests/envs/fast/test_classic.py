"""The vectorised classic-control environments are gymnasium's."""

from typing import Any

import gymnasium
import numpy as np
import pytest

from prefrl.envs.control import WORLDS
from prefrl.envs.fast.classic import Acrobot, CartPole, MountainCar, MountainCarContinuous, Pendulum
from prefrl.envs.fast.retold import retelling
from prefrl.envs.fast.vectorised import Vectorised
from prefrl.protocols import Dynamics


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


def _swing(name: str, states: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Actions that mostly push the way that a state moves, and so gain height."""
    spin = states[:, 3] if name == "Acrobot-v1" else states[:, 1]
    wish = np.where(rng.random(len(states)) < 0.3, rng.uniform(-1, 1, len(states)), np.where(spin >= 0, 1.0, -1.0))
    if name == "MountainCarContinuous-v0":
        return wish[:, None].astype(np.float32)
    chosen: np.ndarray = np.eye(3, dtype=np.float32)[np.rint(wish).astype(int) + 1]
    return chosen


@pytest.mark.parametrize("terminate", [False, True])
@pytest.mark.parametrize("name", ["Acrobot-v1", "MountainCar-v0", "MountainCarContinuous-v0"])
def test_what_swings_up_equals_gymnasium_to_the_bit_until_it_is_there(name: str, terminate: bool) -> None:
    rng = np.random.default_rng(2)
    ours = Vectorised(WORLDS[name](terminate), 12, 400)
    ours.reset(rng)
    reference = _reference(name, ours.states().astype(np.float32 if name == "Acrobot-v1" else np.float64))
    underway = np.ones(12, bool)
    for _ in range(390):
        before = ours.states().copy()
        actions = _swing(name, before, rng)
        step = ours.step(actions)
        for i in np.flatnonzero(underway):
            action = actions[i] if actions.shape[1] == 1 else int(actions[i].argmax())
            observation, reward, there, *_ = reference[i].step(action)
            assert np.array_equal(step.final_observations[i], observation)
            assert step.rewards[i] == reward
            assert step.terminated[i] == (there and terminate)
            underway[i] = not there
            assert step.terminated[i] or np.array_equal(ours.states()[i], reference[i].state)
        if not terminate:
            there = ~underway & (before == ours.states()).all(1)
            assert (step.rewards[there] == 0).all()
    assert not underway.any()


@pytest.mark.parametrize(
    ("world", "goal", "reward"),
    [
        (Acrobot(), [np.pi, 0.0, 0.0, 0.0], 0.0),
        (MountainCar(), [0.49, 0.05], -1.0),
        (MountainCarContinuous(), [0.44, 0.05], 100.0),
    ],
)
def test_what_has_reached_its_goal_stays_there_and_pays_no_more(
    world: Dynamics, goal: list[float], reward: float
) -> None:
    state, rng = np.array([goal]), np.random.default_rng(0)
    size = 1 if isinstance(world, MountainCarContinuous) else 3
    rest, push = np.eye(size, dtype=np.float32)[[size // 2]] * (size > 1), np.ones((1, size), np.float32)
    there, first, terminated = world.advance(state, rest, rng)
    still, later, _ = world.advance(there, push, rng)
    assert (first[0], later[0], terminated[0]) == (reward, 0.0, False)
    assert np.array_equal(still, there)


def test_first_states_are_drawn_where_gymnasium_draws_them() -> None:
    for world, low, high in (
        (Acrobot(), -0.1, 0.1),
        (MountainCar(), -0.6, -0.4),
        (MountainCarContinuous(), -0.6, -0.4),
    ):
        states = world.start(200, np.random.default_rng(0))
        drawn = states if states.shape[1] == 4 else states[:, 0]
        assert low <= drawn.min() < low + 0.01
        assert high - 0.01 < drawn.max() <= high
        assert states.shape[1] == 4 or not states[:, 1].any()


def test_an_acrobots_first_observation_is_gymnasiums_to_rounding() -> None:
    states = Acrobot().start(50, np.random.default_rng(0))
    reference = _reference("Acrobot-v1", states.astype(np.float32))
    theirs = np.stack([env._get_ob() for env in reference])
    np.testing.assert_allclose(Acrobot().observe(states), theirs, rtol=0, atol=1e-7)


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


@pytest.mark.parametrize("name", sorted(WORLDS))
def test_states_are_told_from_what_is_seen_and_what_is_imagined_is_judged_as_gymnasium_would(name: str) -> None:
    rng, world = np.random.default_rng(3), WORLDS[name](False)
    discrete = not name.startswith(("Pendulum", "MountainCarContinuous"))
    envs, retell = Vectorised(world, 8, 1000), retelling(world)
    assert retell is not None
    observations = envs.reset(rng)
    for _ in range(60):
        width = {"Pendulum-v1": 1, "MountainCarContinuous-v0": 1, "CartPole-v0": 2, "CartPole-v1": 2}.get(name, 3)
        drawn = np.eye(width)[rng.integers(width, size=8)] if discrete else rng.uniform(-1, 1, (8, 1))
        actions = drawn.astype(np.float32)
        told = retell(observations, actions)
        np.testing.assert_allclose(world.observe(told.states), observations, atol=1e-5)
        np.testing.assert_allclose(told.observations, observations, atol=1e-5)
        step = envs.step(actions)
        np.testing.assert_allclose(told.gold, step.rewards, atol=1e-4)
        observations = step.observations


@pytest.mark.parametrize("name", ["Pendulum-v1", "Acrobot-v1", "MountainCar-v0"])
def test_what_cannot_be_is_told_as_what_looks_most_like_it(name: str) -> None:
    world = WORLDS[name](False)
    retell = retelling(world)
    assert retell is not None
    real = world.observe(world.start(4, np.random.default_rng(0)))
    told = retell(1.7 * real + np.float32(9.0) * (np.arange(real.shape[1]) == real.shape[1] - 1), np.eye(4)[:, :3])
    again = retell(told.observations, np.eye(4)[:, :3])
    np.testing.assert_allclose(again.observations, told.observations, atol=1e-6)
    if name == "Pendulum-v1":
        np.testing.assert_allclose(np.linalg.norm(told.observations[:, :2], axis=1), 1.0, rtol=1e-6)
        assert (np.abs(told.states[:, 1]) <= 8).all()
