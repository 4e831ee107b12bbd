"""Which judgements are held out of a fit."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from prefrl.judgements import Judged, Rating, implied_pairs
from prefrl.types import C


def split(judged: Sequence[Judged[C]], share: float) -> npt.NDArray[np.bool_]:
    """(J,) bool: which judgements are held out. Those that share a candidate, also by way of others, stay together.

    The choice hangs on the id of a component's oldest query alone: it stays the same when judgements are added, so
    what was held out once is not trained on later, unless a new judgement joins two components of which the older one
    is trained on, or makes one that holds more than half of all: such a component is always trained on. Nothing is
    held out where that would leave nothing to train on.
    """
    if not share:
        return np.zeros(len(judged), bool)
    component = _components(judged)
    # `first` is the oldest judgement of each: they stand in the order in which they were given.
    _, first, sizes = np.unique(component, return_index=True, return_counts=True)
    small = first[2 * sizes <= len(judged)]
    # Ids are sha256, so their first 32 bits are an even draw that every later split repeats.
    chosen = [component[i] for i in small if int(judged[i].query.id[:8], 16) < share * 2**32]
    held_out = np.isin(component, chosen)
    rest = [one for one, out in zip(judged, held_out, strict=True) if not out]
    return held_out if prefers(rest) else np.zeros(len(judged), bool)


def prefers(judged: Sequence[Judged[C]]) -> bool:
    """Whether anything is preferred to anything; ties alone teach nothing."""
    levels = {level for one in judged if isinstance(one.judgement, Rating) for level in one.judgement.levels}
    return len(levels) > 1 or any(
        preference != 0.5
        for one in judged
        if not isinstance(one.judgement, Rating)
        for _, _, preference in implied_pairs(one.judgement, len(one.query.candidates))
    )


def _components(judged: Sequence[Judged[C]]) -> npt.NDArray[np.integer]:
    """(J,) which connected component of the graph of candidates each judgement lies in."""
    index: dict[str, int] = {}
    at = [[index.setdefault(c.id, len(index)) for c in one.query.candidates] for one in judged]
    links = [(row[0], other) for row in at for other in row]  # a star for each query connects its candidates
    first, second = zip(*links, strict=True)
    graph = coo_array((np.ones(len(links)), (first, second)), shape=(len(index), len(index)))
    _, component = connected_components(graph, directed=False)
    return np.asarray(component[[row[0] for row in at]])
