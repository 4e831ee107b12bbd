"""Contrastive preference learning: the policy is fitted on judged segments, without a reward and without a simulator.

Variant: Hejna et al. 2024, equation 5 with the conservative bias of equation 6, on all pairs that the judgements imply,
after cloning all segments as in the paper. As in its code log pi is minus a squared distance: densities are taken
against the mode's, and the noise is fixed. Soft preferences and ties are soft targets; the pairs of one ranking share
its weight. Left out: dropout, and a cloning term beside the loss.
"""

from __future__ import annotations

from functools import partial
from typing import Literal, Self

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from prefrl.fit.pairs import Batch
from prefrl.improve.objectives import cpl_loss
from prefrl.improve.offline import Material, Offline, OfflineSettings, Recordings, gaussian, minibatches
from prefrl.improve.pairs import means, measured, some
from prefrl.protocols import RewardModel, Task, control
from prefrl.types import Integers, Metrics, Segment


class CPLSettings(OfflineSettings):
    """Contrastive preference learning on all judgements of segments so far, from a clone of the segments."""

    kind: Literal["cpl"] = "cpl"
    alpha: float = Field(0.1, gt=0)
    """What log pi counts in a segment's score: the temperature of the policy that people have in mind."""
    bias: float = Field(0.5, gt=0, le=1)
    """What the score of the worse segment counts: below 1 the policy is kept near what was recorded."""
    discount: float = Field(1.0, gt=0, le=1)
    """What log pi a step later counts for."""
    epochs: int = Field(100, ge=0)
    """Passes over all pairs in a round; with 0 the policy is a clone and no more."""
    minibatch: int = Field(64, ge=1)
    """Pairs in a gradient step."""

    def shrunk(self) -> Self:
        return super().shrunk().model_copy(update={"epochs": min(self.epochs, 1)})

    def work(self) -> float:
        return float(1 + self.epochs + self.cloning_epochs)

    def build(self, task: Task, rng: np.random.Generator) -> Offline:
        found = control(task, f"learner kind {self.kind!r} learns from segments of control")
        return Offline(self, found, partial(improve, self), gaussian(self, found, rng), self.discount, self.alpha)

    def formula(self) -> str:
        later = "" if self.discount == 1 else f"{self.discount:g}^t "
        return (
            f"maximise  mean[ log s(h(better) - {self.bias:g} h(worse)) ],  s(x) = 1 / (1 + exp(-x))\n"
            f"h(segment) = {self.alpha:g} sum_t {later}[log pi(a_t|s_t) - log pi(mode|s_t)]\n"
            f"from a clone: {self.cloning_epochs} epochs of maximum likelihood over all segments"
        )


def improve(
    settings: CPLSettings,
    learner: Offline,
    material: Material,
    reward: RewardModel[Segment],
    rng: np.random.Generator,
) -> Metrics:
    """Passes over all pairs. Metrics: means over the last pass of loss, accuracy (share whose better segment has the
    higher score; a tie is half), margin (by how much) and grad_norm; and pairs.

    Raises ValueError without a judged pair.
    """
    if not settings.epochs:
        return {}
    pairs = some(material.pairs, settings.kind)
    recordings = Recordings.of(pairs.candidates, learner.policy)
    seen = [
        _step(settings, learner, recordings, pairs, at)
        for at in minibatches(len(pairs), settings.epochs, settings.minibatch, rng)
    ]
    return means(seen[-(len(seen) // settings.epochs) :]) | {"pairs": float(len(pairs))}


def _step(
    settings: CPLSettings, learner: Offline, recordings: Recordings, pairs: Batch[Segment], at: Integers
) -> Metrics:
    """One gradient step on some pairs; the two segments of a pair stand side by side."""
    rows, whose, before = recordings.steps(pairs.edges[at].flatten())

    def loss_of(logp: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
        arrays = (pairs.weight[at] / pairs.weight[at].sum(), pairs.preference[at])
        share, preference = (torch.from_numpy(x).to(logp.device) for x in arrays)
        scores = settings.alpha * learner.scores(logp, whose, before).view(-1, 2)
        loss = (share * cpl_loss(scores[:, 0], scores[:, 1], preference, settings.bias)).sum()
        return loss, measured((scores[:, 0] - scores[:, 1]).detach(), preference, share)

    return learner.descend(recordings.decisions, rows, loss_of)
