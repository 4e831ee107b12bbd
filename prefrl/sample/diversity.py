"""Points that differ from one another, out of (Q, D) features of queries. Ties go to the first, so order counts.

Variants: greedy k-center (Gonzalez 1985); medoids (Biyik and Sadigh 2018), by the alternation of Park and Jun 2009 from
k-center in place of their own start; and the greedy mode of a determinantal point process (Biyik et al. 2019), with the
median distance as its scale. Left out: boundary medoids and successive elimination, also of the 2018 paper.
"""

from __future__ import annotations

from typing import Literal

import numpy as np

from prefrl.types import Floats, Integers

PASSES = 100
"""Of k-medoids; it ends much earlier."""


def k_center(points: Floats, count: int) -> Integers:
    """The first point, then again and again the one farthest from all chosen (Gonzalez 1985): O(Q count D).

    The largest distance of any point to its nearest centre is at most twice the smallest possible.
    """
    chosen: list[int] = []
    nearest = np.full(len(points), np.inf)
    for _ in range(count):
        chosen.append(int(nearest.argmax()))
        nearest = np.minimum(nearest, np.square(points - points[chosen[-1]]).sum(1))
        nearest[chosen[-1]] = -1.0  # below every distance, so that equal points do not bring it up again
    return np.array(chosen, np.int64)


def k_medoids(points: Floats, count: int) -> Integers:
    """The middle points of `count` clusters, which outliers do not attract (Biyik and Sadigh 2018, section 4.2).

    Starts from `k_center`; then points join their nearest medoid and each cluster takes the point with the smallest
    sum of distances, until nothing changes (Park and Jun 2009).
    """
    distances = _distances(points, "euclidean")
    medoids = k_center(points, count)
    for _ in range(PASSES):
        cluster = distances[:, medoids].argmin(1)
        cluster[medoids] = np.arange(count)  # equal points: each medoid keeps its own cluster
        members = [np.flatnonzero(cluster == k) for k in range(count)]
        moved = np.array([at[distances[np.ix_(at, at)].sum(1).argmin()] for at in members])
        if (moved == medoids).all():
            break
        medoids = moved
    return medoids


def dpp(points: Floats, quality: Floats, count: int) -> Integers:
    """Greedy mode of a determinantal point process: good points that are unlike (Biyik et al. 2019).

    Its kernel is quality_i quality_j exp(-d_ij^2 / 2 h^2), with the median distance as h. Each step adds the point
    that raises the determinant most, with one new row of a Cholesky factor (Chen et al. 2018, algorithm 1):
    O(Q count^2).
    """
    kernel = _similarity(points) * np.outer(quality, quality)
    left = kernel.diagonal().copy()
    rows = np.zeros((count, len(points)))
    chosen: list[int] = []
    for k in range(count):
        best = int(np.where(np.isin(np.arange(len(left)), chosen), -np.inf, left).argmax())
        if left[best] > 0:  # else it repeats what is chosen, and adds nothing to the factor
            rows[k] = (kernel[best] - rows[:k, best] @ rows[:k]) / np.sqrt(left[best])
            left -= np.square(rows[k])
        chosen.append(best)
    return np.array(chosen, np.int64)


def _similarity(points: Floats) -> Floats:
    squared = _distances(points, "sqeuclidean")
    scale = float(np.median(squared[squared > 0])) if (squared > 0).any() else 1.0
    similar: Floats = np.exp(-squared / (2 * scale))
    return similar


def _distances(points: Floats, metric: Literal["euclidean", "sqeuclidean"]) -> Floats:
    """(N, N) between all points (N, D)."""
    from scipy.spatial.distance import cdist  # a quarter of a second, which few runs need

    return np.asarray(cdist(points, points, metric))
