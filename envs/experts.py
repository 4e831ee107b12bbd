"""Experts that are known without learning: what to clone where no run and no zip is at hand.

Variant: our own, after the swing-up by energy of Åström and Furuta 2000: pump the pendulum up to the energy that it has
when it stands, and hold it there by feedback of angle and speed. Over random starts its return is about -155. In the
fork straight lines, past the disc on a side that is drawn for each episode.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from prefrl.envs.toys import GOAL
from prefrl.types import Floats

BESIDE = 1.2
"""How far from the middle the expert passes the disc of the fork."""


def _swing_up(observations: Floats) -> Floats:
    """(n, 3) cosine, sine and speed of Pendulum-v1 -> (n, 1) torques."""
    cosine, sine, speed = observations.astype(np.float64).T
    # Per unit of inertia; 0 for a pendulum that stands still on top.
    energy = speed**2 / 2 + 15.0 * (cosine - 1.0)
    pump = -0.3 * speed * energy
    at_rest = np.abs(speed) + np.abs(sine) < 0.05  # where it hangs still there is no speed to pump with
    hold = -10.0 * np.arctan2(sine, cosine) - 2.5 * speed
    torque = np.where(cosine > 0.7, hold, np.where(at_rest, 2.0, pump))
    found: Floats = np.clip(torque, -2.0, 2.0).astype(np.float32)[:, None]
    return found


def _round_the_disc(observations: Floats, mood: Floats) -> Floats:
    """(n, 2) places in the fork, and (n,) in [0, 1) -> (n, 2) steps to the goal, of one length: left below a half."""
    side = np.where(mood < 0.5, -1.0, 1.0)
    beside = np.stack([BESIDE * side, np.zeros(len(side))], 1)
    below = (observations[:, 1] < -0.05)[:, None]
    way = np.where(below, beside, GOAL) - observations
    far = np.linalg.norm(way, axis=1, keepdims=True)
    found: Floats = (way / np.maximum(far, 0.1)).astype(np.float32)  # the last step is a shorter one
    return found


def _round_the_near_side(observations: Floats) -> Floats:
    return _round_the_disc(observations, np.where(observations[:, 0] < 0, 0.0, 1.0))


EXPERTS: dict[str, tuple[int, Callable[[Floats], Floats]]] = {
    "Pendulum-v1": (3, _swing_up),
    "fork": (2, _round_the_near_side),
}
"""O, and observations (n, O) -> actions (n, A), by the task's name; for the environment's own options."""
MOODS: dict[str, Callable[[Floats, Floats], Floats]] = {"fork": _round_the_disc}
"""Of experts who do not act alike in every episode: observations (n, O), and (n,) numbers in [0, 1), drawn for each
episode, -> actions (n, A)."""
