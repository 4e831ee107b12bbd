"""What policy gradients on groups of samples share: responses to a prompt, or pictures for a caption."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from torch import Tensor

from prefrl.improve.objectives import batch_centred, batch_scaled, group_normalised, leave_one_out


def advantages_of(returns: Tensor, how: str) -> Tensor:
    """(P, K) returns of K responses to each of P prompts -> (P, K) advantages."""
    if how == "leave_one_out":
        return leave_one_out(returns)
    scaled = {"group_normalised": group_normalised, "batch_scaled": batch_scaled, "batch_mean": batch_centred}
    return scaled[how](returns)


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
