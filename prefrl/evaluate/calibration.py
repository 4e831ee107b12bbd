"""Does the reward model know how sure it may be? The bins of a reliability diagram."""

from __future__ import annotations

import numpy as np

from prefrl.evaluate.card import Bin
from prefrl.stats.estimates import wilson
from prefrl.types import Floats


def reliability(predicted: Floats, preference: Floats, bins: int = 5) -> tuple[Bin, ...]:
    """Compare predictions (M,) with preferences (M,), both in [0, 1]; only bins with comparisons in them.

    Which candidate comes first is arbitrary, so each comparison is turned round to have its favourite first and
    the bins divide [0.5, 1] evenly (Guo et al. 2017, section 2, on the folded probability).
    """
    if predicted.ndim != 1 or predicted.shape != preference.shape:
        raise ValueError(f"reliability needs two equal rows of numbers, got {predicted.shape} and {preference.shape}")
    turned = predicted < 0.5
    confidence = np.where(turned, 1.0 - predicted, predicted).astype(np.float64)
    won = np.where(turned, 1.0 - preference, preference).astype(np.float64)
    place = np.minimum((confidence - 0.5) * 2 * bins, bins - 1).astype(int)  # 1.0 belongs to the last bin
    return tuple(_bin(confidence[place == i], won[place == i]) for i in range(bins) if (place == i).any())


def _bin(confidence: Floats, won: Floats) -> Bin:
    share = float(won.mean())
    low, high = wilson(share, len(won))
    return Bin(count=len(won), confidence=float(confidence.mean()), share=share, low=low, high=high)
