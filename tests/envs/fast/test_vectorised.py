"""The vectoriser, over a world with chance and with moves that are not legal; and what worlds have in common."""

from __future__ import annotations

import numpy as np
import pytest
from corridor import LEFT, RIGHT, STAY, Corridor

from prefrl.envs.control import WORLDS, ControlSettings
from prefrl.envs.fast.classic import Acrobot, CartPole, MountainCar, MountainCarContinuous, Pendulum
from prefrl.envs.fast.vectorised import Vectorised, _check
from prefrl.envs.toys import INK, Point, PointSettings
from prefrl.protocols import Dynamics
from prefrl.types import Segment

EVERY: dict[str, tuple[Dynamics, int]] = {
    "pendulum": (Pendulum(), 1),
    "cartpole": (CartPole(terminate=True), 2),
    "acrobot": (Acrobot(terminate=True), 3),
    "mountain car": (MountainCar(), 3),
    "continuous mountain car": (MountainCarContinuous(), 1),
    "point": (Point(), 2),
    "corridor": (Corridor(), 3),
}


def _walk(seed: int, steps: int = 30) -> bytes:
    envs = Vectorised(Corridor(), 5, 8)
    seen = [envs.reset(np.random.default_rng(seed))]
    for _ in range(steps):
        places = envs.states()[:, 0]
        seen.append(envs.step(np.where((places < 3)[:, None], RIGHT, LEFT)).observations)
    return np.stack(seen).tobytes()


def test_chance_comes_from_the_generator_of_the_reset() -> None:
    assert _walk(0) == _walk(0) != _walk(1)


def test_a_move_slips_as_often_as_the_world_says() -> None:
    envs = Vectorised(Corridor(length=10_000, slip=0.25), 20_000, 5)
    before = envs.reset(np.random.default_rng(0))[:, 0]
    inside = before < 9_999
    moved = envs.step(np.where(inside[:, None], RIGHT, STAY)).final_observations[:, 0] - before
    assert moved[inside].mean() == pytest.approx(0.75, abs=0.02)


def test_legal_moves_are_those_of_the_states_as_they_stand_after_a_reset_too() -> None:
    envs = Vectorised(Corridor(slip=0.0), 40, 3)
    envs.reset(np.random.default_rng(0))
    for _ in range(7):
        legal, places = envs.legal(), envs.states()[:, 0]
        assert legal is not None
        np.testing.assert_array_equal(legal[:, 0], places > 0)
        np.testing.assert_array_equal(legal[:, 2], places < 3)
        envs.step(np.where(legal[:, 2:], RIGHT, LEFT))


def test_a_move_that_is_not_legal_is_refused_and_nothing_moves() -> None:
    envs = Vectorised(Corridor(slip=0.0), 3, 5)
    envs.reset(np.random.default_rng(0))
    envs._states = np.array([[1.0], [0.0], [3.0]])
    envs._legal = Corridor().legal(envs._states)
    with pytest.raises(ValueError, match=r"action 0 of environment 1 is not legal there; expected one of \[1, 2\]"):
        envs.step(np.stack([LEFT, LEFT, LEFT]))
    assert envs.states().tolist() == [[1.0], [0.0], [3.0]]
    assert envs.step(np.stack([LEFT, RIGHT, LEFT])).observations.tolist() == [[0.0], [1.0], [2.0]]


def test_of_many_legal_moves_some_are_named() -> None:
    legal = np.ones((1, 1000), bool)
    legal[0, 3] = False
    with pytest.raises(ValueError, match=r"expected one of \[0, 1, 2, 4, 5, 6, 7, 8, 9, 10, \.\.\.\]: use"):
        _check(np.eye(1000, dtype=np.float32)[3:4], legal)


@pytest.mark.parametrize("name", EVERY)
def test_a_world_changes_nothing_that_it_is_given_and_repeats_itself(name: str) -> None:
    world, actions = EVERY[name]
    states = world.start(6, np.random.default_rng(0))
    kept = states.copy()
    chosen = np.eye(actions, dtype=np.float32)[np.full(6, actions // 2)]
    first, second = (world.advance(states, chosen, np.random.default_rng(1)) for _ in range(2))
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one, other)
    following, rewards, terminated = first
    assert following.dtype == np.float64
    assert following.shape == states.shape
    assert not np.shares_memory(following, states)
    assert rewards.shape == terminated.shape == (6,)
    assert terminated.dtype == np.bool_
    assert world.observe(states).dtype == np.float32
    legal = world.legal(states)
    assert legal is None or (legal.shape == (6, actions) and legal.any(1).all())
    np.testing.assert_array_equal(states, kept)


@pytest.mark.parametrize("name", [name for name in EVERY if name != "corridor"])
def test_a_world_draws_its_states(name: str) -> None:
    world, _ = EVERY[name]
    one, other = (world.picture(state, 32) for state in world.start(2, np.random.default_rng(0)))
    assert one is not None
    assert other is not None
    assert one.shape == (32, 32, 3)
    assert one.dtype == np.uint8
    assert not np.array_equal(one, other)


def test_the_frames_of_a_task_are_its_worlds_pictures() -> None:
    states = np.array([[0.3, 0.1, 0.2, 0.0], [-1.0, 0.0, -0.1, 0.0]])
    segment = Segment(states.astype(np.float32), np.eye(2, dtype=np.float32), "e", 0, states)
    drawn = ControlSettings(env="CartPole-v1", segment_steps=2, frame_size=40).build().frames(segment)
    np.testing.assert_array_equal(drawn, np.stack([CartPole().picture(state, 40) for state in states]))
    plane = (
        PointSettings(frame_size=40)
        .build()
        .frames(Segment(states[:, :2].astype(np.float32), np.zeros((2, 2), np.float32), "e", 0, states[:, :2]))
    )
    np.testing.assert_array_equal(plane, np.stack([Point().picture(state, 40) for state in states[:, :2]]))
    assert (plane == INK).all(3).any()


def test_the_table_of_worlds_knows_whether_episodes_may_end_early() -> None:
    cars = ["MountainCar-v0", "MountainCarContinuous-v0"]
    assert sorted(WORLDS) == ["Acrobot-v1", "CartPole-v0", "CartPole-v1", *cars, "Pendulum-v1"]
    for name, world in {"CartPole-v1": CartPole, "Acrobot-v1": Acrobot, "MountainCar-v0": MountainCar}.items():
        assert [WORLDS[name](early) for early in (True, False)] == [world(True), world(False)]
