"""How well predicted preferences agree with judged ones. All take (M,) arrays and return NaN where undefined."""

from __future__ import annotations

import math

import numpy as np
from scipy.optimize import minimize_scalar
from scipy.special import expit

from prefrl.types import Floats

HOTTEST = 10.0
CERTAINTY = 0.5
"""Standard deviation of the logarithm of temperatures, before any comparison has been seen."""


def accuracy(predicted: Floats, preference: Floats) -> float:
    """The share of comparisons, ties left out, whose winner is predicted; an even prediction counts half."""
    decided = preference != 0.5
    if not decided.any():
        return float("nan")
    sides = np.sign(predicted[decided] - 0.5) * np.sign(preference[decided] - 0.5)
    return float((0.5 + 0.5 * sides).mean())


def brier(predicted: Floats, preference: Floats) -> float:
    """The mean squared distance from prediction to judgement (Brier 1950)."""
    return float(((predicted - preference) ** 2).mean()) if len(predicted) else float("nan")


def calibration_error(predicted: Floats, preference: Floats, bins: int = 10) -> float:
    """Expected calibration error: |mean predicted - mean judged| over equal-width bins, weighted by their counts.

    Both directions of each comparison are counted, so that the order of the candidates does not matter.
    """
    p, y = np.concatenate([predicted, 1 - predicted]), np.concatenate([preference, 1 - preference])
    if not len(p):
        return float("nan")
    at = np.minimum((p * bins).astype(int), bins - 1)
    gaps = [abs(float((p[at == b] - y[at == b]).mean())) * float((at == b).mean()) for b in np.unique(at)]
    return float(sum(gaps))


def temperature(logits: Floats, preference: Floats, error: Floats | float = 0.0, weight: Floats | float = 1.0) -> float:
    """What to divide logits (E, M) by, so that the members' mean probability fits preferences (M,) best.

    Guo et al. 2017, section 4.2, with a normal prior on log T about 0: a few comparisons cannot say much. 1 for none.
    `error`: the probability (M,) that an answer is turned round, see `judged_probability`; `weight`: how much each
    comparison counts, which matters beside the prior.
    """

    def loss(log_t: float) -> float:
        p = judged_probability(expit(logits / math.exp(log_t)).mean(0), error)
        p = np.clip(p, 1e-12, 1 - 1e-12)
        likelihood = preference * np.log(p) + (1 - preference) * np.log(1 - p)
        return float((log_t / CERTAINTY) ** 2 / 2 - (weight * likelihood).sum())

    if not len(preference):
        return 1.0
    bound = math.log(HOTTEST)
    return math.exp(float(minimize_scalar(loss, bounds=(-bound, bound), method="bounded").x))


def judged_probability(predicted: Floats, error: Floats | float) -> Floats:
    """(M,) the probability that the first is judged better, by a labeler who turns what they see round by mistake."""
    return error + (1 - 2 * error) * predicted
