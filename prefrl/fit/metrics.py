"""How well predicted preferences agree with judged ones. All take (M,) arrays and return NaN where undefined."""

from __future__ import annotations

import numpy as np

from prefrl.types import Floats


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
