"""How often answers go round in a circle."""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from prefrl.stats.estimates import Estimate
from prefrl.stats.intervals import RESAMPLES, mean
from prefrl.types import Floats, Integers

MOST_TRIADS = 200_000
"""More than these are sampled."""


def circular_triads(
    edges: Integers, preference: Floats, rng: np.random.Generator, resamples: int = RESAMPLES
) -> Estimate:
    """How many of three candidates, each compared with both others, go round in a circle (Kendall and Smith 1940).

    edges (M, 2) name candidates, preference (M,) is for the first; repeated comparisons are added up, and those that
    come to a tie left out. Coin flips make a quarter of the triads circular. Triads that share a comparison are
    resampled together.
    """
    edges, sign = _net(edges, preference)
    triads = _triads(edges, rng)
    if not len(triads):
        return Estimate(why="no three candidates were all compared with one another")
    # Of a < b < c: around a circle a beats b, b beats c and c beats a, or the other way round.
    ab, ac, bc = sign[triads].T
    around = (ab == bc) & (ab != ac)
    links = coo_array(
        (np.ones(2 * len(triads)), (np.tile(triads[:, 0], 2), triads[:, 1:].T.ravel())), shape=(len(edges), len(edges))
    )
    return mean(around.astype(np.float64), connected_components(links)[1][triads[:, 0]], rng, resamples)


def _net(edges: Integers, preference: Floats) -> tuple[Integers, Integers]:
    """(M', 2) distinct decided pairs, lower candidate first, and (M',) 1 where that one is preferred, else -1."""
    turned = edges[:, 0] > edges[:, 1]
    pairs, at = np.unique(np.where(turned[:, None], edges[:, ::-1], edges), axis=0, return_inverse=True)
    total = np.bincount(at.reshape(-1), np.where(turned, -1, 1) * np.sign(preference - 0.5), minlength=len(pairs))
    return pairs[total != 0], np.sign(total[total != 0]).astype(np.int64)


def _triads(edges: Integers, rng: np.random.Generator) -> Integers:
    """(W, 3) rows of edges (sorted, lower first) that make up triads a < b < c: ab, ac, bc. A sample, where many.

    Each triad is one pair of edges that leave its lowest candidate, so a sample of such pairs samples triads evenly.
    """
    _, start, degree = np.unique(edges[:, 0], return_index=True, return_counts=True)
    ends = np.cumsum(degree * (degree - 1) // 2)  # pairs of edges that leave each candidate, counted through
    total = int(ends[-1]) if len(ends) else 0
    drawn = np.arange(total) if total <= MOST_TRIADS else rng.choice(total, MOST_TRIADS, replace=False)
    low = np.searchsorted(ends, drawn, side="right")
    nth = drawn - (ends - degree * (degree - 1) // 2)[low]
    # The nth of the pairs (0, 1), (0, 2), (1, 2), (0, 3) ...: `second` starts at number second (second - 1) / 2.
    second = ((1 + np.sqrt(1 + 8 * nth)) // 2).astype(np.int64)
    ab, ac = start[low] + nth - second * (second - 1) // 2, start[low] + second
    width = int(edges.max(initial=0)) + 1
    codes = edges[:, 0] * width + edges[:, 1]  # one increasing number an edge, to look up bc in
    wanted = edges[ab, 1] * width + edges[ac, 1]
    bc = np.minimum(np.searchsorted(codes, wanted), max(len(codes) - 1, 0))
    return np.stack([ab, ac, bc], axis=1)[codes[bc] == wanted] if len(codes) else np.zeros((0, 3), np.int64)
