"""An ensemble of small networks that scores pictures: a picture is a segment of one step.

Its pixels are what is observed, and its caption, one-hot, is what is done; so the networks, the normalisation of each
member and the ensemble are those of rewards for control (Christiano et al. 2017), and nothing is written twice. Left
out: pretrained encoders.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, cast

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from prefrl.components import Settings
from prefrl.kinds import kind_of
from prefrl.policies.perceptron import Activation
from prefrl.protocols import ControlTask, PictureTask, Task, caption_numbers, pictures
from prefrl.reward_models.cnn import CNN, CNNSettings
from prefrl.reward_models.ensemble import Ensemble
from prefrl.reward_models.mlp import MLP
from prefrl.reward_models.steps import Network, StepReward
from prefrl.seeding import generator
from prefrl.types import Floats, Picture, Segment, State

BRIGHTEST = 255.0


class PictureRewardSettings(Settings):
    """An ensemble of small networks over (pixels, caption), evaluated in one batched pass."""

    kind: Literal["pictures"] = "pictures"
    network: Literal["mlp", "cnn"] = "mlp"
    """Perceptrons over all pixels, or convolutions of 3 x 3 at every second one with perceptrons behind them."""
    members: int = Field(5, ge=1)
    """E: how many networks, each from its own random start."""
    channels: tuple[int, ...] = Field((16, 32), min_length=1)
    """Filters of the convolutions."""
    hidden: tuple[int, ...] = (64, 64)
    """Widths of the hidden layers of the perceptrons."""
    activation: Activation = "relu"
    """Between the layers of perceptrons over all pixels; convolutions have ReLU."""
    gain: float = Field(10.0, gt=0)
    """A picture's raw score is this times the mean of its networks' outputs."""
    combine: Ensemble = Ensemble()
    """How the members become the one reward that learners optimise."""

    def build(self, task: Task, rng: np.random.Generator) -> PictureReward:
        found = pictures(task, f"reward kind {self.kind!r} scores pictures")
        step = _OneStep(found.name, math.prod(found.shape), len(found.captions))
        scores = StepReward(self._network(found, rng), cast(ControlTask, step), self.gain, self.combine, _measure)
        return PictureReward(scores, found)

    def _network(self, task: PictureTask, rng: np.random.Generator) -> Network:
        captions = len(task.captions)
        if self.network == "mlp":
            sizes = (math.prod(task.shape) + captions, *self.hidden, 1)
            return MLP(self.members, sizes, self.activation, generator(rng))
        height, width, *colours = task.shape
        image = (height, width, *(colours or [1]))
        like = CNNSettings(image=image, members=self.members, channels=self.channels, hidden=self.hidden)
        return CNN(like, captions, generator(rng))


@dataclass(frozen=True)
class _OneStep:
    """What a reward of steps asks of its task."""

    name: str
    observation_size: int
    action_size: int
    segment_steps: int = 1


def _measure(steps: Tensor) -> tuple[Tensor, Tensor]:
    """One mean and std for all inputs: pixels from 0 to 1 come in as -1 to 1, as pixels that never differ do too."""
    return torch.full_like(steps[0], 0.5), torch.full_like(steps[0], 0.5)


@dataclass(frozen=True, eq=False)
class PictureReward:
    """A `prefrl.protocols.RewardModel` of pictures, by a reward of steps.

    Raises `ValueError` for a picture of another size, or with a caption that the task does not have.
    """

    steps: StepReward
    task: PictureTask

    @property
    def members(self) -> int:
        return self.steps.members

    @property
    def fitted(self) -> bool:
        return self.steps.fitted

    def parameters(self) -> Iterable[torch.nn.Parameter]:
        return self.steps.parameters()

    def to(self, device: torch.device) -> None:
        self.steps.to(device)

    def stack(self, candidates: Sequence[Picture]) -> Mapping[str, Tensor]:
        return self.steps.stack(self._segments(candidates))

    def scores(self, stacked: Mapping[str, Tensor]) -> Tensor:
        return self.steps.scores(stacked)

    def settle(self, stacked: Mapping[str, Tensor], loss: Callable[[Tensor], Tensor]) -> Tensor:
        return self.steps.settle(stacked, loss)

    def calibrate(self, temperature: float) -> None:
        self.steps.calibrate(temperature)

    def raw_member_scores(self, candidates: Sequence[Picture]) -> Floats:
        return self.steps.raw_member_scores(self._segments(candidates))

    def member_scores(self, candidates: Sequence[Picture]) -> Floats:
        return self.steps.member_scores(self._segments(candidates))

    def score(self, candidates: Sequence[Picture]) -> Floats:
        return self.steps.score(self._segments(candidates))

    def features(self, candidates: Sequence[Picture]) -> Floats:
        """(N, D): pixels from 0 to 1; neighbours look alike."""
        observations = [one.observations[0] for one in self._segments(candidates)]
        return np.stack(observations)

    def state(self) -> State:
        return self.steps.state()

    def load(self, state: State) -> None:
        self.steps.load(state)

    def _segments(self, candidates: Sequence[Picture]) -> list[Segment]:
        for one in candidates:
            if misfit := kind_of(one).misfit(one, self.task):
                raise ValueError(f"picture {one.id[:12]} {misfit}")
        numbers = caption_numbers(self.task, (one.caption for one in candidates))
        observed = (one.pixels.reshape(1, -1) / np.float32(BRIGHTEST) for one in candidates)
        done = np.eye(len(self.task.captions), dtype=np.float32)[numbers, None]  # (N, 1, A)
        return [Segment(o, a, "", 0) for o, a in zip(observed, done, strict=True)]
