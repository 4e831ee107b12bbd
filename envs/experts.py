"""Experts that are known without learning: what to clone where no run and no zip is at hand.

Variant: our own, after the swing-up by energy of Åström and Furuta 2000: pump the pendulum up to the energy that it has
when it stands, and hold it there by feedback of angle and speed. Over random starts its return is about -155.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from prefrl.types import Floats


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


EXPERTS: dict[str, tuple[int, Callable[[Floats], Floats]]] = {"Pendulum-v1": (3, _swing_up)}
"""O, and observations (n, O) -> actions (n, A), by gymnasium's id; for the environment's own options."""
