"""Direct preference optimisation for pictures: a denoiser is fitted on the judgements, without the reward model.

Variant: Diffusion-DPO (Wallace et al. 2024, equation 13): the chain behind a picture is not known, so its log-ratio is
the expectation over noise that is added to the picture; of each pair one level and one noise are drawn, the same for
both. What differs: levels have the weights of the likelihood, where the paper has a constant one, so that `beta` is in
nats of a chain as elsewhere. Soft preferences, ties and label smoothing are soft targets (cDPO).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from prefrl.components import Settings
from prefrl.fit.pairs import Batch
from prefrl.improve.gradient import Parts, descend, in_parts
from prefrl.improve.objectives import dpo_loss
from prefrl.improve.painter import Painter
from prefrl.improve.pairs import judged, means, measured, shuffled
from prefrl.policies.denoiser import DenoiserPolicy, DenoisingSettings
from prefrl.protocols import PictureTask, RewardModel, Store, Task, pictures
from prefrl.seeding import Device, generator
from prefrl.types import Evaluation, Integers, Metrics, Picture, State, Steps


class DiffusionDPOSettings(Settings):
    """Direct preference optimisation of a denoiser on all judgements so far, held near the starting one."""

    kind: Literal["diffusion_dpo"] = "diffusion_dpo"
    epochs: int = Field(30, ge=1)
    """Passes over all pairs in a round, each with other noise."""
    minibatch: int = Field(32, ge=1)
    """Pairs in a gradient step."""
    beta: float = Field(0.2, gt=0)
    """How near: the reward that is implied is beta x the log-ratio to the starting policy."""
    label_smoothing: float = Field(0.0, ge=0, lt=0.5)
    """The share of judgements that are taken to be wrong."""
    learning_rate: float = Field(1e-4, gt=0)
    """Adam's."""
    max_grad_norm: float = Field(1.0, gt=0)
    """A gradient that is longer is shortened to this."""
    evaluation_pictures: int = Field(256, ge=2)
    """About how many are drawn to evaluate on, as many of each caption."""
    policy: DenoisingSettings = DenoisingSettings()
    """How much goes through the denoiser at once."""
    device: Device = "auto"
    """Where the policy and the reward model compute: `auto` is the GPU where there is one."""

    def shrunk(self) -> DiffusionDPOSettings:
        return self.model_copy(update={"epochs": 1, "evaluation_pictures": 8})

    def with_evaluation_of(self, other: DiffusionDPOSettings) -> DiffusionDPOSettings:
        return self.model_copy(update={"evaluation_pictures": other.evaluation_pictures})

    @property
    def discount(self) -> float:
        """A picture is judged as a whole."""
        return 1.0

    def build(self, task: Task, rng: np.random.Generator) -> DiffusionDPO:
        return DiffusionDPO(self, pictures(task, f"learner kind {self.kind!r} draws pictures"))

    def formula(self) -> str:
        wrong = self.label_smoothing
        also = f" + {wrong:g} log s(-h)" if wrong else ""
        return (
            f"maximise  mean[ {1 - wrong:g} log s(h){also} ],  s(h) = 1 / (1 + exp(-h))\n"
            f"h = {self.beta:g} (g(better) - g(worse))\n"
            "g(x) = (T - 1) [KL(q || ref) - KL(q || pi)] of one step from a random level, q: of the noise put on x"
        )


@dataclass(frozen=True, eq=False)
class _Pairs:
    """Judged pairs, and the pictures that they are of, on the policy's device."""

    data: Batch[Picture]
    pixels: Tensor
    """(N, D) in [-1, 1]."""
    captions: Tensor
    """(N,)."""

    @classmethod
    def of(cls, data: Batch[Picture], policy: DenoiserPolicy) -> _Pairs:
        flat = np.stack([one.pixels.ravel() for one in data.candidates]).astype(np.float32) / 127.5 - 1
        return cls(
            data, torch.from_numpy(flat).to(policy.device), policy.numbers(one.caption for one in data.candidates)
        )


class DiffusionDPO:
    """A `prefrl.protocols.Learner` of pictures that reads judgements alone."""

    def __init__(self, settings: DiffusionDPOSettings, task: PictureTask) -> None:
        self._settings = settings
        self._painter = Painter(task, settings.policy, settings.learning_rate, settings.device)
        self.policy = self._painter.policy

    @property
    def steps(self) -> Steps:
        return self._painter.steps

    def sample(self, count: int, rng: np.random.Generator) -> list[Picture]:
        return self._painter.ask(count, rng)

    def improve(self, reward: RewardModel[Picture], store: Store[Picture], rng: np.random.Generator) -> Metrics:
        """Passes over all judged pairs. Metrics, means over steps: loss, accuracy (weighted share of pairs whose better
        picture gained more), margin (beta x nats by which it did), grad_norm; and pairs.

        Raises ValueError without a judged pair.
        """
        settings, noise = self._settings, generator(rng)
        pairs = _Pairs.of(judged(store, settings.kind), self.policy)
        turns = [at for _ in range(settings.epochs) for at in shuffled(len(pairs.data), settings.minibatch, rng)]
        steps = [
            descend(
                self.policy.parameters(),
                self._painter.optimizer,
                self._parts(pairs, at, noise),
                settings.max_grad_norm,
            )
            for at in turns
        ]
        return means(steps) | {"pairs": float(len(pairs.data))}

    def evaluate(self, reward: RewardModel[Picture], rng: np.random.Generator) -> Evaluation[Picture]:
        return self._painter.evaluate(self._settings.evaluation_pictures, reward, rng)

    def state(self) -> State:
        return self._painter.state()

    def load(self, state: State) -> None:
        """Raises ValueError where names or shapes differ."""
        self._painter.load(state)

    def _parts(self, pairs: _Pairs, at: Integers, noise: torch.Generator) -> Parts:
        """Both pictures of a pair go through the network in one pass, with one noise at one level."""
        settings, data, device = self._settings, pairs.data, self.policy.device
        # Of the whole minibatch, so that the numbers do not depend on the parts.
        added = torch.randn(len(at), pairs.pixels.shape[1], generator=noise)
        level = torch.randint(2, self.policy.model.steps + 1, (len(at),), generator=noise)
        for part in in_parts(np.arange(len(at)), max(1, settings.policy.chunk // 2)):
            some = at[part]
            # Shares of the whole minibatch: the parts add up to its mean.
            arrays = (data.weight[some] / data.weight[at].sum(), data.edges[some].ravel(), data.preference[some])
            share, flat, preference = (torch.from_numpy(x).to(device) for x in arrays)
            both = (x[part].to(device).repeat_interleave(2, 0) for x in (level, added))
            gains = self.policy.gains(pairs.pixels[flat], pairs.captions[flat], *both).view(-1, 2)
            margins = settings.beta * (gains[:, 0] - gains[:, 1])
            loss = dpo_loss(margins, preference, settings.label_smoothing)
            yield (loss * share).sum(), measured(margins.detach(), preference, share)
