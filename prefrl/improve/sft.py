"""Supervised fine-tuning for text: what was shown, and what was judged best, is learned as if a person had written it.

Variant: the mean of -log pi over the tokens of a minibatch, as before the reward in Stiennon et al. 2020. What is
learned is each response of a demonstration, and each that a judgement puts above another and below none, once however
often it was judged. Left out: packing, a share of other texts.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from functools import partial
from typing import ClassVar, Literal

import numpy as np
import torch
from pydantic import Field

from prefrl.improve.direct import Direct, DirectSettings, nothing_shown
from prefrl.improve.gradient import Parts, descend, in_parts
from prefrl.improve.pairs import means, shuffled
from prefrl.improve.writer import Writer
from prefrl.judgements import good
from prefrl.policies.language import LanguagePolicy
from prefrl.policies.responses import Responses
from prefrl.protocols import RewardModel, Store, Task, text
from prefrl.types import Integers, Metrics, Response


class SFTSettings(DirectSettings):
    """Supervised steps on demonstrations and on the best responses of all judgements so far; nothing holds the policy
    near its start."""

    kind: Literal["sft"] = "sft"
    imitates: ClassVar[bool] = True
    epochs: int = Field(1, ge=1)
    """Passes over these responses in a round."""
    minibatch: int = Field(16, ge=1)
    """Responses in a gradient step."""

    def shrunk(self) -> SFTSettings:
        return self.model_copy(update={"epochs": 1, "evaluation_prompts": 8})

    def build(self, task: Task, rng: np.random.Generator) -> Direct:
        return Direct(self, text(task, f"learner kind {self.kind!r} writes text"), partial(improve, self), rng)

    def formula(self) -> str:
        return (
            "maximise  mean_t[ log pi(y_t) ]\n"
            "y: each response that was shown, or was judged better than another and worse than none"
        )


def improve(
    settings: SFTSettings,
    writer: Writer,
    reward: RewardModel[Response],
    store: Store[Response],
    rng: np.random.Generator,
) -> Metrics:
    """Passes over the best responses. Metrics: means over steps of loss (nats per token) and grad_norm, and responses.

    Raises ValueError where nothing was shown, and no judgement says which response is better.
    """
    chosen = best_responses(store)
    if not chosen:
        raise ValueError(nothing_shown(settings.kind))
    rows = Responses.of(chosen, writer.policy.task, writer.policy.device)
    lengths = rows.lengths()
    writer.policy.check_room(int(lengths.max()), chosen[int(lengths.argmax())].prompt, written=True)
    turns = [at for _ in range(settings.epochs) for at in shuffled(len(rows), settings.minibatch, rng)]
    return means(list(supervised(writer, settings, rows, writer.paced(turns)))) | {"responses": float(len(rows))}


def best_responses(store: Store[Response]) -> list[Response]:
    """Each response that was shown, and each that some judgement puts above another and below none, in order."""
    found: dict[str, Response] = {one.like.id: one.like for one in store.demonstrations()}
    for one in store.judged():
        told = good(one.judgement, len(one.query.candidates))
        found |= {c.id: c for c, is_good in zip(one.query.candidates, told, strict=True) if is_good}
    return list(found.values())


def supervised(
    writer: Writer, settings: DirectSettings, rows: Responses, minibatches: Iterable[Integers]
) -> Iterator[Metrics]:
    """A gradient step on each minibatch, up the log-probability of its tokens; what each step measured."""
    policy = writer.policy
    for at in minibatches:
        if len(at) >= policy.least_rows:  # else there are too few for all ranks
            parts = _parts(policy, settings, rows, at)
            yield descend(policy.parameters(), writer.optimizer, parts, settings.max_grad_norm)


def _parts(policy: LanguagePolicy, settings: DirectSettings, rows: Responses, at: Integers) -> Parts:
    tokens = rows.mask[torch.from_numpy(at).to(policy.device)].sum()  # the whole minibatch's: its mean is in parts
    for some in in_parts(at, settings.policy.chunk):
        yield -policy.log_prob(rows.rows(torch.from_numpy(some).to(policy.device)))[0].sum() / tokens, {}
