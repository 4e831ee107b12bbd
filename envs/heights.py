"""How high things stand: what a teacher can go by where gold says nothing before a goal is reached.

Variant: a stand-in for a person, our own. Whoever watches an acrobot or a car in a valley prefers what swings higher,
long before it arrives; gymnasium pays the same for every step until then. Heights are used by a simulated teacher
alone (`labeler.sees=height`): gold, and with it every evaluation, stays the environment's own.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from prefrl.types import Floats


def _tip(states: Floats) -> Floats:
    """Of an acrobot's free end: -2 where it hangs, 2 where it stands; above 1 is the goal."""
    first, second = states[:, 0], states[:, 0] + states[:, 1]
    found: Floats = -np.cos(first) - np.cos(second)
    return found


def _car(states: Floats) -> Floats:
    """Of a car on its hill: -1 in the valley, about 1 at the goal."""
    found: Floats = np.sin(3 * states[:, 0])
    return found


HEIGHTS: dict[str, Callable[[Floats], Floats]] = {
    "Acrobot-v1": _tip,
    "MountainCar-v0": _car,
    "MountainCarContinuous-v0": _car,
}
"""Simulator states (T, S) -> heights (T,), by gymnasium's id."""
