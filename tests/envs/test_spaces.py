"""Spaces of several parts become a row of numbers and one choice; what cannot is refused before anything is asked."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, Graph, MultiBinary, MultiDiscrete, Sequence, Space, Tuple

from prefrl.components import ConfigError
from prefrl.envs.control import ControlSettings, GymnasiumTask


class Echo(gymnasium.Env[Any, Any]):
    """Shows a fixed observation, and keeps what it was told to do."""

    told: list[Any]

    def __init__(self, observation: Space[Any], action: Space[Any]) -> None:
        self.observation_space, self.action_space = observation, action
        observation.seed(0)
        self._shown = observation.sample()
        Echo.told = []

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        return self._shown, {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        Echo.told.append(action)
        return self._shown, 0.0, False, False, {}


LINE = Box(-1.0, 1.0, (2,), np.float32)


@pytest.fixture
def register() -> Iterator[None]:
    gymnasium.register("Echo-v0", Echo, max_episode_steps=9)  # type: ignore[arg-type]
    yield
    del gymnasium.registry["Echo-v0"]


def built(observation: Space[Any] = LINE, action: Space[Any] = LINE) -> GymnasiumTask:
    options = {"observation": observation, "action": action}
    gymnasium.registry["Echo-v0"].kwargs = options
    return ControlSettings(env="Echo-v0", segment_steps=3).build()


@pytest.mark.usefixtures("register")
@pytest.mark.parametrize(
    ("space", "size"),
    [
        (Discrete(5), 5),
        (Dict({"a": Discrete(3), "b": Box(-1.0, 1.0, (2, 2), np.float32)}), 7),
        (Tuple((LINE, MultiBinary(3))), 5),
        (MultiDiscrete([2, 3]), 5),
        (Box(0, 255, (2, 2, 3), np.uint8), 12),
        (Box(0, 9, (4,), np.int64), 4),
    ],
    ids=str,
)
def test_observations_become_a_row_of_numbers(space: Space[Any], size: int) -> None:
    task = built(observation=space)
    assert task.observation_size == size
    seen = task.environments(2).reset(np.random.default_rng(0))
    assert seen.dtype == np.float32
    np.testing.assert_array_equal(seen[0], np.asarray(gymnasium.spaces.flatten(space, Echo(space, LINE)._shown)))


@pytest.mark.usefixtures("register")
def test_several_choices_become_one_among_all_their_combinations() -> None:
    task = built(action=MultiDiscrete([2, 3], start=[0, 1]))
    assert (task.action_size, task.action_bounds) == (6, None)
    envs = task.environments(6)
    envs.reset(np.random.default_rng(0))
    envs.step(np.eye(6, dtype=np.float32))
    assert [told.tolist() for told in Echo.told] == [[0, 1], [0, 2], [0, 3], [1, 1], [1, 2], [1, 3]]


@pytest.mark.usefixtures("register")
def test_a_block_of_numbers_to_choose_becomes_a_row() -> None:
    task = built(action=Box(-2.0, 2.0, (2, 2), np.float32))
    assert task.action_size == 4
    envs = task.environments(1)
    envs.reset(np.random.default_rng(0))
    envs.step(np.array([[0.0, 1.0, 2.0, -1.0]], np.float32))
    assert Echo.told[0].tolist() == [[0.0, 1.0], [2.0, -1.0]]


@pytest.mark.usefixtures("register")
@pytest.mark.parametrize("space", [Sequence(Discrete(2)), Graph(LINE, None), Dict({"a": Sequence(LINE)})], ids=str)
def test_observations_without_a_size_are_refused(space: Space[Any]) -> None:
    with pytest.raises(ConfigError, match=r"task\.env: observations must be numbers or choices of a fixed size"):
        built(observation=space)


@pytest.mark.usefixtures("register")
@pytest.mark.parametrize("space", [Dict({"a": Discrete(2)}), MultiBinary(11), Box(0, 9, (2,), np.int64)], ids=str)
def test_actions_that_are_neither_numbers_nor_few_choices_are_refused(space: Space[Any]) -> None:
    with pytest.raises(ConfigError, match=r"task\.env: actions must be a Box of floats, Discrete"):
        built(action=space)


def test_options_reach_the_environment_and_are_checked_by_name() -> None:
    task = ControlSettings(env="HalfCheetah-v5", options={"exclude_current_positions_from_observation": False}).build()
    assert task.observation_size == 18
    with pytest.raises(
        ConfigError, match=r"HalfCheetah-v5 has no option 'reset_noise'; did you mean 'reset_noise_scale'"
    ):
        ControlSettings(env="HalfCheetah-v5", options={"reset_noise": 0.1}).build()
    with pytest.raises(ConfigError, match=r"task\.options=.*HalfCheetah-v5 says"):
        ControlSettings(env="HalfCheetah-v5", options={"xml_file": "none.xml"}).build()


def test_an_option_that_is_given_counts_more_than_the_fixed_horizon() -> None:
    task = ControlSettings(env="Hopper-v5", horizon=80, options={"terminate_when_unhealthy": True}).build()
    assert (task.segment_steps, len(task.notes)) == (40, 1)  # 1.5 seconds are 188 steps
    envs = task.environments(1)
    envs.reset(np.random.default_rng(0))
    steps = [envs.step(np.ones((1, 3), np.float32)) for _ in range(80)]
    assert steps[-1].rewards[0] == 0.0  # it fell, and goes on where it fell
    assert steps[-1].truncated.all()


@pytest.mark.parametrize(("hide", "said"), [([3], "0 to 2"), ([0, 1, 2], "at least one of which has to be seen")])
def test_what_is_hidden_must_be_there_and_not_be_everything(hide: list[int], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        ControlSettings(env="Pendulum-v1", hide=tuple(hide)).build()
