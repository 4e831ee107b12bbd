"""How a simulated teacher's noise is tied to the task: thresholds and rationality from the gold of what was asked.

Variant: the teachers of B-Pref (Lee et al. 2021, section 4.2) for K candidates, ties being groups of near ones. Gold
comes on any scale, so no absolute number suits every task: thresholds and beta can be found from rates on what was
asked so far; the paper's own adaptive threshold is `session_threshold`. The draws themselves are in `label/oracle.py`.

Everything here works on blocks: an array (Q, K) of what the teacher sees in Q queries of K candidates, one for each K.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic

import numpy as np
from scipy.special import expit

from prefrl.kinds import kind_of
from prefrl.protocols import Store
from prefrl.types import C, Floats, Integers, Query

LARGEST = 700.0
"""The largest logit that is worked with: its exponential is still finite."""


@dataclass(frozen=True)
class Survey(Generic[C]):
    """What has been asked so far, this session's queries included, with its gold."""

    queries: list[Query[C]]
    """By id, so that nothing hangs on the order in which answers came."""
    gold: dict[str, list[Floats]]
    """Query -> an array for each candidate."""
    fresh: frozenset[str]
    """The queries of this session: those that the labeler can answer now."""
    first: bool
    """Whether nothing was answered or skipped before this session."""


def survey(store: Store[C], labeler: str) -> Survey[C]:
    """Every query of the store but those that cannot be compared."""
    judged: list[Query[C]] = [j.query for j in store.judged()]
    unanswered: list[Query[C]] = store.open_queries()
    fresh: list[Query[C]] = store.open_queries(labeler)
    found = {q.id: q for q in judged + unanswered}
    queries = [found[id] for id in sorted(found)]
    first = not judged and len(fresh) == len(unanswered)
    return Survey(queries, {q.id: store.gold(q.candidates) for q in queries}, frozenset(q.id for q in fresh), first)


@dataclass(frozen=True)
class Limits:
    """A teacher's noise in the units of the gold."""

    skip_below: float = -np.inf
    """A query whose best candidate is worth less is skipped."""
    tie_within: float = 0.0
    """Candidates no further apart are equal."""
    rationality: float | None = None
    """The beta of Bradley-Terry and Plackett-Luce, in 1 / gold; None is never wrong."""
    cuts: tuple[float, ...] = ()
    """Where one level of a rating ends and the next begins."""
    length_price: float = 0.0
    """Gold that a character is worth."""
    length_mean: float = 0.0
    """Characters of a response that is neither long nor short."""


def discounted(gold: Sequence[Floats], discount: float) -> Floats:
    """(K,) sums over the T steps of each candidate, step t weighted by discount^(T - 1 - t): the last counts in full.

    Raises `ValueError` where one is not finite.
    """
    # Backwards: a myopic teacher remembers the end best.
    seen = np.array([(g * discount ** np.arange(len(g))[::-1]).sum() for g in gold], float)
    if not np.isfinite(seen).all():
        raise ValueError(f"a simulated teacher needs finite gold, got {seen}; use another labeler")
    return seen


def lengths(query: Query[C]) -> Floats:
    """(K,) characters of each candidate, 0 where there are none to see."""
    return np.array([kind_of(c).words(c) for c in query.candidates], float)


def blocks(values: Sequence[Floats]) -> list[Floats]:
    """Arrays (K,) of several queries, stacked by their K."""
    by_size: dict[int, list[Floats]] = defaultdict(list)
    for one in values:
        by_size[len(one)].append(one)
    return [np.stack(by_size[size]) for size in sorted(by_size)]


def gaps(seen: Sequence[Floats | Integers]) -> Floats:
    """The absolute difference of every pair that stands in one query, over all blocks."""
    pairs = [np.triu_indices(block.shape[1], 1) for block in seen]
    found = [np.abs(block[:, i] - block[:, j]).ravel() for block, (i, j) in zip(seen, pairs, strict=True)]
    return np.concatenate(found).astype(float)


def tie_groups(block: Floats, tie_within: float) -> Integers:
    """(Q, K) ranks, 0 is best; a candidate joins the group above while it is within reach of that group's best."""
    order = np.argsort(-block, axis=1, kind="stable")  # equal ones stay in the query's own order
    ranked = np.take_along_axis(block, order, 1)
    best, groups = ranked[:, 0], np.zeros(block.shape, np.int64)
    for k in range(1, block.shape[1]):
        apart = best - ranked[:, k] > tie_within
        best = np.where(apart, ranked[:, k], best)
        groups[:, k] = groups[:, k - 1] + apart
    found = np.empty_like(groups)
    np.put_along_axis(found, order, groups, 1)  # from the order of worth back to that of the query
    return found


def group_means(block: Floats, groups: Integers) -> Floats:
    """(Q, K): what is seen, with the mean of its group in the place of each candidate."""
    same = groups[:, :, None] == groups[:, None, :]  # (Q, K, K)
    means: Floats = (same * block[:, None, :]).sum(2) / same.sum(2)
    return means


def skip_threshold(seen: Sequence[Floats], rate: float) -> float:
    """What leaves the best candidate of at most a share `rate` of the queries below it."""
    best = np.sort(np.concatenate([block.max(1) for block in seen]))
    return float(best[int(rate * len(best) + 1e-9)])  # 0.29 * 100 is less than 29 in floating point


def tie_threshold(seen: Sequence[Floats], rate: float) -> float:
    """The widest reach that ties at most a share `rate` of all pairs; 0 where equal gold alone ties more."""
    reach = np.unique(gaps(seen))
    found = bisect_right(reach, rate, key=lambda within: float(np.mean(_tied(seen, within))))
    return float(reach[found - 1]) if found else 0.0


def _tied(seen: Sequence[Floats], within: float) -> Floats:
    """1 for each pair that is a tie, 0 for the others."""
    tied: Floats = (gaps([tie_groups(block, within) for block in seen]) == 0).astype(float)
    return tied


def rationality_for(seen: Sequence[Floats], tie_within: float, rate: float) -> float | None:
    """The beta at which a share `rate` of the decided pairs is expected to be wrong; None where all are ties.

    A pair is in the wrong order with probability 1 / (1 + exp(beta gap)): under Bradley-Terry, and for any two groups
    of a ranking under Plackett-Luce. Raises `ValueError` where there are no pairs.
    """
    pairs = gaps([group_means(block, tie_groups(block, tie_within)) for block in seen])
    if not len(pairs):
        raise ValueError("error_rate is a share of pairs, and no query asked has two candidates; give rationality")
    # In logarithms: gold can be of any size, and so can the beta that suits it.
    decided = np.log(pairs[pairs > 0])
    if not len(decided):
        return None

    from scipy.optimize import brentq  # half a second, which few commands need

    def excess(log_beta: float) -> float:
        return float(expit(-np.exp(np.minimum(log_beta + decided, np.log(LARGEST)))).mean()) - rate

    # Below, every pair is a coin flip, and above none is wrong: the root lies in between.
    low, high = -np.log(LARGEST) - decided.max() - 20.0, np.log(LARGEST) - decided.min()
    return float(np.exp(brentq(excess, low, high, xtol=1e-12)))


def session_threshold(asked: Survey[C], epsilon: float, compat: bool) -> float:
    """B-Pref's adaptive threshold: epsilon times the mean gold of a segment in this session (Lee et al. 2021, 4.2).

    The paper takes the mean return of recent episodes, times segment over episode length: the same for segments drawn
    evenly. With `compat` epsilon comes in twice after the first session, as in the code that the paper's family
    shares. A mean that is not positive turns the threshold off there, and is an error here.
    """
    mean = float(np.mean([g.sum() for id in asked.fresh for g in asked.gold[id]]))
    if mean <= 0 and not compat:
        raise ValueError(
            f"skip_epsilon and tie_epsilon are shares of the mean gold of a segment, which must be positive, got "
            f"{mean:.4g}; use skip_rate and tie_rate"
        )
    return epsilon * mean * (epsilon if compat and not asked.first else 1.0)
