"""An ensemble of convolutional networks over (picture, action): a reward for each step.

Variant: the pixel reward of Christiano et al. 2017 (appendix A.2), smaller by default: 3 x 3 filters at every second
pixel with ReLU, then perceptrons that also get the action. Frames are stacked by the environment, if at all. Left out:
batch normalisation and dropout.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import pairwise
from typing import Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from torch.nn.functional import conv2d

from prefrl.components import ConfigError, Settings
from prefrl.protocols import ControlTask, Task, control
from prefrl.reward_models.ensemble import Ensemble
from prefrl.reward_models.mlp import MLP
from prefrl.reward_models.steps import CACHED, StepReward, described, each_input, input_width, uniform
from prefrl.seeding import generator


class CNNSettings(Settings):
    """An ensemble of convolutional networks over pictures, evaluated in one batched pass (grouped convolutions)."""

    kind: Literal["cnn"] = "cnn"
    image: tuple[int, int, int]
    """Height, width and channels of the pictures that observations are; channels come last."""
    members: int = Field(3, ge=1)
    """E: how many networks, each from its own random start."""
    channels: tuple[int, ...] = Field((16, 32), min_length=1)
    """Filters of the convolutions: 3 x 3, every second pixel, with ReLU."""
    hidden: tuple[int, ...] = (64,)
    """Widths of the layers behind them, which also get the action."""
    features: Literal["inputs", "observations"] = "inputs"
    """What it sees of a step: picture and action, or the picture alone (`observations`)."""
    brightest: float | None = Field(255.0, gt=0)
    """Pictures are divided by this; left empty, their mean and std over all pixels are measured in the first fit."""
    gain: float = Field(10.0, gt=0)
    """A segment's raw score is this times the mean of its networks' outputs, when it has the task's usual length."""
    combine: Ensemble = Ensemble()
    """How the members become the one reward that learners optimise."""

    def build(self, task: Task, rng: np.random.Generator) -> StepReward:
        """Raises `ConfigError` where the task's observations cannot be such pictures."""
        found = control(task, f"reward kind {self.kind!r} scores control segments")
        _check(self.image, found)
        describe = described(self.features)
        network = CNN(self, input_width(found, describe) - found.observation_size, generator(rng))
        return StepReward(network, found, self.gain, self.combine, self.measure, describe=describe)

    def measure(self, steps: Tensor) -> tuple[Tensor, Tensor]:
        """One mean and std for all pixels; the actions each have their own."""
        pixels = math.prod(self.image)
        action_mean, action_std = each_input(steps[:, pixels:])
        if self.brightest is not None:
            mean, std = steps.new_tensor(0.0), steps.new_tensor(self.brightest)
        else:
            std, mean = torch.std_mean(steps[:, :pixels], correction=0)
        std = std if std > 1e-6 else steps.new_tensor(1.0)  # pictures of one colour
        return torch.cat([mean.expand(pixels), action_mean]), torch.cat([std.expand(pixels), action_std])


class CNN:
    """A `Network`: E stacks of convolutions side by side as groups of one, and perceptrons on what they find."""

    memory, first = 1, None

    def __init__(self, settings: CNNSettings, actions: int, order: torch.Generator) -> None:
        self.members, self.most, self._image = settings.members, CACHED // settings.members, settings.image
        height, width, channels = settings.image
        pairs = list(pairwise((channels, *settings.channels)))
        self._filters = [uniform((self.members * o, i, 3, 3), 9 * i, order) for i, o in pairs]
        self._biases = [uniform((self.members * o,), 9 * i, order) for i, o in pairs]
        halved = (-(-size // 2 ** len(pairs)) for size in (height, width))
        found = math.prod(halved) * settings.channels[-1]
        self._head = MLP(self.members, (found + actions, *settings.hidden, 1), "relu", order)

    def named(self) -> Mapping[str, Tensor]:
        filters = {f"filter_{i}": w for i, w in enumerate(self._filters)}
        return {**filters, **{f"filter_bias_{i}": b for i, b in enumerate(self._biases)}, **self._head.named()}

    def outputs(self, inputs: Tensor) -> Tensor:
        pixels = math.prod(self._image)
        steps = inputs.view(-1, *inputs.shape[-3:]).flatten(1, 2)  # (1, S, I), or (E, S, I) of each member's own
        pictures = steps[:, :, :pixels].reshape(*steps.shape[:2], *self._image)
        # (1 or E, S, height, width, C) -> (S, C or E C, height, width), as convolutions have it.
        x = pictures.permute(1, 0, 4, 2, 3).flatten(1, 2)
        for i, (weight, bias) in enumerate(zip(self._filters, self._biases, strict=True)):
            # Where all see one picture, the first layer is one convolution with the filters of all.
            x = torch.relu_(conv2d(x, weight, bias, stride=2, padding=1, groups=self.members if i else len(steps)))
        seen = x.reshape(len(x), self.members, -1).transpose(0, 1)  # (S, E filters, h, w) -> (E, S, filters h w)
        both = torch.cat([seen, steps[:, :, pixels:].expand(self.members, -1, -1)], 2)
        return self._head.of_steps(both).view(self.members, *inputs.shape[-3:-1])


def _check(image: tuple[int, int, int], task: ControlTask) -> None:
    if min(image) < 1 or math.prod(image) != task.observation_size:
        raise ConfigError(
            f"reward.image: pictures of {' x '.join(map(str, image))} (height, width, channels) have "
            f"{math.prod(image)} numbers, but the observations of {task.name} have {task.observation_size}; give the "
            "shape of the environment's own pictures"
        )
