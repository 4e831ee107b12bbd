"""Verdicts of judges that are asked about each pair twice, in both orders, and the answer that a query comes to."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from prefrl.judgements import Answer, Comparison, Ranking, Skip
from prefrl.protocols import Store
from prefrl.types import C, Floats, Integers, Metrics, Query

LOT = 64
"""Queries whose answers are filed together: a judge is slow, and a kill loses no more than these."""
EQUAL = 1e-5
"""Win probabilities that differ by less are a tie: batches of another make-up move them by float32's rounding."""


@dataclass(frozen=True)
class Verdict:
    """A judgement of one pair of candidates, in both orders."""

    forward: float
    """The probability that the first is better, where it was shown first; NaN for a refusal."""
    backward: float
    """The same, where it was shown second."""

    @property
    def preference(self) -> float:
        """The mean over both orders: a verdict that only follows the order comes to 0.5. NaN for a refusal."""
        return (self.forward + self.backward) / 2


def answer_open(
    store: Store[C], name: str, compare: Callable[[Sequence[tuple[Query[C], int, int]]], Sequence[Verdict]]
) -> Metrics:
    """Have all open queries answered, by verdicts on (query, one candidate, another); what `bias` says of them."""
    queries, verdicts = store.open_queries(name), list[Verdict]()
    for start in range(0, len(queries), LOT):
        lot = queries[start : start + LOT]
        pairs = [(q, i, j) for q in lot for i, j in combinations(range(len(q.candidates)), 2)]
        said = compare(pairs)
        by_query: dict[str, list[Verdict]] = {q.id: [] for q in lot}
        for (query, _, _), one in zip(pairs, said, strict=True):
            by_query[query.id].append(one)
        store.answer([conclude(q, by_query[q.id], name) for q in lot])
        verdicts += said
    return bias(verdicts)


def conclude(query: Query[C], verdicts: Sequence[Verdict], name: str) -> Answer:
    """Two candidates: the mean preference. More: ranks by summed win probability, as in a tournament."""
    preferences = np.array([v.preference for v in verdicts])
    if not verdicts:
        raise ValueError(f"query {query.id[:12]} has one candidate: a judge compares two or more")
    if np.isnan(preferences).any():
        return Skip(query.id, "skip", name)
    if len(verdicts) == 1:
        return Comparison(query.id, float(preferences[0]), name)
    return Ranking(query.id, _ranks(preferences, len(query.candidates)), name)


def bias(verdicts: Sequence[Verdict]) -> Metrics:
    """Measure how much the order decides: `pairs`, `refused`, `position_bias` and `flipped`.

    `refused` is the share of pairs without a verdict. Over the others, `position_bias` is the mean probability given
    to what is shown first, minus 0.5, and `flipped` the share whose winner changes with the order.
    """
    sound = [v for v in verdicts if not np.isnan(v.preference)]
    metrics = {"pairs": float(len(verdicts))}
    if verdicts:
        metrics["refused"] = 1 - len(sound) / len(verdicts)
    if sound:
        metrics["position_bias"] = float(np.mean([(v.forward - v.backward) / 2 for v in sound]))
        metrics["flipped"] = float(np.mean([(v.forward - 0.5) * (v.backward - 0.5) < 0 for v in sound]))
    return metrics


def _ranks(preferences: Floats, size: int) -> tuple[int, ...]:
    """Ranks of K candidates from the preferences of all pairs (0, 1), (0, 2) ...: by summed win probability."""
    wins = np.zeros(size)
    for (i, j), p in zip(combinations(range(size), 2), preferences, strict=True):
        wins[i] += p
        wins[j] += 1 - p
    # Ranks step only where neighbours are more than rounding apart, so near equals share one.
    order = np.argsort(-wins, kind="stable")
    ranks: Integers = np.empty(size, np.int64)
    ranks[order] = np.cumsum([0, *(wins[order][:-1] - wins[order][1:] > EQUAL)])
    return tuple(int(rank) for rank in ranks)
