"""Gymnasium's spaces as a control learner reads them: a row of numbers in, one choice or a row of numbers out."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, TypeAlias

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Space, Tuple, flatten_space
from gymnasium.wrappers import FlattenObservation, TransformAction

from prefrl.components import ConfigError

Make: TypeAlias = Callable[[], gymnasium.Env[Any, Any]]

MOST = 1024
"""Combinations of several discrete choices, which become one choice among them."""


def adapted(make: Make, probe: gymnasium.Env[Any, Any]) -> Make:
    """Environments whose observations are a row of numbers, and whose actions one choice or a row of numbers.

    Observations are taken apart as gymnasium does: pictures row by row, choices one-hot, the parts of a dictionary one
    after another by name. Raises `ConfigError` for spaces that cannot be had like that.
    """
    if not _is_row(probe.observation_space):
        _check_observations(probe.observation_space)
        make = partial(_flattened, make)
    if not isinstance(probe.action_space, Discrete) and not _is_row(probe.action_space):
        _check_actions(probe.action_space)
        make = partial(_with_plain_actions, make)
    return make


def _is_row(space: Space[Any]) -> bool:
    return isinstance(space, Box) and len(space.shape) == 1 and np.issubdtype(space.dtype, np.floating)


def _flattened(make: Make) -> gymnasium.Env[Any, Any]:
    return FlattenObservation(make())


def _check_observations(space: Space[Any]) -> None:
    parts = list(space.spaces.values()) if isinstance(space, Dict) else space.spaces if isinstance(space, Tuple) else ()
    for part in parts:
        _check_observations(part)
    known = isinstance(space, Box | Discrete | MultiDiscrete | MultiBinary | Dict | Tuple)
    if not known or not isinstance(flatten_space(space), Box):
        raise ConfigError(
            "task.env: observations must be numbers or choices of a fixed size (Box, Discrete, MultiDiscrete, "
            f"MultiBinary, and Dict or Tuple of these), got {space}; wrap the environment and register that"
        )


def _check_actions(space: Space[Any]) -> None:
    number = _combinations(space)
    numbers = isinstance(space, Box) and np.issubdtype(space.dtype, np.floating)
    if not numbers and not 0 < number <= MOST:
        raise ConfigError(
            "task.env: actions must be a Box of floats, Discrete, or a MultiDiscrete or MultiBinary of at most "
            f"{MOST} combinations, got {space}"
        )


def _combinations(space: Space[Any]) -> int:
    """Of several choices; 0 for what are none."""
    choices = choices_of(space)
    return math.prod(choices) if choices else 0


def choices_of(space: Space[Any]) -> tuple[int, ...]:
    """How many values each of several choices has; none for another space."""
    if isinstance(space, MultiDiscrete):
        return tuple(int(n) for n in space.nvec.ravel())
    return (2,) * math.prod(space.shape) if isinstance(space, MultiBinary) else ()


def _with_plain_actions(make: Make) -> gymnasium.Env[Any, Any]:
    env = make()
    space = env.action_space
    if isinstance(space, Box):
        flat: Space[Any] = flatten_space(space)
        return TransformAction(env, lambda action: action.reshape(space.shape), flat)
    choices, shape = choices_of(space), space.shape
    start = space.start if isinstance(space, MultiDiscrete) else 0

    def taken_apart(choice: Any) -> np.ndarray:
        """One choice among all combinations -> a choice of each."""
        each = np.array(np.unravel_index(int(choice), choices)).reshape(shape)
        found: np.ndarray = (each + start).astype(space.dtype)
        return found

    return TransformAction(env, taken_apart, Discrete(_combinations(space)))


__all__ = ["MOST", "Make", "adapted", "choices_of"]
