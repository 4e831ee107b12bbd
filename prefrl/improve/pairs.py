"""What the methods that learn from judged pairs share, whatever it is that was judged."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from prefrl.fit.pairs import Batch, batch
from prefrl.protocols import Store
from prefrl.types import C, Integers, Metrics


def judged(store: Store[C], kind: str) -> Batch[C]:
    """The pairs that all judgements so far imply. Raises ValueError where there are none."""
    return some(batch(store.judged()), kind)


def some(pairs: Batch[C], kind: str) -> Batch[C]:
    """Pairs to learn from. Raises ValueError where there are none."""
    if not len(pairs):
        raise ValueError(f"{kind} learns from judged pairs; the store holds none: raise loop.labels, or import some")
    return pairs


def measured(margins: Tensor, preference: Tensor, share: Tensor) -> dict[str, Tensor]:
    """Accuracy and margin of pairs, from by how much the first of each is ahead, each (m,); shares add up to 1."""
    signed = margins * (2 * preference - 1).sign()  # 0 for a tie, which makes it half right below
    return {"accuracy": (share * (signed.sign() + 1) / 2).sum(), "margin": (share * signed).sum()}


def shuffled(count: int, size: int, rng: np.random.Generator) -> list[Integers]:
    """All rows once, about equally many at a time."""
    return np.array_split(rng.permutation(count), -(-count // size))


def means(seen: list[Metrics]) -> Metrics:
    """Of each measure over the steps that have it."""
    names = dict.fromkeys(name for one in seen for name in one)
    return {name: float(np.mean([one[name] for one in seen if name in one])) for name in names}
