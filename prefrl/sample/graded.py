"""Segments of several policies side by side, of better and worse ones say, so that they can be ranked.

Where policies differ in how good they are, a ranking of their segments tells more about the reward than one of segments
that are all alike (the setting of Brown et al. 2019, T-REX; here somebody answers, no order is taken for granted).
"""

from __future__ import annotations

from collections.abc import Mapping
from math import ceil

import numpy as np

from prefrl.policies.loaded import Loaded
from prefrl.protocols import ControlTask
from prefrl.sample.queries import across
from prefrl.sample.segments import cut, first_rollout, placed
from prefrl.types import Query, Segment

SPARE = 2
"""How many segments are cut for each that is asked about: two of one policy in one query are not to overlap."""
MOST = 16
"""How many environments are stepped at once."""


def graded(
    policies: Mapping[str, Loaded], task: ControlTask, size: int, count: int, rng: np.random.Generator
) -> list[Query[Segment]]:
    """`count` queries of `size` segments; each mixes as many policies as it can, with actions drawn from them.

    A segment's episode is named after its policy, which no page shows. Raises `ConfigError` for policies of other
    spaces, and `ValueError` where they do not hold enough segments.
    """
    for name, policy in policies.items():
        policy.check(task, name)
    if count <= 0:
        return []
    each = SPARE * ceil(size * count / len(policies)) + size
    pools = []
    for name, policy in policies.items():
        rollout = first_rollout(task, policy.act(rng), each, MOST, rng)
        pools.append(placed(task, cut(rollout, task.segment_steps, each, name, rng)))
    found = across(pools, size, count, rng)
    if len(found) < count:
        raise ValueError(
            f"{len(policies)} policies gave {len(found)} of {count} queries of {size} segments: make "
            "task.segment_seconds (or segment_steps) smaller, or name more policies"
        )
    return found


__all__ = ["graded"]
