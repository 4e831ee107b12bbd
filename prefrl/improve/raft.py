"""RAFT, or expert iteration: of several responses to each prompt the best is learned as if a person had written it.

Variant: Dong et al. 2023, with the best of each prompt's own K. The newest policy writes, and is improved from where it
is; a KL to the start may be taken off the score, as in the paper. What differs: many small batches, one optimiser
throughout. Left out: a temperature of sampling, the best of a whole batch.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator
from functools import partial
from typing import Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from prefrl.evaluate.best_of_n import best
from prefrl.evaluate.policies import scored
from prefrl.improve.direct import Direct, DirectSettings
from prefrl.improve.objectives import kl_k1
from prefrl.improve.pairs import shuffled
from prefrl.improve.sft import supervised
from prefrl.improve.writer import Writer
from prefrl.policies.language import LanguagePolicy
from prefrl.policies.responses import Responses
from prefrl.protocols import RewardModel, Store, Task, text
from prefrl.seeding import to_numpy
from prefrl.types import Metrics, Response


class RAFTSettings(DirectSettings):
    """Supervised steps on the best of several responses to each prompt, by the learned reward."""

    kind: Literal["raft"] = "raft"
    updates: int = Field(8, ge=1)
    """Batches of a round."""
    prompts: int = Field(16, ge=1)
    """P: prompts of a batch."""
    responses: int = Field(8, ge=2)
    """K: responses to each prompt, of which the best one is learned."""
    epochs: int = Field(1, ge=1)
    """Passes over the best responses of a batch."""
    minibatch: int = Field(16, ge=1)
    """Responses in a gradient step."""
    beta: float = Field(0.0, ge=0)
    """Taken off a response's score for each nat of its log-ratio to the starting policy, before the best is chosen."""
    learning_rate: float = Field(5e-4, gt=0)
    """Adam's."""
    missing_end_penalty: float = Field(1.0, ge=0)
    """Taken off the score of a response that reached the task's most tokens without an end token."""

    def shrunk(self) -> RAFTSettings:
        return self.model_copy(update={"updates": 1, "prompts": min(self.prompts, 4), "evaluation_prompts": 8})

    def work(self) -> float:
        return float(self.updates * self.prompts)

    def build(self, task: Task, rng: np.random.Generator) -> Direct:
        return Direct(self, text(task, f"learner kind {self.kind!r} writes text"), partial(improve, self), rng)

    def formula(self) -> str:
        kl = f" - {self.beta:g} [log pi(y) - log ref(y)]" if self.beta else ""
        by = f"score(y) - {self.missing_end_penalty:g} [no end token]{kl}"
        return f"maximise  mean_t[ log pi(y*_t) ]\ny* = the best of {self.responses} responses y to a prompt by {by}"


def improve(
    settings: RAFTSettings,
    writer: Writer,
    reward: RewardModel[Response],
    store: Store[Response],
    rng: np.random.Generator,
) -> Metrics:
    """`updates` batches of fresh responses. Metrics, means over batches: reward (learned scores before penalties),
    reward_best (of those that were learned), kl (k1, nats per response), length (tokens), ended and unscored (shares);
    over gradient steps: loss (nats per token), grad_norm. NaN where it never was defined.
    """
    seen: dict[str, list[float]] = defaultdict(list)
    for _ in writer.paced(range(settings.updates)):
        drawn = writer.write(settings.prompts, settings.responses, rng)
        kept, measured = _choose(settings, writer.policy, drawn, reward)
        for metrics in (measured, *(_learn(settings, writer, drawn.rows(kept), rng) if len(kept) else ())):
            for name, value in metrics.items():
                seen[name].append(value)
    return {name: float(torch.tensor(values, dtype=torch.float64).nanmean()) for name, values in seen.items()}


def _choose(
    settings: RAFTSettings, policy: LanguagePolicy, drawn: Responses, reward: RewardModel[Response]
) -> tuple[Tensor, Metrics]:
    """The rows to learn, at most one a prompt, and what the batch is like."""
    device = policy.device
    raw = torch.from_numpy(scored(reward, drawn.candidates(policy.task.tokenizer))).to(device)  # (B,)
    if raw.isinf().any():
        raise FloatingPointError("a reward is infinite; expected finite numbers: look at the reward model's last fit")
    kl = kl_k1(drawn.logp, policy.start_logp(drawn)).sum(1)  # (B,): padding is 0 in both
    groups = (raw - settings.missing_end_penalty * ~drawn.ended - settings.beta * kl).view(-1, settings.responses)
    kept = torch.from_numpy(best(to_numpy(groups)) + np.arange(len(groups)) * settings.responses).to(device)
    kept = kept[~raw[kept].isnan()]  # what was not scored is never learned
    means = {"reward": raw, "reward_best": raw[kept], "kl": kl, "length": drawn.mask.sum(1), "ended": drawn.ended}
    found = {name: float(values.float().nanmean()) for name, values in means.items()}
    return kept, found | {"unscored": float(raw.isnan().float().mean())}


def _learn(settings: RAFTSettings, writer: Writer, rows: Responses, rng: np.random.Generator) -> Iterator[Metrics]:
    for _ in range(settings.epochs):
        yield from supervised(writer, settings, rows, shuffled(len(rows), settings.minibatch, rng))
