"""What would be true of steps that were only imagined: the simulator states that they look like, and their gold."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeAlias

import numpy as np

from prefrl.protocols import Dynamics, Recognised, Retold
from prefrl.types import Floats

Retell: TypeAlias = Callable[[Floats, Floats], Retold]
"""As `prefrl.protocols.Retells` has it."""


def retelling(world: Dynamics) -> Retell | None:
    """None for a world whose states cannot be told from what is seen."""
    if not isinstance(world, Recognised):
        return None

    def retell(observations: Floats, actions: Floats) -> Retold:
        states = world.recognise(observations)
        _, gold, _ = world.advance(states, actions, np.random.default_rng(0))
        return Retold(world.observe(states), states, gold)

    return retell


__all__ = ["Retell", "retelling"]
