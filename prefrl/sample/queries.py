"""Candidate queries: which candidates of a pool may stand side by side. Queries are rows of indices into the pool."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from prefrl.kinds import kind_of
from prefrl.types import C, Candidate, Floats, Integers, Query


def overlap(a: Candidate, b: Candidate) -> bool:
    """Whether two candidates of a pool share a part, as two segments of one episode may."""
    return kind_of(a).overlap(a, b)


def newest(pool: Sequence[C], share: float) -> list[C]:
    """The distinct candidates at the end of a pool, where the newest are: `share` of them, rounded up."""
    distinct = list({c.id: c for c in pool}.values())
    return distinct[len(distinct) - math.ceil(share * len(distinct)) :]


def groups(pool: Sequence[C], size: int, rng: np.random.Generator) -> Integers:
    """(Q, K) disjoint random queries of `size` candidates of one context each, in random order.

    The candidates of a pool are distinct. Each stands in at most one query, so that no query repeats or half-repeats
    another, and never beside one that it overlaps: what they share says nothing. Candidates left without enough
    others are dropped. Of single candidates no two that overlap are asked about.
    """
    by_context: dict[str, list[int]] = defaultdict(list)
    for i, candidate in enumerate(pool):
        by_context[candidate.context].append(i)
    found: list[list[int]] = []
    for members in by_context.values():
        found += _first_fit(pool, rng.permutation(members).tolist(), size)
    # Shuffled: callers take the first ones, which would all be of the first contexts.
    return np.array(found, np.int64).reshape(-1, size)[rng.permutation(len(found))]


def _first_fit(pool: Sequence[C], members: Sequence[int], size: int) -> list[list[int]]:
    """Each candidate joins the first open group without one that it overlaps, else it opens a group."""
    if size == 1:
        return _apart(pool, members)
    found: list[list[int]] = []
    opened: list[list[int]] = []  # few: whoever opened the newest overlaps a member of each
    for i in members:
        fits = (at for at, group in enumerate(opened) if not any(overlap(pool[i], pool[j]) for j in group))
        at = next(fits, len(opened))
        if at == len(opened):
            opened.append([])
        opened[at].append(i)
        if len(opened[at]) == size:
            found.append(opened.pop(at))
    return found


def _apart(pool: Sequence[C], members: Sequence[int]) -> list[list[int]]:
    """Each candidate that overlaps none before it: nobody is to show twice what to do in the same state."""
    found: list[list[int]] = []
    for i in members:
        if not any(overlap(pool[i], pool[j]) for (j,) in found):
            found.append([i])
    return found


def across(pools: Sequence[Sequence[C]], size: int, count: int, rng: np.random.Generator) -> list[Query[C]]:
    """At most `count` queries of `size` candidates, each of as many pools as can be, no candidate in two of them.

    Of fewer pools than candidates some give two or more, which do not overlap. Sides are random.
    """
    left = [[pool[i] for i in rng.permutation(len(pool))] for pool in pools]
    found: list[Query[C]] = []
    while len(found) < count:
        order, query = rng.permutation(len(pools)), list[C]()
        for slot in range(size):
            stock = left[order[slot % len(pools)]]
            at = next((i for i, one in enumerate(stock) if all(_may_join(one, other) for other in query)), None)
            if at is None:
                return found
            query.append(stock.pop(at))
        found.append(Query(tuple(query)))
    return found


def _may_join(one: Candidate, other: Candidate) -> bool:
    return one.context == other.context and not overlap(one, other)


def proposals(pool: Sequence[C], size: int, times: int, rng: np.random.Generator) -> Integers:
    """(Q, K) distinct queries in random order; each candidate stands in about `times` of them."""
    drawn = np.concatenate([groups(pool, size, rng) for _ in range(times)])
    return rng.permutation(np.unique(np.sort(drawn, axis=1), axis=0))  # a query is a set: sorted rows make twins equal


def disjoint(queries: Integers, order: Integers, count: int) -> Integers:
    """The first rows of `order`, at most `count`, whose queries share no candidate with one before.

    Comparisons that share a candidate are held out together, so shared ones would join up to one large component.
    """
    used: set[int] = set()
    rows: list[int] = []
    for row in order:
        members = queries[row].tolist()
        if len(rows) < count and used.isdisjoint(members):
            used.update(members)
            rows.append(int(row))
    return np.array(rows, np.int64)


def topped_up(pool: Sequence[C], queries: Integers, count: int, rng: np.random.Generator) -> Integers:
    """Disjoint queries, and where they are fewer than `count` random ones of what is left of the pool."""
    left = np.setdiff1d(np.arange(len(pool)), queries)
    if len(queries) >= count or len(left) < queries.shape[1]:
        return queries
    more = groups([pool[i] for i in left], queries.shape[1], rng)
    return np.concatenate([queries, left[more]])[:count]  # `more` counts within what is left


def asked(pool: Sequence[C], queries: Integers) -> list[Query[C]]:
    """Rows of indices as queries."""
    return [Query(tuple(pool[i] for i in row)) for row in queries]


def query_features(features: Floats, queries: Integers) -> Floats:
    """(N, d) features of candidates -> (Q, 2 d) features of queries, whatever the order of their candidates.

    Each feature is brought to mean 0 and std 1 over the pool; a query is the mean and the std over its candidates:
    for a pair, the middle and half the distance along each feature.
    """
    features = features.astype(np.float64)
    std = features.std(0)
    normalised = (features - features.mean(0)) / np.where(std > 0, std, 1.0)
    sides = normalised[queries]
    return np.concatenate([sides.mean(1), sides.std(1)], axis=1)
