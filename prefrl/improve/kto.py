"""Kahneman-Tversky optimisation for text: each response by itself is good or bad, against a reference point.

Variant: the loss of Ethayarajh et al. 2024, equation 8, on the pairs that the judgements imply, taken apart: the better
response is desirable and the worse one is not. The reference point is estimated as in the paper, from each prompt of
the minibatch with the responses to the next one. What differs: a soft preference p counts |2p - 1| of a sure one, a tie
nothing, and rows whose neighbour has the same prompt are left out of the reference point. Left out: data that is not in
pairs.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Literal

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor

from prefrl.improve.direct import Direct, HeldSettings, Pairs, step
from prefrl.improve.objectives import kto_loss
from prefrl.improve.pairs import judged, means
from prefrl.improve.writer import Writer
from prefrl.policies.language import LanguagePolicy
from prefrl.policies.logprobs import in_all_rows
from prefrl.policies.pretrained import context_of
from prefrl.policies.responses import Responses
from prefrl.protocols import RewardModel, Store, Task, text
from prefrl.types import Integers, Metrics, Response


class KTOSettings(HeldSettings):
    """Kahneman-Tversky optimisation on all judgements so far, held near the starting policy."""

    kind: Literal["kto"] = "kto"
    desirable: float = Field(1.0, ge=0)
    """Weight of the better responses."""
    undesirable: float = Field(1.0, ge=0)
    """Weight of the worse ones."""
    epochs: int = Field(1, ge=1)
    """Passes over all pairs in a round."""
    minibatch: int = Field(16, ge=2)
    """Pairs in a gradient step; the reference point is estimated on them."""

    @model_validator(mode="after")
    def _teaches(self) -> KTOSettings:
        if self.desirable == self.undesirable == 0:
            raise ValueError("desirable and undesirable are both 0, and nothing is learned: raise one of them")
        return self

    def shrunk(self) -> KTOSettings:
        return self.model_copy(update={"epochs": 1, "evaluation_prompts": 8})

    def build(self, task: Task, rng: np.random.Generator) -> Direct:
        return Direct(self, text(task, f"learner kind {self.kind!r} writes text"), partial(improve, self), rng)

    def formula(self) -> str:
        return (
            f"maximise  mean[ {self.desirable:g} s({self.beta:g} (g(better) - z)) + "
            f"{self.undesirable:g} s({self.beta:g} (z - g(worse))) ] / 2,  s(h) = 1 / (1 + exp(-h))\n"
            "g(y) = log pi(y) - log ref(y),  z = max(0, mean g of each prompt with the next one's responses)"
        )


def improve(
    settings: KTOSettings,
    writer: Writer,
    reward: RewardModel[Response],
    store: Store[Response],
    rng: np.random.Generator,
) -> Metrics:
    """Passes over all judged pairs that are no ties. Metrics: means over steps of those of `prefrl.improve.direct.step`
    and of the reference point (reference_point, nats per response), and pairs.

    Raises ValueError without a judged pair.
    """
    data = judged(store, settings.kind)
    data = data.subset(data.preference != 0.5)
    if not len(data):
        raise ValueError("kto learns nothing from ties, and all judged pairs are: ask for more labels")
    pairs, seen = Pairs.of(data, writer.policy), []
    for at in writer.paced(pairs.minibatches(settings.epochs, settings.minibatch, rng)):
        point = reference_point(writer.policy, pairs, at)
        measured = step(writer, settings, pairs, at, partial(_loss, settings, point))
        seen.append(measured | {"reference_point": float(point)})
    return means(seen) | {"pairs": float(len(pairs))}


def reference_point(policy: LanguagePolicy, pairs: Pairs, at: Integers) -> Tensor:
    """The mean gain, at least 0, of responses of a minibatch as answers to the prompts of its next pair: an estimate of
    KL(pi, ref). 0 where all prompts are the same, or none of these fits into the model's context."""
    rows = pairs.rows.rows(torch.from_numpy(pairs.edges[at].flatten()).to(policy.device))
    others, context = _shifted(rows), context_of(policy.model)
    # A response need not fit behind another prompt.
    room = [context is None or length <= context for length in others.lengths().tolist()]
    apart = [i for i in range(len(rows)) if room[i] and others.prompt_tokens[i] != rows.prompt_tokens[i]]
    if not apart:
        return pairs.start.new_zeros(())
    # All rows of the minibatch, whichever rank has them: the point is the same on any number of ranks.
    others = others.rows(torch.tensor(apart, device=policy.device))
    own = in_all_rows(lambda some: policy.log_prob(some)[0], others, policy.part, policy.keeping.running(policy.model))
    return (own - policy.start_logp(others)).sum(1).mean().clamp(min=0)


def _shifted(rows: Responses) -> Responses:
    """The same responses, each pair of them to the prompts of the next pair."""
    prompts, tokens = ((*x[2:], *x[:2]) for x in (rows.prompts, rows.prompt_tokens))
    return replace(rows, prompts=tuple(prompts), prompt_tokens=tuple(tokens))


def _loss(settings: KTOSettings, point: Tensor, gains: Tensor, preference: Tensor) -> Tensor:
    """(m,) of pairs, from gains (m, 2): the mean over both responses."""
    sure = (2 * preference - 1)[:, None]  # above 0 where the first is better
    desirable = torch.cat([sure, -sure], 1) > 0  # (m, 2)
    losses = kto_loss(gains, desirable, point, settings.beta)
    weights = torch.where(desirable, settings.desirable, settings.undesirable)
    return (sure.abs() * weights * losses).mean(1)
