"""Online direct preference optimisation for text: the policy's fresh responses, judged by the reward model.

Variant: Guo et al. 2024 with the learned reward as the annotator: of K responses to a prompt the best and the worst
make a pair, and each batch of pairs is one gradient step, the starting policy as the reference throughout. The loss is
DPO's or IPO's. What differs: with `soft` a pair is learned from with the probability that the reward gives, which has
the optimum that a policy gradient has with a KL of weight beta. Left out: refreshing the reference.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Literal

import numpy as np
from pydantic import Field
from torch import Tensor

from prefrl.evaluate.policies import scored
from prefrl.improve.direct import Direct, PairLossSettings, Pairs, pair_formula, step
from prefrl.improve.pairs import means
from prefrl.improve.writer import Writer
from prefrl.policies.responses import Responses
from prefrl.protocols import RewardModel, Store, Task, text
from prefrl.seeding import to_numpy
from prefrl.types import Floats, Metrics, Response


class OnlineDPOSettings(PairLossSettings):
    """Direct preference optimisation on fresh responses that the reward compares, held near the starting policy."""

    kind: Literal["online_dpo"] = "online_dpo"
    updates: int = Field(15, ge=1)
    """Batches of a round."""
    prompts: int = Field(32, ge=1)
    """P: prompts of a batch."""
    responses: int = Field(2, ge=2)
    """K: responses to each prompt, of which the best and the worst make a pair."""
    soft: bool = False
    """Let the better one of a pair be better by s(its score - the other's), rather than for sure: with the sigmoid loss
    the policy then stops at the starting one tilted by the scores, ref x exp(score / beta)."""
    missing_end_penalty: float = Field(1.0, ge=0)
    """Taken off the score of a response that reached the task's most tokens without an end token."""

    def shrunk(self) -> OnlineDPOSettings:
        return self.model_copy(update={"updates": 1, "prompts": min(self.prompts, 4), "evaluation_prompts": 8})

    def work(self) -> float:
        return float(self.updates * self.prompts)

    def build(self, task: Task, rng: np.random.Generator) -> Direct:
        return Direct(self, text(task, f"learner kind {self.kind!r} writes text"), partial(improve, self), rng)

    def formula(self) -> str:
        end = f" - {self.missing_end_penalty:g} [no end token]" if self.missing_end_penalty else ""
        counts = "a pair counts s(R(better) - R(worse)) this way, and the rest turned round\n" if self.soft else ""
        return (
            f"{pair_formula(self)}\n"
            f"better, worse: those with the largest and the smallest R of {self.responses} responses to a prompt\n"
            f"{counts}R = score(y){end};  {self.prompts} prompts a batch, one gradient step on each"
        )


def improve(
    settings: OnlineDPOSettings,
    writer: Writer,
    reward: RewardModel[Response],
    store: Store[Response],
    rng: np.random.Generator,
) -> Metrics:
    """`updates` batches of fresh responses; the metrics are means over them.

    reward and reward_std (learned scores before the penalty), unscored (share), kl (k1, nats per response), length
    (tokens), ended (share), pairs (in a batch), equal_groups (share of prompts that give no pair), those of
    `prefrl.improve.direct.step`, and updates: batches that gave a pair at all.
    """
    seen = [_update(settings, writer, reward, rng) for _ in writer.paced(range(settings.updates))]
    return means(seen) | {"updates": float(sum(one["pairs"] > 0 for one in seen))}


def _update(
    settings: OnlineDPOSettings, writer: Writer, reward: RewardModel[Response], rng: np.random.Generator
) -> Metrics:
    policy = writer.policy
    drawn = writer.write(settings.prompts, settings.responses, rng)
    scores = scored(reward, drawn.candidates(policy.task.tokenizer))  # (B,); NaN where nothing was scored
    if np.isinf(scores).any():
        raise FloatingPointError("a reward is infinite; expected finite numbers: look at the reward model's last fit")
    start = policy.start_logp(drawn).sum(1)
    worth = scores - settings.missing_end_penalty * ~to_numpy(drawn.ended)
    pairs = pairs_of(settings, drawn, start, worth)
    enough = len(pairs) >= policy.least_rows
    learned = step(writer, settings, pairs, np.arange(len(pairs)), settings.pair_loss) if enough else {}
    counts = {"pairs": float(len(pairs)), "equal_groups": 1 - len(pairs) / settings.prompts}
    return learned | counts | _measured(drawn, start, scores)


def pairs_of(settings: OnlineDPOSettings, drawn: Responses, start: Tensor, worth: Floats) -> Pairs:
    """The best and the worst response to each prompt, from the worth (P K,) of all; where these are equal, none."""
    groups = worth.reshape(-1, settings.responses)  # (P, K)
    ends = [np.where(np.isnan(groups), -math.inf, sign * groups).argmax(1) for sign in (1, -1)]
    edges = np.stack(ends, 1)  # (P, 2)
    lead = -np.diff(np.take_along_axis(groups, edges, 1))[:, 0]  # (P,), 0 or NaN without two that differ
    differ = lead > 0
    edges = (edges + settings.responses * np.arange(len(groups))[:, None])[differ]
    sure = 1 / (1 + np.exp(-lead[differ])) if settings.soft else np.ones(len(edges))
    preference, weight = sure.astype(np.float32), np.ones(len(edges), np.float32)
    return Pairs(drawn, start, edges, preference, weight, settings.length_normalised)


def _measured(drawn: Responses, start: Tensor, scores: Floats) -> Metrics:
    """A batch before it is learned from."""
    known = scores[~np.isnan(scores)]
    rewards = {"reward": float(known.mean()), "reward_std": float(known.std())} if len(known) else {}
    return rewards | {
        "unscored": 1 - len(known) / len(scores),
        "kl": float((drawn.logp.sum(1) - start).mean()),
        "length": float(drawn.mask.sum(1).float().mean()),
        "ended": float(drawn.ended.float().mean()),
    }
