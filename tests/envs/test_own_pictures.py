"""Environments of one's own are drawn by what they can do themselves."""

from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest

from prefrl.envs.control import ControlSettings
from prefrl.envs.render import frames
from prefrl.types import Segment


class Slide(gymnasium.Env[np.ndarray, np.ndarray]):
    """A thing on a line; what is drawn is where it is, and nothing else."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012
    observation_space = gymnasium.spaces.Box(-10, 10, (1,), np.float32)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)

    def __init__(self, render_mode: str | None = None) -> None:
        self.render_mode = render_mode

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.place = self.np_random.uniform(0, 1, 1).astype(np.float32)
        return self.place, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.place = (self.place + 1).astype(np.float32)
        return self.place, 0.0, False, False, {}

    def get_state(self) -> np.ndarray:
        return self.place

    def set_state(self, state: np.ndarray) -> None:
        self.place = state

    def render(self) -> np.ndarray:
        return np.full((20, 20, 3), int(10 * self.place[0]), np.uint8)


@pytest.fixture
def slide() -> Iterator[str]:
    made: Any = Slide  # gymnasium wants any keyword
    gymnasium.register("Slide-v0", made, max_episode_steps=8)
    yield "Slide-v0"
    gymnasium.registry.pop("Slide-v0")


def test_a_clip_shows_the_states_in_which_a_segment_was(slide: str) -> None:
    task = ControlSettings(env=slide, segment_steps=4, frame_size=32).build()
    environments = task.environments(1)
    seen = environments.reset(np.random.default_rng(0))
    states, observations = [], []
    for _ in range(4):
        states.append(environments.states())
        observations.append(seen)
        seen = environments.step(np.zeros((1, 1), np.float32)).observations
    found = np.concatenate([np.asarray(state) for state in states])
    assert found == pytest.approx(np.concatenate(observations))
    segment = Segment(np.concatenate(observations), np.zeros((4, 1), np.float32), "one", 0, found)
    pictures = frames(slide, segment, 32)
    assert pictures.shape == (4, 32, 32, 3)
    assert pictures[:, 16, 16, 0].tolist() == [int(10 * place) for place in found[:, 0]]
