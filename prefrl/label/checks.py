"""Check questions: queries with a clear answer, to find out whether a person looks. Nothing is learned from them.

A check looks like every other query, and its best candidate is far ahead by gold. Checks of high certainty in the usual
format tell careful people from careless ones better than instructions to press a button do (arXiv 2505.19134).
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Collection, Sequence
from typing import Generic, NamedTuple

import numpy as np

from prefrl.kinds import kind_of
from prefrl.protocols import Store
from prefrl.storage.files import DamagedError
from prefrl.types import C, Floats, Integers, Query

MOST = 1000
"""Candidates whose gold is looked at; each is a file."""
TRIES = 4000
"""Random groups that are drawn."""
TINY = 1e-9
"""Gaps below this share of the largest gold are rounding."""


class Checks(NamedTuple, Generic[C]):
    """Check questions for `store.ask(queries, purpose="check", expected=expected)`."""

    queries: list[Query[C]]
    expected: list[int]
    """Which candidate of each is the best, counted from 0 in the query's own order."""
    reason: str = ""
    """Why there are none, or fewer than were wanted."""


def pick_checks(
    store: Store[C], asked: Sequence[Query[C]], count: int, rng: np.random.Generator, top: float = 0.1
) -> Checks[C]:
    """At most `count` checks over candidates of queries asked so far, of the size that most of these have.

    See `clear_queries`. The gold is read from the store; candidates without one are left out.
    """
    if not asked:
        return Checks([], [], "nothing was asked yet")
    size = Counter(len(query.candidates) for query in asked).most_common(1)[0][0]
    distinct = list({c.id: c for query in asked for c in query.candidates}.values())
    some = [distinct[i] for i in _sample([c.context for c in distinct], rng)]
    gold = np.array([_gold(store, candidate) for candidate in some])
    return clear_queries(some, gold, (size, count), {query.id for query in asked}, rng, top)


def clear_queries(
    candidates: Sequence[C],
    gold: Floats,
    shape: tuple[int, int],
    asked: Collection[str],
    rng: np.random.Generator,
    top: float = 0.1,
) -> Checks[C]:
    """At most Q queries of K distinct candidates, `shape` (K, Q), whose best one is far ahead by gold (N,).

    The gap from the best to the second best is among the largest (share `top`) of those of random groups of one
    context. Segments of one episode never meet, since they may overlap. Ids in `asked` are not asked again. A
    candidate stands in two queries only where there are too few. Gold that is not finite counts as missing.
    """
    size, count = shape
    if size < 2:
        return Checks([], [], "a query of one candidate has no best one")
    known = np.flatnonzero(np.isfinite(gold)).tolist()
    if len(known) < size:
        return Checks([], [], f"gold is known of {len(known)} candidates, and a check needs {size}")
    groups = _groups([candidates[i] for i in known], size, rng)
    if len(groups) * top < 1:
        least = f"{np.ceil(1 / top):.0f}"
        return Checks([], [], f"there are {len(groups)} groups of {size} comparable candidates, and {least} are needed")
    rows = np.array(known)[groups]
    ranked = np.sort(gold[rows].astype(np.float64), axis=1)
    gap = ranked[:, -1] - ranked[:, -2]
    # A quantile, not a size: gold is on any scale.
    least_gap = np.quantile(gap, 1 - top)
    if least_gap <= TINY * np.abs(gold[known]).max():
        return Checks([], [], "gold differs too little for an answer to be clear")
    clear = rows[gap >= least_gap]
    return _chosen(candidates, gold, clear[rng.permutation(len(clear))], asked, count)


def _chosen(candidates: Sequence[C], gold: Floats, rows: Integers, asked: Collection[str], count: int) -> Checks[C]:
    """The first rows of candidates that were not asked, those without a candidate in common before others."""
    queries = [(Query(tuple(candidates[i] for i in row)), candidates[row[np.argmax(gold[row])]].id) for row in rows]
    fresh = [(query, best) for query, best in queries if query.id not in asked]
    apart: list[tuple[Query[C], str]] = []
    rest: list[tuple[Query[C], str]] = []
    used: set[str] = set()
    for query, best in fresh:
        ids = {c.id for c in query.candidates}
        (apart if used.isdisjoint(ids) else rest).append((query, best))
        used |= ids
    picked = (apart + rest)[:count]
    expected = [[c.id for c in query.candidates].index(best) for query, best in picked]
    reason = (
        "" if len(picked) == count else f"{len(picked)} of {count}: no other clear ones are left that were not asked"
    )
    return Checks([query for query, _ in picked], expected, reason)


def _groups(candidates: Sequence[C], size: int, rng: np.random.Generator) -> Integers:
    """(Q, K) distinct random groups of one context and of distinct episodes, as indices."""
    by_context: dict[str, list[int]] = defaultdict(list)
    for i, candidate in enumerate(candidates):
        by_context[candidate.context].append(i)
    found: dict[tuple[int, ...], None] = {}
    for i in rng.integers(len(candidates), size=TRIES):
        members = by_context[candidates[i].context]
        if len(members) >= size:
            # Sorted, so that the same group in another order is not found again.
            group = sorted(members[j] for j in rng.choice(len(members), size, replace=False))
            origins = {kind_of(c).origin(c) for c in (candidates[j] for j in group)}
            if len(origins) == size:
                found[tuple(group)] = None
    return np.array(list(found), np.int64).reshape(-1, size)


def _sample(contexts: Sequence[str], rng: np.random.Generator) -> list[int]:
    """Which candidates to look at where there are many: whole contexts, so that groups stay whole, or a part of one."""
    by_context: dict[str, list[int]] = defaultdict(list)
    for i, context in enumerate(contexts):
        by_context[context].append(i)
    names = list(by_context)
    # Context by context: MOST single candidates of as many prompts would make no group at all.
    order = [i for at in rng.permutation(len(names)) for i in rng.permutation(by_context[names[at]]).tolist()]
    return sorted(order[:MOST])


def _gold(store: Store[C], candidate: C) -> float:
    """NaN where the store has none."""
    try:
        return float(store.gold([candidate])[0].sum())
    except DamagedError:
        return np.nan
