"""Segments drawn again from their states."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from prefrl.envs.control import ControlSettings, GymnasiumTask
from prefrl.envs.fast.bodies import BODIES
from prefrl.envs.render import graphics
from prefrl.types import Floats, Segment

needs_graphics = pytest.mark.skipif(graphics() is None, reason="no OpenGL library (libegl1 libgl1-mesa-dri)")


def _segment(task: GymnasiumTask, states: Floats) -> Segment:
    count = len(states)
    observations = np.zeros((count, task.observation_size), np.float32)
    return Segment(observations, np.ones((count, task.action_size), np.float32), "e", 0, states)


def _task(env: str, size: int = 64) -> GymnasiumTask:
    return ControlSettings(env=env, segment_steps=3, frame_size=size).build()


def _centre(picture: np.ndarray) -> tuple[float, float]:
    """Where the red is, as (row, column) in [-1, 1] from the middle; down and right are positive."""
    red = (picture[..., 0].astype(int) - picture[..., 2]) > 60
    rows, columns = np.nonzero(red)
    half = len(picture) / 2
    return rows.mean() / half - 1, columns.mean() / half - 1


def test_a_pendulum_at_angle_0_points_up_and_turns_anticlockwise() -> None:
    task = _task("Pendulum-v1")
    frames = task.frames(_segment(task, np.array([[0.0, 0.0], [np.pi / 2, 0.0], [np.pi, 0.0]])))
    assert frames.shape == (3, 64, 64, 3)
    assert frames.dtype == np.uint8
    up, left, down = (_centre(frame) for frame in frames)
    assert up[0] < -0.2
    assert left[1] < -0.2
    assert down[0] > 0.2


def test_a_cartpole_leans_to_the_right_at_positive_angles_and_moves_with_its_cart() -> None:
    task = _task("CartPole-v1")
    states = np.array([[0.0, 0, 0, 0], [0.0, 0, 0.5, 0], [1.5, 0, 0, 0], [400.0, 0, 2.0, 0]])
    still, leaning, moved, _ = (_centre(frame) for frame in task.frames(_segment(task, states)))
    assert still[1] == pytest.approx(0.0, abs=0.02)
    assert leaning[1] > 0.05
    assert moved[1] > 0.3


def test_an_acrobot_hangs_at_0_and_bends_to_the_right_at_positive_angles() -> None:
    task = _task("Acrobot-v1")
    hanging, bent, up = task.frames(_segment(task, np.array([[0.0] * 4, [0.0, 1.0, 0, 0], [np.pi, 0.0, 0, 0]])))
    assert _centre(hanging)[0] > 0.3
    assert _centre(bent)[1] > 0.05
    assert _centre(up)[0] < -0.3


@pytest.mark.parametrize("env", ["MountainCar-v0", "MountainCarContinuous-v0"])
def test_a_mountain_car_rises_on_both_sides_of_its_valley(env: str) -> None:
    task = _task(env)
    left, lowest, right = map(_centre, task.frames(_segment(task, np.array([[-1.1, 0], [-np.pi / 6, 0], [0.5, 0]]))))
    assert left[1] < lowest[1] < right[1]
    assert left[0] < lowest[0]
    assert right[0] < left[0]


def test_any_size_can_be_drawn() -> None:
    for size in (16, 101):
        task = _task("Pendulum-v1", size)
        assert task.frames(_segment(task, np.zeros((1, 2)))).shape == (1, size, size, 3)


def test_a_segment_without_states_says_what_can_be_drawn() -> None:
    task = _task("Pendulum-v1")
    one = Segment(np.zeros((3, 3), np.float32), np.zeros((3, 1), np.float32), "e", 0)
    with pytest.raises(ValueError, match="gives no states"):
        task.frames(one)


@needs_graphics
def test_mujoco_is_drawn_the_right_way_up_and_the_same_twice() -> None:
    task = _task("Hopper-v5")
    envs = task.environments(1)
    envs.reset(np.random.default_rng(0))
    states = envs.states()
    assert states is not None
    one = _segment(task, np.repeat(states, 2, 0))
    frames = task.frames(one)
    assert frames.shape == (2, 64, 64, 3)
    assert frames.dtype == np.uint8
    assert np.array_equal(frames, task.frames(one))
    assert frames[0, -10:].std() > frames[0, :10].std() + 20  # the chequered floor is below


@needs_graphics
def test_another_state_gives_another_picture() -> None:
    task = _task("HalfCheetah-v5")
    envs = task.environments(2)
    envs.reset(np.random.default_rng(0))
    states = envs.states()
    assert states is not None
    first, second = task.frames(_segment(task, states))
    assert not np.array_equal(first, second)


@needs_graphics
@pytest.mark.parametrize("name", sorted(set(BODIES) - {"HalfCheetah-v5", "Hopper-v5"}))
def test_each_body_is_in_its_picture(name: str) -> None:
    """A body moved by a tenth changes the picture's middle, and not its edges alone."""
    task = _task(name)
    envs = task.environments(1)
    envs.reset(np.random.default_rng(0))
    states = envs.states()
    assert states is not None
    moved = states.copy()
    moved[0, 1] += 0.1
    one, other = task.frames(_segment(task, np.concatenate([states, moved])))
    assert one.std() > 5
    assert (one != other)[8:-8, 8:-8].any()


@needs_graphics
def test_no_variable_of_the_environment_has_to_be_set() -> None:
    code = (
        "import numpy as np; from prefrl.envs.control import ControlSettings; from prefrl.types import Segment;"
        "t = ControlSettings(env='Hopper-v5', frame_size=32).build(); e = t.environments(1);"
        "e.reset(np.random.default_rng(0));"
        "s = Segment(np.zeros((1, 11), 'f4'), np.zeros((1, 3), 'f4'), 'e', 0, e.states());"
        "assert t.frames(s).std() > 5"
    )
    done = subprocess.run([sys.executable, "-c", code], env={"PATH": ""}, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
