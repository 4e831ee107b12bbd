"""What a network is to `prefrl.reward_models.steps`: E members that say something of each step, in one pass."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Protocol, TypeAlias

import numpy as np
import torch
from torch import Tensor

from prefrl.components import ConfigError
from prefrl.protocols import ControlTask
from prefrl.types import Floats

CACHED = 4096
"""Steps of all members that go through a network at once, where it makes about a hundred numbers of each."""

Measure: TypeAlias = Callable[[Tensor], tuple[Tensor, Tensor]]
"""(S, I) steps -> the mean (I,) and std (I,) that inputs are normalised by."""
Solve: TypeAlias = Callable[[Tensor, Tensor, Callable[[Tensor], Tensor]], None]
"""Fit a network without descent: normalised inputs (N, T, I), what a step counts in a score (N, T), the fit's loss."""

Describe: TypeAlias = Callable[[Floats, Floats], Floats]
"""(S, O) observations and (S, A) actions -> (S, d) hand-made features, a network's inputs in their place."""


class Network(Protocol):
    """E members evaluated in one pass."""

    @property
    def members(self) -> int: ...

    @property
    def memory(self) -> int:
        """How many steps an output looks at, its own included."""

    @property
    def most(self) -> int:
        """How many steps go through at once, at most: what is made of them stays in cache."""

    def named(self) -> Mapping[str, Tensor]:
        """Everything that is saved. What is a parameter is fitted by descent."""

    def outputs(self, inputs: Tensor) -> Tensor:
        """(B, T, I) normalised steps, T <= memory (or any where memory is 1), or (E, B, T, I), each member's own.

        Returns (E, B, T). No step sees a later one.
        """

    @property
    def first(self) -> tuple[Tensor, Tensor] | None:
        """Weight (E, I, H) and bias (E, 1, H) of the one linear layer that the inputs meet, where there is one."""


def input_width(task: ControlTask, describe: Describe | None) -> int:
    """I: how many numbers a network sees of a step. Raises `ConfigError` for features that are not of steps."""
    if describe is None:
        return task.observation_size + task.action_size
    observation, action = (np.zeros((1, size), np.float32) for size in (task.observation_size, task.action_size))
    found = np.asarray(describe(observation, action))
    if found.ndim != 2 or len(found) != 1 or not found.size or found.dtype.kind not in "fiub":
        raise ConfigError(
            f"hand-made features: expected (S, d) real numbers for {observation.shape} observations and {action.shape} "
            f"actions, got {found.dtype} of shape {found.shape}"
        )
    return int(found.shape[1])


def uniform(shape: tuple[int, ...], fan_in: int, generator: torch.Generator) -> torch.nn.Parameter:
    """torch.nn.Linear's default start: uniform within 1 / sqrt(fan in)."""
    return torch.nn.Parameter((torch.rand(shape, generator=generator) * 2 - 1) / math.sqrt(fan_in))
