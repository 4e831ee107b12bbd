"""Does a score hang on its candidate alone? Not on what else is in the batch, nor on order, nor on padding."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np
from scipy.special import expit

from prefrl.evaluate.card import Invariance
from prefrl.evaluate.lengths import length
from prefrl.kinds import kind_of
from prefrl.stats.estimates import Estimate, undefined
from prefrl.types import Candidate, Floats

Score: TypeAlias = Callable[[Sequence[Candidate]], Floats]
"""N candidates -> (E, N) raw scores."""
PROBES = 16
SWAPS = 8
"""Pairs: each needs two passes of its own."""
TOLERANCE = 1e-3
"""Of the scores' standard deviation, or of a probability: above float32 rounding, below what changes a judgement."""


def self_test(score: Score, candidates: Sequence[Candidate], pairs: Sequence[tuple[int, int]]) -> Invariance:
    """Score a few candidates in several batches, and compare. `pairs`: indices of candidates to swap."""
    probes = candidates[:PROBES]
    together = score(probes)
    spread = float(together.std(1).mean())
    alone = _largest(together, np.concatenate([score([c]) for c in probes], 1))
    turned = _largest(together, score(probes[::-1])[:, ::-1])
    padding, swap = _padding(score, probes), _swap(score, candidates, pairs[:SWAPS])
    differences = [e.value / max(spread, 1e-12) for e in (alone, turned, padding) if e.value is not None]
    return Invariance(
        swap=swap,
        alone=alone,
        reversed=turned,
        padding=padding,
        spread=spread,
        passed=max([*differences, swap.value or 0.0]) <= TOLERANCE,
    )


def _largest(a: Floats, b: Floats) -> Estimate:
    return Estimate(value=float(np.abs(a - b).max()), count=a.shape[1])


def _swap(score: Score, candidates: Sequence[Candidate], pairs: Sequence[tuple[int, int]]) -> Estimate:
    """Both orders of each pair, each scored as a batch of its own."""
    if not pairs:
        return undefined("no comparisons")
    errors = []
    for first, second in pairs:
        there = score([candidates[first], candidates[second]])
        back = score([candidates[second], candidates[first]])
        errors.append(expit(there[:, 0] - there[:, 1]).mean() + expit(back[:, 0] - back[:, 1]).mean() - 1.0)
    return Estimate(value=float(np.abs(errors).max()), count=len(errors))


def _padding(score: Score, probes: Sequence[Candidate]) -> Estimate:
    """Short candidates beside long ones: half of the probes are cut to half of their length."""
    cut = [kind_of(c).half(c) if i % 2 else c for i, c in enumerate(probes)]
    if len({length(c) for c in cut}) < 2:
        return undefined("all candidates have one length, and cannot be cut")
    return _largest(score(cut), np.concatenate([score([c]) for c in cut], 1))
