"""An ensemble of small networks over (observation, action): a reward for each step.

Variant: the networks of Christiano et al. 2017 (appendix A.1: two layers of 64 units), by default with tanh in place of
leaky ReLU. The output is linear, without the tanh that PEBBLE (Lee et al. 2021) puts on it.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from prefrl.components import Settings
from prefrl.policies.perceptron import Activation, perceptrons
from prefrl.protocols import Task, control
from prefrl.reward_models.ensemble import Ensemble
from prefrl.reward_models.steps import StepReward, described, input_width, uniform
from prefrl.seeding import generator


class MLPSettings(Settings):
    """An ensemble of multi-layer perceptrons over (observation, action), evaluated by one call."""

    kind: Literal["mlp"] = "mlp"
    members: int = Field(3, ge=1)
    """E: how many networks, each from its own random start."""
    hidden: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers."""
    activation: Activation = "tanh"
    """Between the layers."""
    features: str = "inputs"
    """What it sees of a step: observation and action (`inputs`); the observation alone (`observations`), where how
    somebody acts gives away who it is; or hand-made features, by name in the entry-point group `prefrl.features`."""
    gain: float = Field(10.0, gt=0)
    """A segment's raw score is this times the mean of its networks' outputs, when it has the task's usual length."""
    combine: Ensemble = Ensemble()
    """How the members become the one reward that learners optimise."""

    def build(self, task: Task, rng: np.random.Generator) -> StepReward:
        found = control(task, f"reward kind {self.kind!r} scores control segments")
        describe = described(self.features)
        sizes = (input_width(found, describe), *self.hidden, 1)
        network = MLP(self.members, sizes, self.activation, generator(rng))
        return StepReward(network, found, self.gain, self.combine, describe=describe)


class MLP:
    """A `Network`: E perceptrons with `sizes` (I, ..., 1) units, their weights stacked."""

    memory, most = 1, 1_000_000  # it divides them itself, by its widths

    def __init__(self, members: int, sizes: tuple[int, ...], activation: Activation, order: torch.Generator) -> None:
        pairs = list(pairwise(sizes))
        self.members, self._activation = members, activation
        self.weights = [uniform((members, i, o), i, order) for i, o in pairs]
        self.biases = [uniform((members, 1, o), i, order) for i, o in pairs]

    def named(self) -> Mapping[str, Tensor]:
        weights = {f"weight_{i}": w for i, w in enumerate(self.weights)}
        return weights | {f"bias_{i}": b for i, b in enumerate(self.biases)}

    @property
    def first(self) -> tuple[Tensor, Tensor]:
        return self.weights[0], self.biases[0]

    def outputs(self, inputs: Tensor) -> Tensor:
        return self.of_steps(inputs.flatten(-3, -2)).view(self.members, *inputs.shape[-3:-1])

    def of_steps(self, x: Tensor) -> Tensor:
        """(S, I), or (E, S, I), each member's own -> (E, S)."""
        return perceptrons(x, self.weights, self.biases, self._activation)
