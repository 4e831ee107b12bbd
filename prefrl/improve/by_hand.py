"""A gradient step's loss and its derivatives, written out in NumPy: for policies that go the rest of the way by hand.

Beside products of matrices this small, most of the time of automatic differentiation goes into calls. The loss is that
of `gradient.step`, for sequences of one step each; tests hold one against the other.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from prefrl.improve.objectives import MAX_LOG_RATIO, Objective
from prefrl.protocols import ByHand
from prefrl.types import Floats, Metrics


def losses(policy: ByHand[Any], columns: Mapping[str, npt.NDArray[Any]], objective: Objective) -> Metrics:
    """Make the gradient of a minibatch that of the policy's parameters; what was measured is as in `gradient.step`.

    `columns`, of B rows each: what the policy reads, and logp, advantages and returns (B, 1).
    """
    critic = bool(objective.value) or not objective.policy
    logp, entropies, values, pull_back = policy.by_hand(columns, objective.policy, critic)
    seen: Metrics = {"loss": 0.0}
    distances: Metrics = {}
    of_logp = of_values = None
    if logp is not None:
        ratios = np.minimum(np.maximum(logp - columns["logp"], -MAX_LOG_RATIO), MAX_LOG_RATIO)
        ahead = np.expm1(ratios)
        gain, of_logp = _gain_and_slope(logp, ratios, 1 + ahead, columns["advantages"], objective.clip)
        of_logp /= len(logp)
        seen["loss"] = seen["policy_loss"] = _mean(gain)
        distances = _distances(ratios, ahead, objective)
    if values is not None:
        weight = objective.value if objective.policy else 1.0
        apart = values - columns["returns"]
        seen["value_loss"] = 0.5 * float(np.vdot(apart, apart)) / len(apart)
        seen["loss"] += weight * seen["value_loss"]
        of_values = apart * (weight / len(apart))
    if entropies is not None:
        seen["entropy"] = _mean(entropies)
        seen["loss"] -= objective.entropy * seen["entropy"]
    pull_back(of_logp, -objective.entropy / len(columns["logp"]), of_values)
    return seen | distances


def added(policy: ByHand[Any], columns: Mapping[str, npt.NDArray[Any]], weight: float, loss: float) -> Metrics:
    """Add to the parameters' gradient that of `weight` times the loss of what is shown: its mean -log pi, each step as
    its advantage says. Measured are that loss, as shown_loss, and the sum of both."""
    parameters = list(policy.parameters())
    before = [None if p.grad is None else p.grad.clone() for p in parameters]
    shown = losses(policy, columns, Objective())["loss"]
    for parameter, gradient in zip(parameters, before, strict=True):
        assert parameter.grad is not None
        parameter.grad.mul_(weight)
        if gradient is not None:
            parameter.grad.add_(gradient)
    return {"loss": loss + weight * shown, "shown_loss": shown}


def _gain_and_slope(
    logp: Floats, ratios: Floats, ratio: Floats, advantages: Floats, clip: float | None
) -> tuple[Floats, Floats]:
    """(B, 1): what each step adds to the policy's loss, and its derivative by the log-probability."""
    if clip is None:
        return -logp * advantages, -advantages
    plain = ratio * advantages
    held = np.minimum(np.maximum(ratio, 1 - clip), 1 + clip) * advantages
    # Where both are equal the ratio is within the clip, and the slope that of the plain one.
    free = (plain <= held) & (np.abs(ratios) < MAX_LOG_RATIO)
    return -np.minimum(plain, held), -plain * free


def _distances(ratios: Floats, ahead: Floats, objective: Objective) -> Metrics:
    apart = np.abs(ahead)
    return {
        "clipped": np.count_nonzero(apart > (objective.clip or math.inf)) / len(apart),
        "kl_old": _mean(ahead - ratios),
        "ratio_error": float(apart.max()),
    }


def _mean(x: Floats) -> float:
    return float(x.sum()) / len(x)
