"""The part that policy gradients on groups of samples share: responses to a prompt, or pictures for a caption."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from prefrl.improve.objectives import (
    all_equal,
    batch_centred,
    batch_scaled,
    group_normalised,
    kl_k3,
    leave_one_out,
    step_rewards,
)
from prefrl.seeding import generator
from prefrl.types import Metrics


def advantages_of(returns: Tensor, how: str) -> Tensor:
    """(P, K) returns of K responses to each of P prompts -> (P, K) advantages."""
    if how == "leave_one_out":
        return leave_one_out(returns)
    scaled = {"group_normalised": group_normalised, "batch_scaled": batch_scaled, "batch_mean": batch_centred}
    return scaled[how](returns)


@dataclass(frozen=True)
class Weighing:
    """The way from scores and KL to advantages."""

    advantage: str
    """See `ADVANTAGES`."""
    kl_in: str
    """`reward`: taken off before the baseline; `advantage`: after it was normalised; else elsewhere."""
    beta: float
    """Weight of the KL."""


def by_group(scores: Tensor, kl: Tensor, mask: Tensor, size: int, how: Weighing) -> Tensor:
    """Scores (B,) and the KL of each step (B, L), of groups of `size` that stand together -> (P, K) advantages.

    All steps of a sequence have the same. One that was not scored (NaN) has 0.
    """
    in_reward = how.beta if how.kl_in == "reward" else 0.0
    # (B,): one return a sequence, so the KL is in it before the baseline is taken off.
    returns = step_rewards(scores, kl, mask, in_reward).sum(1)
    groups = returns.view(-1, size)
    kls = torch.where(scores.isnan(), math.nan, kl.sum(1)).view_as(groups)
    return advantages_of(groups, how.advantage) - kl_advantages(kls, how)


def kl_advantages(kls: Tensor, how: Weighing) -> Tensor | float:
    """(P, K): what the KL of each sequence takes off its advantage, where it is not in the reward.

    With the same baseline, so that at the optimum of reward minus beta x KL both cancel in each sample.
    """
    if how.kl_in != "advantage" or not how.beta:
        return 0.0
    baseline = "batch_mean" if how.advantage == "batch_mean" else "leave_one_out"
    return how.beta * advantages_of(kls, baseline)


def minibatches(size: int, epochs: int, count: int, rng: np.random.Generator, device: torch.device) -> list[Tensor]:
    """All rows of a batch in so many parts, in another order in each epoch."""
    order = generator(rng)
    each = -(-size // count)  # rounded up, so that there are no more than asked for
    orders = [torch.randperm(size, generator=order).to(device) for _ in range(epochs)]
    return [rows for one in orders for rows in one.split(each)]  # type: ignore[no-untyped-call]


def finite(name: str, values: Tensor, update: int) -> Tensor:
    """The same values. Raises `FloatingPointError` where one is infinite."""
    if values.isinf().any():
        raise FloatingPointError(
            f"the {name} of update {update} is not finite: {values.detach().flatten()[:4].tolist()}; "
            "expected finite numbers: look at the reward model's last fit"
        )
    return values


def check_ratio(error: float, most: float, update: int, remedy: str) -> None:
    """Before a batch's first step the policy is the one that drew it: anything but rounding is a bug."""
    if error > most:
        raise FloatingPointError(
            f"update {update}: the policy gives its own samples other probabilities than it drew them with "
            f"(ratio off by {error:.2g}); {remedy}, and report it if that does not help"
        )


def rewarded(raw: Tensor, scores: Tensor) -> Metrics:
    """Of a batch (B,): the mean and the std of the scores as they came, and the share that is learned nothing from."""
    known = ~raw.isnan()
    return {
        "reward": float(raw.nanmean()),
        "reward_std": float(raw[known].std(correction=0)) if known.any() else math.nan,
        "unscored": float(scores.isnan().float().mean()),
    }


def equal_groups(groups: Tensor) -> Metrics:
    """The share of groups (P, K) in which all have the same score, where there are several."""
    return {"equal_groups": float(all_equal(groups).float().mean())} if groups.shape[1] > 1 else {}


def distances(kl: Tensor, mask: Tensor) -> Metrics:
    """Two estimates of the KL per sequence, from log-ratios (B, L): k1, and k3, which is never negative."""
    k3 = kl_k3(kl, torch.zeros_like(kl))
    return {"kl": float(kl.sum(1).mean()), "kl_k3": float(torch.where(mask, k3, 0.0).sum(1).mean())}


def mean(values: Sequence[float]) -> float:
    """Of the batches in which it is defined."""
    known = [value for value in values if not math.isnan(value)]
    return float(np.mean(known)) if known else math.nan


AVERAGES = {"constant": "mean_i sum_t", "token": "mean over all tokens", "sequence": "mean_i mean_t"}
ADVANTAGES = {
    "leave_one_out": "R_i - mean of the prompt's other R_j",
    "group_normalised": "(R_i - mean of the prompt's R_j) / (their std + 1e-4)",
    "batch_scaled": "(R_i - mean of the prompt's R_j) / (std of the batch's R + 1e-4)",
    "batch_mean": "R_i - mean of the batch's R_j",
}
"""Of a response."""
