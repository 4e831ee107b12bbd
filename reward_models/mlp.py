"""An ensemble of small networks over (observation, action): a reward for each step; a segment's score is their sum."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from typing import Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from prefrl.components import ConfigError, Settings
from prefrl.protocols import ControlTask, Task
from prefrl.seeding import draw_seed
from prefrl.types import Floats, Segment, State

ACTIVATIONS = {"tanh": torch.tanh, "relu": torch.relu, "silu": torch.nn.functional.silu}
CHUNK = 65_536
"""Steps scored at once outside a fit: bounds the memory."""


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

    def build(self, task: Task, rng: np.random.Generator) -> MLPReward:
        return MLPReward(self, _control(task), rng)


class MLPReward:
    """A `prefrl.protocols.StepRewardModel`: an ensemble of normalised members (Christiano et al. 2017, section 2.2.3).

    A segment's raw score is the sum of its steps' outputs times gain / segment_steps: a constant, so that scores add
    up over steps, while logits, and with them step sizes and error rates, do not depend on how long segments are. It
    sees observations and actions only: no time, no end of episode, no gold.
    """

    def __init__(self, settings: MLPSettings, task: ControlTask, rng: np.random.Generator) -> None:
        self._settings, self._scale_of_sums = settings, settings.gain / task.segment_steps
        sizes = (task.observation_size + task.action_size, *settings.hidden, 1)
        generator = torch.Generator().manual_seed(draw_seed(rng))
        pairs = list(pairwise(sizes))
        self._weights = [_uniform((settings.members, i, o), i, generator) for i, o in pairs]
        self._biases = [_uniform((settings.members, 1, o), i, generator) for i, o in pairs]
        self._activation = ACTIVATIONS[settings.activation]
        self._input_mean, self._input_std = torch.zeros(sizes[0]), torch.ones(sizes[0])
        self._shift, self._scale = torch.zeros(settings.members), torch.ones(settings.members)
        self._fitted = False

    @property
    def members(self) -> int:
        return self._settings.members

    @property
    def fitted(self) -> bool:
        return self._fitted

    def parameters(self) -> Iterable[torch.nn.Parameter]:
        return [*self._weights, *self._biases]

    def stack(self, candidates: Sequence[Segment]) -> Mapping[str, Tensor]:
        """inputs (N, T, O + A) and mask (N, T). Begins a fit: the inputs' mean and std are measured here, and stay."""
        stacked = _padded(candidates)
        self._rebase(stacked["inputs"][stacked["mask"].bool()])
        return stacked

    def scores(self, stacked: Mapping[str, Tensor]) -> Tensor:
        mask = stacked["mask"]
        outputs = self._outputs(stacked["inputs"].flatten(0, 1)).view(self.members, *mask.shape)
        return (outputs * mask).sum(2) * self._scale_of_sums

    @torch.no_grad()
    def settle(self, stacked: Mapping[str, Tensor]) -> None:
        outputs = self._outputs(stacked["inputs"][stacked["mask"].bool()])
        self._shift, self._scale = outputs.mean(1), outputs.std(1, correction=0).clamp(min=1e-6)
        self._fitted = True

    @torch.no_grad()
    def raw_member_scores(self, candidates: Sequence[Segment]) -> Floats:
        return (_sums(self._in_chunks(_steps(candidates)), candidates) * self._scale_of_sums).numpy()

    @torch.no_grad()
    def member_scores(self, candidates: Sequence[Segment]) -> Floats:
        return _sums(self._member_rewards(_steps(candidates)), candidates).numpy()

    def score(self, candidates: Sequence[Segment]) -> Floats:
        mean: Floats = self.member_scores(candidates).mean(0)
        return mean

    @torch.no_grad()
    def rewards(self, observations: Floats, actions: Floats) -> Floats:
        inputs = _inputs(observations, actions)
        return self._member_rewards(inputs.flatten(0, 1)).mean(0).view(inputs.shape[:2]).numpy()

    def state(self) -> State:
        parameters = {name: p.detach().clone() for name, p in self._named()}
        inputs = {"input_mean": self._input_mean, "input_std": self._input_std}
        return {**parameters, **inputs, "shift": self._shift, "scale": self._scale, "fitted": self._fitted}

    def load(self, state: State) -> None:
        """Raises ValueError where shapes differ."""
        with torch.no_grad():
            for name, parameter in self._named():
                if state[name].shape != parameter.shape:
                    found, expected = tuple(state[name].shape), tuple(parameter.shape)
                    raise ValueError(f"reward model: {name} has shape {found}, expected {expected}: other settings")
                parameter.copy_(state[name])
        self._input_mean, self._input_std = state["input_mean"].clone(), state["input_std"].clone()
        self._shift, self._scale = state["shift"].clone(), state["scale"].clone()
        self._fitted = bool(state["fitted"])

    def _named(self) -> list[tuple[str, torch.nn.Parameter]]:
        weights = [(f"weight_{i}", w) for i, w in enumerate(self._weights)]
        return weights + [(f"bias_{i}", b) for i, b in enumerate(self._biases)]

    def _outputs(self, inputs: Tensor) -> Tensor:
        """(B, O + A) -> (E, B): what the networks say, before shift and scale."""
        x = ((inputs - self._input_mean) / self._input_std).expand(self.members, -1, -1)
        for weight, bias in zip(self._weights[:-1], self._biases[:-1], strict=True):
            x = self._activation(torch.baddbmm(bias, x, weight))
        return torch.baddbmm(self._biases[-1], x, self._weights[-1])[:, :, 0]

    def _in_chunks(self, inputs: Tensor) -> Tensor:
        return torch.cat([self._outputs(chunk) for chunk in torch.split(inputs, CHUNK)], 1)

    def _member_rewards(self, inputs: Tensor) -> Tensor:
        return (self._in_chunks(inputs) - self._shift[:, None]) / self._scale[:, None]

    @torch.no_grad()
    def _rebase(self, inputs: Tensor) -> None:
        """Normalise by these inputs from now on; a fitted network's first layer makes up for it: it says the same."""
        mean, std = inputs.mean(0), inputs.std(0, correction=0)
        std = torch.where(std > 1e-6, std, 1.0)
        if self._fitted:
            weight = self._weights[0] / self._input_std[:, None]
            self._biases[0].add_(((mean - self._input_mean) @ weight)[:, None])
            self._weights[0].copy_(weight * std[:, None])
        self._input_mean, self._input_std = mean, std


def _padded(candidates: Sequence[Segment]) -> dict[str, Tensor]:
    length = max(len(c) for c in candidates)
    width = candidates[0].observations.shape[1] + candidates[0].actions.shape[1]
    inputs, mask = torch.zeros(len(candidates), length, width), torch.zeros(len(candidates), length)
    for i, candidate in enumerate(candidates):
        inputs[i, : len(candidate)] = _inputs(candidate.observations, candidate.actions)
        mask[i, : len(candidate)] = 1.0
    return {"inputs": inputs, "mask": mask}


def _steps(candidates: Sequence[Segment]) -> Tensor:
    """(B, O + A): the steps of all candidates, one after another."""
    return torch.cat([_inputs(c.observations, c.actions) for c in candidates])


def _sums(steps: Tensor, candidates: Sequence[Segment]) -> Tensor:
    """(E, B) values of the steps of N candidates -> (E, N) sums."""
    parts = torch.split(steps, [len(c) for c in candidates], 1)
    return torch.stack([part.sum(1) for part in parts], 1)


def _inputs(observations: Floats, actions: Floats) -> Tensor:
    return torch.cat([torch.from_numpy(np.asarray(x, np.float32)) for x in (observations, actions)], -1)


def _uniform(shape: tuple[int, ...], fan_in: int, generator: torch.Generator) -> torch.nn.Parameter:
    """torch.nn.Linear's default: uniform within 1 / sqrt(fan in)."""
    return torch.nn.Parameter((torch.rand(shape, generator=generator) * 2 - 1) / math.sqrt(fan_in))


def _control(task: Task) -> ControlTask:
    if task.kind != "control":
        raise ConfigError(f"reward kind 'mlp' scores control segments, but the task is of kind {task.kind!r}")
    return task  # type: ignore[return-value]
