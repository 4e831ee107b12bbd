"""Judgements as a graph: every candidate once, comparisons as edges. NumPy and the standard library only."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Generic

import numpy as np
import numpy.typing as npt

from prefrl.judgements import Judged, Rating, implied_pairs, person
from prefrl.types import C, Floats, Integers


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
        # K - 1 and not the number of pairs: a ranking of many candidates would otherwise outweigh all the rest.
        share = one.judgement.weight * (len(at) - 1) / max(len(pairs), 1)
        rows += [(at[i], at[j], preference, share, group) for i, j, preference in pairs]
    return _of_rows(tuple(candidates.values()), rows)


def _of_rows(candidates: tuple[C, ...], rows: Sequence[tuple[int, int, float, float, int]]) -> Batch[C]:
    """(one candidate, the other, preference, weight, judgement) for each edge."""
    columns = list(zip(*rows, strict=True)) if rows else [(), (), (), (), ()]
    return Batch(
        candidates=candidates,
        edges=np.array([columns[0], columns[1]], np.int64).T.reshape(-1, 2),
        preference=np.array(columns[2], np.float32),
        weight=np.array(columns[3], np.float32),
        group=np.array(columns[4], np.int64),
    )


def compared(judged: Sequence[Judged[C]], sides: Sequence[bool] = ()) -> Batch[C]:
    """The same, to measure a reward on: where there are ratings of single candidates alone, these are compared.

    Each stands in one comparison at most, with another level of the same person's on the same scale, and of the same
    side: `sides` (J,) tells what is held out, say. Candidates may then be of different contexts, as on a scale they are
    compared all the same.
    """
    data = batch(judged)
    return data if len(data) else _rated(data, judged, sides)


def _rated(data: Batch[C], judged: Sequence[Judged[C]], sides: Sequence[bool]) -> Batch[C]:
    index = {c.id: i for i, c in enumerate(data.candidates)}
    waiting: dict[Hashable, list[tuple[int, Rating]]] = defaultdict(list)
    rows: list[tuple[int, int, float, float, int]] = []
    # By id: the same judgements make the same pairs, in whatever order they came.
    for group in sorted(range(len(judged)), key=lambda j: judged[j].query.id):
        one, (candidate,) = judged[group].judgement, judged[group].query.candidates
        assert isinstance(one, Rating)  # nothing else has one candidate
        at, level = index[candidate.id], one.levels[0]
        pile = waiting[person(one.labeler), one.scale, sides[group] if sides else None]
        if pile and pile[-1][1].levels[0] != level:  # all of a pile have one level
            other, before = pile.pop()
            rows.append((other, at, float(before.levels[0] > level), (before.weight + one.weight) / 2, group))
        else:
            pile.append((at, one))
    return _of_rows(data.candidates, rows)
