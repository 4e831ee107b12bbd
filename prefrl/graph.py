"""Judgements as a graph: every candidate once, comparisons as edges. NumPy and the standard library only."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Generic

import numpy as np
import numpy.typing as npt

from prefrl.types import C, Choice, Comparison, Floats, Integers, Judged, Judgement, Ranking


@dataclass(frozen=True, eq=False)
class Batch(Generic[C]):
    """Judgements as a graph: every candidate once, comparisons as edges between them."""

    candidates: tuple[C, ...]
    """N distinct candidates: each is scored once, however often it was judged."""
    edges: Integers
    """(M, 2) int64: indices of the two candidates compared."""
    preference: Floats
    """(M,) float32 in [0, 1]: the probability that edge[0] is better."""
    weight: Floats
    """(M,) float32: the pairs implied by one judgement of K candidates share K - 1 times its weight."""
    group: Integers
    """(M,) int64: which judgement each edge came from; edges of one group are not independent."""

    def __len__(self) -> int:
        return len(self.edges)

    def subset(self, keep: npt.NDArray[np.bool_]) -> Batch[C]:
        """The same candidates with only the edges where `keep` (M,) is true."""
        return replace(
            self,
            edges=self.edges[keep],
            preference=self.preference[keep],
            weight=self.weight[keep],
            group=self.group[keep],
        )


def batch(judged: Sequence[Judged[C]]) -> Batch[C]:
    """Turn judgements of any kind into a `Batch`: all the pairs that each one implies."""
    candidates = {c.id: c for one in judged for c in one.query.candidates}
    index = {id: i for i, id in enumerate(candidates)}
    rows: list[tuple[int, int, float, float, int]] = []
    for group, one in enumerate(judged):
        at = [index[c.id] for c in one.query.candidates]
        pairs = implied_pairs(one.judgement, len(at))
        share = one.judgement.weight * (len(at) - 1) / max(len(pairs), 1)
        rows += [(at[i], at[j], preference, share, group) for i, j, preference in pairs]
    columns = list(zip(*rows, strict=True)) if rows else [(), (), (), (), ()]
    return Batch(
        candidates=tuple(candidates.values()),
        edges=np.array([columns[0], columns[1]], np.int64).T.reshape(-1, 2),
        preference=np.array(columns[2], np.float32),
        weight=np.array(columns[3], np.float32),
        group=np.array(columns[4], np.int64),
    )


def implied_pairs(judgement: Judgement, size: int) -> list[tuple[int, int, float]]:
    """(i, j, preference that i is better), one for each pair of `size` candidates that the judgement speaks of."""
    if isinstance(judgement, Comparison):
        return [(0, 1, judgement.preference)]
    if isinstance(judgement, Choice):
        return [(judgement.best, j, 1.0) for j in range(size) if j != judgement.best]
    worth = [-r for r in judgement.ranks] if isinstance(judgement, Ranking) else list(judgement.levels)
    return [(i, j, 0.5 + 0.5 * float(np.sign(worth[i] - worth[j]))) for i, j in combinations(range(size), 2)]
