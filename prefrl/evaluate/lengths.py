"""Does a reward model pay for length?"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from prefrl.evaluate.agreement import Pairs, buckets, hits
from prefrl.evaluate.card import Lengths
from prefrl.stats.estimates import undefined
from prefrl.stats.intervals import correlation
from prefrl.types import Candidate, Floats, Integers, Response, Segment

MOST = 2000
"""Candidates in a rank correlation."""


def length(candidate: Candidate) -> int:
    """Steps, tokens, or characters of a response that comes without tokens."""
    if isinstance(candidate, Response):
        return len(candidate.tokens) or len(candidate.text)
    return len(candidate)


def length_part(pairs: Pairs, score: Floats, candidates: Sequence[Candidate], rng: np.random.Generator) -> Lengths:
    """Does the score (N,) follow the length of the candidates?"""
    sizes = np.array([length(c) for c in candidates], np.float64)
    contexts = [context(c) for c in candidates]
    if np.ptp(sizes) == 0:
        same = undefined(f"all candidates have length {sizes[0]:.0f}")
        values = dict.fromkeys(("spearman", "pearson", "baseline", "when_longer", "when_shorter"), same)
        return Lengths(unit=_unit(candidates), buckets=[], **values)
    some = pairs.decided
    longer = some.length * (some.preference - 0.5)
    at = sample(len(sizes), rng)
    return Lengths(
        unit=_unit(candidates),
        spearman=correlation("spearman", score[at], sizes[at], [contexts[i] for i in at], rng),
        pearson=correlation("pearson", score[at], sizes[at], [contexts[i] for i in at], rng),
        baseline=some.share(hits(some.length, some.preference - 0.5), rng),
        when_longer=some.take(longer > 0).accuracy(rng),
        when_shorter=some.take(longer < 0).accuracy(rng),
        buckets=buckets(pairs, np.abs(pairs.length), rng, lengths=True),
    )


def _unit(candidates: Sequence[Candidate]) -> str:
    if isinstance(candidates[0], Segment):
        return "steps"
    tokens = {bool(c.tokens) for c in candidates if isinstance(c, Response)}
    return "tokens" if tokens == {True} else "characters" if tokens == {False} else "tokens or characters"


def context(candidate: Candidate) -> str:
    """Candidates of one episode, or of one prompt, are resampled together."""
    return candidate.prompt if isinstance(candidate, Response) else candidate.episode


def sample(count: int, rng: np.random.Generator, most: int = MOST) -> Integers:
    """Which candidates are looked at: all, or a sample of them."""
    return np.sort(rng.permutation(count)[:most])
