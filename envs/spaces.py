"""Gymnasium's spaces as a control learner reads them: a row of numbers in, one choice or a row of numbers out."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, TypeAlias

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Space, Tuple, flatten, flatten_space
from gymnasium.wrappers import FlattenObservation, TransformAction

from prefrl.components import ConfigError
from prefrl.policies.loaded import plain_rows
from prefrl.types import Floats

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
    number = combinations(space)
    numbers = isinstance(space, Box) and np.issubdtype(space.dtype, np.floating)
    if not numbers and not 0 < number <= MOST:
        raise ConfigError(
            "task.env: actions must be a Box of floats, Discrete, or a MultiDiscrete or MultiBinary of at most "
            f"{MOST} combinations, got {space}"
        )


def combinations(space: Space[Any]) -> int:
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

    def taken_apart(choice: Any) -> np.ndarray:
        """One choice among all combinations -> a choice of each."""
        found: np.ndarray = _each_choice(space, np.array([choice]))[0]
        return found

    return TransformAction(env, taken_apart, Discrete(combinations(space)))


def _each_choice(space: Space[Any], numbers: np.ndarray) -> np.ndarray:
    """(n,) numbers of combinations -> (n, ...) what is chosen of each, as a MultiDiscrete or MultiBinary has it."""
    each = np.stack(np.unravel_index(numbers, choices_of(space)), 1).reshape(len(numbers), *(space.shape or ()))
    start = space.start if isinstance(space, MultiDiscrete) else 0
    found: np.ndarray = (each + start).astype(space.dtype)
    return found


def numbers_of(space: Space[Any], actions: np.ndarray) -> np.ndarray:
    """The other way round: (n, ...) choices -> (n,) numbers of their combinations."""
    found: np.ndarray = np.ravel_multi_index(tuple(counted(space, actions).T), choices_of(space))
    return found


def counted(space: Space[Any], values: np.ndarray) -> np.ndarray:
    """(n, ...) values of several choices -> (n, k), counted from 0."""
    start = space.start.ravel() if isinstance(space, MultiDiscrete) else 0
    found: np.ndarray = np.asarray(values).reshape(len(values), -1).astype(np.int64) - start
    return found


@dataclass(frozen=True, eq=False)
class OwnSpaces:
    """An environment's own spaces, beside the row and the choice that `adapted` makes of them; implements
    `prefrl.protocols.Outside`."""

    observations: Space[Any]
    actions: Space[Any]
    hide: tuple[int, ...] = ()
    """Which numbers of the row a policy does not see."""
    stack: int = 1
    """How many rows it sees at once."""

    @property
    def changed(self) -> Sequence[str]:
        found, row = [], isinstance(self.observations, Box) and len(self.observations.shape) == 1
        if not row:
            found.append(f"observations are {self.observations}, and not a row of numbers")
        if isinstance(self.actions, Discrete):
            if self.actions.start:
                found.append(f"actions are {self.actions}, and not counted from 0")
        elif not _is_row(self.actions):
            found.append(f"actions are {self.actions}, and neither a row of numbers nor one choice")
        return found

    @property
    def shape(self) -> tuple[int, ...] | None:
        return self.observations.shape

    @property
    def shown(self) -> str:
        size = gymnasium.spaces.flatdim(self.observations)
        hidden = f"without numbers {list(self.hide)} of the {size}, 0 to {size - 1}" if self.hide else ""
        stacked = f"the last {self.stack} in one row, the oldest first" if self.stack > 1 else ""
        return ", ".join(part for part in (hidden, stacked) if part)

    def rows(self, observations: Any) -> tuple[Floats, bool]:
        # What came before one observation is known to whoever stacks them, and to nobody here.
        if self.stack > 1:
            return plain_rows(observations)
        if not _is_row(self.observations):
            each, one = _taken_apart(self.observations, observations)
            flat = np.stack([np.asarray(flatten(self.observations, x), np.float32) for x in each])
        else:
            flat, one = plain_rows(observations)
        size = gymnasium.spaces.flatdim(self.observations)
        # A row may lack what is hidden already.
        seen = np.setdiff1d(np.arange(size), self.hide)
        return (flat[:, seen] if self.hide and flat.ndim == 2 and flat.shape[1] == size else flat), one

    def taken(self, actions: Floats) -> np.ndarray:
        if isinstance(self.actions, Box):
            return actions.reshape(len(actions), *self.actions.shape).astype(self.actions.dtype, copy=False)
        numbers: np.ndarray = actions.argmax(1)
        if isinstance(self.actions, Discrete):
            return numbers + int(self.actions.start)
        return _each_choice(self.actions, numbers)


def _taken_apart(space: Space[Any], observations: Any) -> tuple[list[Any], bool]:
    """One observation or n of them, stacked part by part -> each, and whether it was one. Raises ValueError."""
    if isinstance(space, Dict | Tuple):
        names: list[Any] = list(space.spaces) if isinstance(space, Dict) else list(range(len(space.spaces)))
        try:
            given = [observations[name] for name in names]
        except (KeyError, IndexError, TypeError) as error:
            raise ValueError(f"observations must be those of {space}, one or n of them; got {observations}") from error
        parts = [_taken_apart(space.spaces[name], part) for name, part in zip(names, given, strict=True)]
        if len({(len(each), one) for each, one in parts}) != 1:
            raise ValueError(f"observations must be those of {space}, with as many of each part; got {observations}")
        rows = zip(*(each for each, _ in parts), strict=True)
        kind = tuple if isinstance(space, Tuple) else lambda row: dict(zip(names, row, strict=True))
        return [kind(row) for row in rows], parts[0][1]
    found, shape = np.asarray(observations), space.shape or ()
    one = found.shape == shape
    each = found[None] if one else found
    if each.shape[1:] != shape or not each.ndim or not len(each):
        raise ValueError(f"observations must be those of {space}, {shape} or (n, *{shape}), got {found.shape}")
    if not isinstance(space, Box):
        each = each.astype(space.dtype)
        for row in each:
            if not space.contains(row):
                raise ValueError(f"observations must be those of {space}, got {row}")
    return list(each), one


__all__ = ["MOST", "Make", "OwnSpaces", "adapted", "combinations", "counted", "choices_of", "numbers_of"]
