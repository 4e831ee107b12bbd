"""An ensemble of small networks over (observation, action): a reward for each step."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from prefrl.components import Settings
from prefrl.protocols import Task
from prefrl.reward_models.ensemble import Ensemble
from prefrl.reward_models.steps import StepReward, control, uniform
from prefrl.seeding import draw_seed

ACTIVATIONS = {"tanh": torch.tanh_, "relu": torch.relu_, "silu": torch.nn.functional.silu}
"""In place where the derivative can be had from the result: a fit's time goes into memory as much as into numbers."""


class MLPSettings(Settings):
    """An ensemble of multi-layer perceptrons over (observation, action), evaluated in one batched pass."""

    kind: Literal["mlp"] = "mlp"
    members: int = Field(3, ge=1)
    """E: how many networks, each from its own random start."""
    hidden: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers."""
    activation: Literal["tanh", "relu", "silu"] = "tanh"
    """Between the layers."""
    gain: float = Field(10.0, gt=0)
    """A segment's raw score is this times the mean of its networks' outputs, when it has the task's usual length."""
    combine: Ensemble = Ensemble()
    """How the members become the one reward that learners optimise."""

    def build(self, task: Task, rng: np.random.Generator) -> StepReward:
        found = control(task, self.kind)
        generator = torch.Generator().manual_seed(draw_seed(rng))
        sizes = (found.observation_size + found.action_size, *self.hidden, 1)
        return StepReward(MLP(self.members, sizes, self.activation, generator), found, self.gain, self.combine)


class MLP:
    """A `Network`: E perceptrons with `sizes` (I, ..., 1) units, their weights stacked."""

    memory = 1

    def __init__(self, members: int, sizes: tuple[int, ...], activation: str, generator: torch.Generator) -> None:
        pairs = list(pairwise(sizes))
        self.members, self._activation = members, ACTIVATIONS[activation]
        self.weights = [uniform((members, i, o), i, generator) for i, o in pairs]
        self.biases = [uniform((members, 1, o), i, generator) for i, o in pairs]

    def named(self) -> Mapping[str, Tensor]:
        weights = {f"weight_{i}": w for i, w in enumerate(self.weights)}
        return weights | {f"bias_{i}": b for i, b in enumerate(self.biases)}

    @property
    def first(self) -> tuple[Tensor, Tensor]:
        return self.weights[0], self.biases[0]

    def outputs(self, inputs: Tensor) -> Tensor:
        x = inputs.flatten(-3, -2).expand(self.members, -1, -1)
        return self.of_members(x).view(self.members, *inputs.shape[-3:-1])

    def of_members(self, x: Tensor) -> Tensor:
        """(E, S, I) -> (E, S): each member with inputs of its own."""
        for weight, bias in zip(self.weights[:-1], self.biases[:-1], strict=True):
            x = self._activation(torch.baddbmm(bias, x, weight))
        return torch.baddbmm(self.biases[-1], x, self.weights[-1])[:, :, 0]
