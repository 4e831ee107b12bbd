"""Numbers with their intervals. What is not defined has no value, and says why; never NaN.

Intervals are 95 % percentiles of a bootstrap over units: what hangs together is resampled together. Resampling units
that are alike is drawing how often each pattern comes up: that keeps large tables fast, and changes nothing.

`scipy.stats` takes a second to import, so that only what few commands need is taken from there.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any, Literal

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components
from scipy.special import stdtrit

from prefrl.stats.estimates import Estimate, undefined, wilson
from prefrl.types import Floats, Integers

RESAMPLES = 999
CORRELATION_RESAMPLES = 199
"""A rank correlation is sorted anew for each."""
FEW = 5
"""With fewer units than this a bootstrap says nothing."""
CHUNK = 4_000_000
"""Numbers that are drawn at once."""


def share(hits: int, count: int, nothing: str = "nothing to count") -> Estimate:
    """hits / count with Wilson's interval; `nothing` says why there is none where count is 0."""
    if not count:
        return undefined(nothing)
    low, high = wilson(hits / count, count)
    return Estimate(value=hits / count, low=low, high=high, count=int(count), how="Wilson")


def position_test(first: int, decided: int) -> float | None:
    """Exact two-sided p-value of `first` preferences for one of two places, of `decided`; None where that is 0."""
    if not decided:
        return None
    from scipy import stats

    return float(stats.binomtest(int(first), int(decided), 0.5).pvalue)


def mean(
    hits: Floats, unit: Integers, rng: np.random.Generator, resamples: int = RESAMPLES, what: str = "clusters"
) -> Estimate:
    """The mean of hits (n,) in [0, 1]; those of one unit (n,) hang together, and are resampled together.

    Wilson's interval where every hit is 0 or 1 and a unit of its own: of fractions, which scatter less, it would be too
    wide. Where all units have one mean a bootstrap sees no spread, and Wilson's over the number of units stands in.
    """
    if not len(hits):
        return undefined("no comparison of this sort")
    rows, sizes = patterns(np.column_stack([hits, np.ones(len(hits))]), unit)
    value, units = float(hits.mean()), int(sizes.sum())
    alone, alike = units == len(hits), units > 1 and np.ptp(rows[:, 0] / rows[:, 1]) == 0
    if alike or (alone and np.isin(hits, (0.0, 1.0)).all()):
        low, high = wilson(value, units)
        how = "Wilson" if alone else f"Wilson over {units} {what}"
        return Estimate(value=value, low=low, high=high, count=len(hits), how=how)
    sums = (weights @ rows for weights in draws(sizes, resamples, rng))
    return defined(np.array([value]), (s[:, 0] / s[:, 1] for s in sums), units, Estimate(count=len(hits)), what, 0.0)


def average(values: Floats, what: str = "candidates") -> Estimate:
    """The mean of values (n,), with Student's interval; without one where there are fewer than two."""
    if not len(values):
        return undefined("nothing was scored")
    centre = float(values.mean())
    found = Estimate(value=centre, count=len(values))
    error = float(values.std(ddof=1) / np.sqrt(len(values))) if len(values) > 1 else 0.0
    if not error:
        return found.model_copy(update={"how": "no interval: there is no spread"})
    low, high = (centre + error * stdtrit(len(values) - 1, (1 + side * 0.95) / 2) for side in (-1, 1))
    return found.model_copy(
        update={"low": float(low), "high": float(high), "how": f"Student over {len(values)} {what}"}
    )


def defined(
    value: Floats,
    drawn: Iterator[Floats],
    units: int,
    found: Estimate,
    what: str = "clusters",
    least: float = -math.inf,
) -> Estimate:
    """`found` with a value (1,) in [least, 1], and the percentiles of what was drawn; as it is where that is NaN.

    The percentiles are shifted by the resamples' bias, so that they lie around the value.
    """
    if not np.isfinite(value[0]):
        return found
    found = found.model_copy(update={"value": float(value[0]), "why": ""})
    if units < FEW:
        return found.model_copy(update={"how": f"no interval: only {units} {what}"})
    rows = np.concatenate(list(drawn))
    rows = rows[np.isfinite(rows)]  # a resample can be one for which the measure is not defined
    if not len(rows) or np.ptp(rows) < 1e-12:
        return found.model_copy(update={"how": "no interval: resampling shows no spread"})
    low, high = np.percentile(rows, (2.5, 97.5)) + value[0] - rows.mean()
    said = {"low": max(float(low), least), "high": min(float(high), 1.0), "how": f"bootstrap over {units} {what}"}
    return found.model_copy(update=said)


def patterns(parts: Floats, unit: Integers) -> tuple[Floats, Integers]:
    """The distinct rows (P, D) that the parts (n, D) of a unit (n,) add up to, and how many units (P,) have each."""
    at = numbered(unit)
    if len(at) > (units := int(at.max()) + 1):
        parts = np.asarray(csr_array((np.ones(len(at)), (at, np.arange(len(at)))), shape=(units, len(at))) @ parts)
    order = np.lexsort(parts.T)  # equal rows become neighbours
    ordered = parts[order]
    first = np.flatnonzero(np.r_[True, (ordered[1:] != ordered[:-1]).any(1)])
    return ordered[first], np.diff(np.r_[first, len(ordered)])


def draws(sizes: Integers, resamples: int, rng: np.random.Generator) -> Iterator[Floats]:
    """Resamples of units of P patterns: (n, P) how often each pattern comes up, in chunks."""
    for n in _chunks(resamples, len(sizes)):
        yield rng.multinomial(sizes.sum(), sizes / sizes.sum(), size=n).astype(np.float64)


def resampled(units: int, width: int, resamples: int, rng: np.random.Generator) -> Iterator[Floats]:
    """Resamples of units: (n, units) how often each comes up, in chunks that leave room for (n, width)."""
    for n in _chunks(resamples, max(units, width)):
        # Each resample counts in a range of its own, so that one bincount does for all.
        at = rng.integers(units, size=(n, units)) + units * np.arange(n)[:, None]
        yield np.bincount(at.ravel(), minlength=n * units).reshape(n, units).astype(np.float64)


def _chunks(total: int, width: int) -> Iterator[int]:
    at_once = max(CHUNK // width, 1)
    for start in range(0, total, at_once):
        yield min(at_once, total - start)


def numbered(column: Integers) -> Integers:
    """(n,) the same distinctions, numbered from 0 in order."""
    return np.unique(column, return_inverse=True)[1].reshape(-1)


def clusters(edges: Integers, group: Integers, candidates: int) -> tuple[Integers, str]:
    """Which comparisons (M,) hang together, and in what sense: "comparisons", "components" or "judgements".

    Comparisons that share a candidate, also by way of others, make one component. Where there are too few components
    to resample, those of one judgement are kept together at least.
    """
    links = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), shape=(candidates, candidates))
    _, component = connected_components(links, directed=False)
    of_edge = np.unique(component[edges[:, 0]], return_inverse=True)[1]
    if len(np.unique(of_edge)) == len(edges):
        return of_edge, "comparisons"
    if len(np.unique(of_edge)) >= FEW:
        return of_edge, "components"
    return np.unique(group, return_inverse=True)[1], "judgements"


def correlation(
    kind: Literal["spearman", "pearson", "kendall"],
    x: Floats,
    y: Floats,
    cluster: Sequence[object],
    rng: np.random.Generator,
) -> Estimate:
    """A correlation of x (N,) and y (N,), with the percentiles of a bootstrap over clusters (N,).

    Not defined where one of them is constant, or where there are fewer than three points.
    """
    value = correlate(kind, x, y)
    if value is None:
        return undefined(f"{len(x)} points" if len(x) < 3 else "all values are equal")
    at = np.unique(np.array([str(c) for c in cluster]), return_inverse=True)[1]
    members = np.split(np.argsort(at, kind="stable"), np.cumsum(np.bincount(at))[:-1])

    def drawn() -> Iterator[Floats]:
        for _ in range(CORRELATION_RESAMPLES):
            rows = np.concatenate([members[i] for i in rng.integers(len(members), size=len(members))])
            found = correlate(kind, x[rows], y[rows])
            yield np.array([np.nan if found is None else found])  # a resample can be constant

    return defined(np.array([value]), drawn(), len(members), Estimate(count=len(x)), least=-1.0)


def correlate(kind: Literal["spearman", "pearson", "kendall"], x: Floats, y: Floats) -> float | None:
    """The correlation alone; None where it is not defined."""
    if len(x) < 3 or np.ptp(x) == 0 or np.ptp(y) == 0 or np.isnan([x, y]).any():
        return None
    if kind == "spearman":  # every run asks for it, in each round
        value = float(np.corrcoef(_ranks(x), _ranks(y))[1, 0])
    else:
        from scipy import stats

        measure: Any = {"pearson": stats.pearsonr, "kendall": stats.kendalltau}[kind]
        value = float(measure(x, y).statistic)
    return value if np.isfinite(value) else None


def _ranks(values: Floats) -> Floats:
    """(N,) places in ascending order, from 1; equal values share the mean of theirs."""
    _, at, counts = np.unique(values, return_inverse=True, return_counts=True)
    places: Floats = (np.cumsum(counts) - (counts - 1) / 2)[at]
    return places
