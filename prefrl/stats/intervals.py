"""Numbers with their intervals. What is not defined has no value, and says why; never NaN.

Intervals are 95 % percentiles of a bootstrap over units: what hangs together is resampled together. Resampling units
that are alike is drawing how often each pattern comes up: that keeps large tables fast, and changes nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats
from scipy.sparse import csr_array

from prefrl.types import Floats, Integers

RESAMPLES = 999
FEW = 5
"""With fewer units than this a bootstrap says nothing."""
CHUNK = 4_000_000
"""Numbers that are drawn at once."""


@dataclass(frozen=True)
class Measured:
    """A number with its 95 % interval; or no number, and why."""

    value: float | None = None
    low: float | None = None
    high: float | None = None
    count: int = 0
    """Items, answers or triads that it rests on."""
    reason: str = ""
    """Why the number, or its interval, is not there."""


def share(hits: int, count: int, nothing: str = "nothing to count") -> Measured:
    """hits / count with Wilson's interval (Wilson 1927); `nothing` says why there is none where count is 0."""
    if not count:
        return Measured(reason=nothing)
    interval = stats.binomtest(int(hits), int(count)).proportion_ci(method="wilson")
    return Measured(hits / count, float(interval.low), float(interval.high), int(count))


def position_test(first: int, decided: int) -> float | None:
    """Exact two-sided p-value of `first` preferences for one of two places, of `decided`; None where that is 0."""
    return float(stats.binomtest(int(first), int(decided), 0.5).pvalue) if decided else None


def mean(hits: Floats, unit: Integers, rng: np.random.Generator, resamples: int = RESAMPLES) -> Measured:
    """The mean of hits (n,) in [0, 1], n > 0; those of one unit (n,) are resampled together.

    Where all units have the same mean a bootstrap sees no spread, and Wilson's interval over units stands in.
    """
    rows, sizes = patterns(np.column_stack([hits, np.ones(len(hits))]), unit)
    value, units = float(hits.mean()), int(sizes.sum())
    if units > 1 and np.ptp(rows[:, 0] / rows[:, 1]) == 0:  # (P,): the mean of each pattern of units
        wilson = stats.binomtest(round(value * units), units).proportion_ci(method="wilson")
        return Measured(value, min(float(wilson.low), value), max(float(wilson.high), value), len(hits))
    sums = (weights @ rows for weights in draws(sizes, resamples, rng))  # (n, 2): hits, and how many there were
    return defined(np.array([value]), (s[:, 0] / s[:, 1] for s in sums), units, Measured(count=len(hits)))


def defined(value: Floats, drawn: Iterator[Floats], units: int, found: Measured) -> Measured:
    """`found` with a value (1,) at most 1, and the percentiles of what was drawn; as it is where the value is NaN.

    The percentiles are shifted by the resamples' bias, so that they lie around the value.
    """
    if not np.isfinite(value[0]):
        return found
    found = replace(found, value=float(value[0]), reason="")
    if units < FEW:
        return replace(found, reason=f"no interval: there are only {units} to resample")
    rows = np.concatenate(list(drawn))
    rows = rows[np.isfinite(rows)]
    if not len(rows) or np.ptp(rows) < 1e-12:
        return replace(found, reason="no interval: resampling shows no spread")
    low, high = np.percentile(rows, (2.5, 97.5)) + value[0] - rows.mean()
    return replace(found, low=float(low), high=min(float(high), 1.0))


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
