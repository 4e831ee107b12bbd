"""One seed -> independent streams of random numbers, one for each stage of each round.

A stream is a function of (seed, round, stage) alone, so a resumed run draws what an unbroken one would have
drawn, and no generator's state has to be saved.
"""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, fields

import numpy as np


@dataclass(frozen=True)
class Streams:
    """The generators of one round."""

    build: np.random.Generator
    sample: np.random.Generator
    select: np.random.Generator
    label: np.random.Generator
    fit: np.random.Generator
    improve: np.random.Generator
    evaluate: np.random.Generator
    """The same in every round: policies are compared on the same starts and prompts."""


def streams(seed: int, round: int) -> Streams:
    """The streams of a round (0 is before the first)."""
    # By place: a new stage belongs at the end, or every stage after it would draw other numbers.
    keys = {f.name: (0 if f.name == "evaluate" else round, i) for i, f in enumerate(fields(Streams))}
    return Streams(
        **{name: np.random.default_rng(np.random.SeedSequence(seed, spawn_key=k)) for name, k in keys.items()}
    )


def keyed(base: int, key: str) -> np.random.Generator:
    """A generator for one named thing (a query, say): the same whatever was drawn before it."""
    # Not Python's hash(), which differs from one process to the next.
    return np.random.default_rng([base, int.from_bytes(hashlib.sha256(key.encode()).digest()[:8], "big")])


def draw_seed(rng: np.random.Generator) -> int:
    """A seed for a library that keeps its own generator (torch, gymnasium)."""
    return int(rng.integers(2**31 - 1))
