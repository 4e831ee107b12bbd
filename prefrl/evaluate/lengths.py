"""Does a reward model pay for length?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from prefrl.evaluate.agreement import Pairs, buckets, hits
from prefrl.evaluate.card import Lengths
from prefrl.kinds import kind_of
from prefrl.stats.estimates import undefined
from prefrl.stats.intervals import correlation
from prefrl.types import Candidate, Floats, Integers

MOST = 2000
"""Candidates in a rank correlation."""


def length(candidate: Candidate) -> int:
    """Steps, tokens, or characters of a response that comes without tokens."""
    return kind_of(candidate).length(candidate)


def length_part(pairs: Pairs, score: Floats, candidates: Sequence[Candidate], rng: np.random.Generator) -> Lengths:
    """Does the score (N,) follow the length of the candidates?"""
    sizes = np.array([length(c) for c in candidates], np.float64)
    contexts = [context(c) for c in candidates]
    if np.ptp(sizes) == 0:
        same = undefined(f"all candidates have length {sizes[0]:.0f}")
        values = dict.fromkeys(("spearman", "pearson", "baseline", "when_longer", "when_shorter"), same)
        return Lengths(unit=kind_of(candidates[0]).unit(candidates), buckets=[], **values)
    some = pairs.decided
    longer = some.length * (some.preference - 0.5)
    at = sample(len(sizes), rng)
    return Lengths(
        unit=kind_of(candidates[0]).unit(candidates),
        spearman=correlation("spearman", score[at], sizes[at], [contexts[i] for i in at], rng),
        pearson=correlation("pearson", score[at], sizes[at], [contexts[i] for i in at], rng),
        baseline=some.share(hits(some.length, some.preference - 0.5), rng),
        when_longer=some.take(longer > 0).accuracy(rng),
        when_shorter=some.take(longer < 0).accuracy(rng),
        buckets=buckets(pairs, np.abs(pairs.length), rng, lengths=True),
    )


def context(candidate: Candidate) -> str:
    """Candidates of one episode, or of one prompt, are resampled together."""
    return kind_of(candidate).cluster(candidate)


def sample(count: int, rng: np.random.Generator, most: int = MOST) -> Integers:
    """Which candidates are looked at: all, or a sample of them."""
    return np.sort(rng.permutation(count)[:most])
