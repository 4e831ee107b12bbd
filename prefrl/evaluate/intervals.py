"""Shares and correlations with 95 % intervals that know which observations hang together."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

import numpy as np
from scipy import stats
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from prefrl.evaluate.calibration import wilson
from prefrl.evaluate.card import Estimate, undefined
from prefrl.types import Floats, Integers

RESAMPLES = 999
CORRELATION_RESAMPLES = 199
"""A rank correlation is sorted anew for each."""
FEW = 5
"""With fewer clusters than this a bootstrap says nothing."""


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


def share(hits: Floats, cluster: Integers, rng: np.random.Generator, what: str = "clusters") -> Estimate:
    """The mean of hits (M,) in [0, 1], with an interval over clusters (M,).

    Wilson's where every hit is a cluster of its own; else the percentiles of a bootstrap of clusters. Where all
    clusters agree a bootstrap sees no spread: Wilson's over the number of clusters stands in.
    """
    if not len(hits):
        return undefined("no comparison of this sort")
    value, at = float(hits.mean()), np.unique(cluster, return_inverse=True)[1]
    sums, counts = np.bincount(at, hits), np.bincount(at)
    if counts.max() == 1 or np.ptp(sums / counts) == 0:
        low, high = wilson(value, len(counts))
        how = "Wilson" if counts.max() == 1 else f"Wilson over {len(counts)} {what}"
        return Estimate(value=value, low=max(low, 0.0), high=min(high, 1.0), count=len(hits), how=how)
    if len(counts) < FEW:
        return Estimate(value=value, count=len(hits), how=f"no interval: only {len(counts)} {what}")
    # (RESAMPLES, clusters): how often each cluster is drawn, which is all that sums need.
    drawn = rng.multinomial(len(counts), np.full(len(counts), 1 / len(counts)), size=RESAMPLES)
    # A ratio of sums, as clusters differ in size: a mean of their means would weigh small ones too much.
    low, high = np.percentile((drawn @ sums) / (drawn @ counts), (2.5, 97.5))
    return Estimate(value=value, low=low, high=high, count=len(hits), how=f"bootstrap over {len(counts)} {what}")


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
    if len(members) < FEW:
        return Estimate(value=value, count=len(x), how=f"no interval: only {len(members)} clusters")
    found = []
    for _ in range(CORRELATION_RESAMPLES):
        rows = np.concatenate([members[i] for i in rng.integers(len(members), size=len(members))])
        found.append(correlate(kind, x[rows], y[rows]))
    low, high = np.percentile([f for f in found if f is not None] or [np.nan], (2.5, 97.5))
    if not np.isfinite(low):
        return Estimate(value=value, count=len(x), how="no interval: resamples are constant")
    return Estimate(value=value, low=low, high=high, count=len(x), how=f"bootstrap over {len(members)} clusters")


def correlate(kind: Literal["spearman", "pearson", "kendall"], x: Floats, y: Floats) -> float | None:
    """The correlation alone; None where it is not defined."""
    if len(x) < 3 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return None
    measure: Any = {"spearman": stats.spearmanr, "pearson": stats.pearsonr, "kendall": stats.kendalltau}[kind]
    value = float(measure(x, y).statistic)
    return value if np.isfinite(value) else None
