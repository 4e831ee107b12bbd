"""Environments that several ranks step, each some of them; what came of it is put together once a rollout.

The policy acts for all of them on every rank, in arrays of the same shapes as on one: the same numbers are drawn, and
products of matrices round as they do there. So what happens in a rank's environments is to the bit what happens in them
in one process, whatever the others' rows hold meanwhile.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np

from prefrl.distributed import world
from prefrl.protocols import ControlTask, Environments, Parted, Transition
from prefrl.types import Bools, Floats

A = TypeVar("A", bound=np.ndarray)


class Divided:
    """n environments, of which this rank steps those in `mine`; implements `prefrl.protocols.Environments`.

    Between a reset and the end of a rollout the rows of all others are zeros, and of states there are no others: what
    the policy does not see needs no place among them.
    """

    def __init__(self, own: Environments, count: int, mine: range) -> None:
        self._own, self._count = own, count
        self.mine = slice(mine.start, mine.stop)

    def reset(self, rng: np.random.Generator) -> Floats:
        return np.concatenate(world().each(lambda: self._own.reset(rng)))

    def step(self, actions: Floats) -> Transition:
        return Transition(*map(self._among, self._own.step(actions[self.mine])))

    def states(self) -> Floats | None:
        return self._own.states()

    def legal(self) -> Bools | None:
        own = self._own.legal()
        return None if own is None else self._among(own)

    def _among(self, own: A) -> A:
        """(n, ...)"""
        found = np.zeros((self._count, *own.shape[1:]), own.dtype)
        found[self.mine] = own
        return found  # type: ignore[return-value]


def environments(task: ControlTask, count: int) -> Environments:
    """`count` environments that the ranks share, where they compute together and the task's can be parted.

    Else every rank steps all of them, and to the same bits: a task that ranks share has no chance but the generator's.
    """
    ranks = world()
    if ranks.size == 1 or count < ranks.size or not isinstance(task, Parted):
        return task.environments(count)
    mine = ranks.share(count)
    own = task.some_environments(count, mine)
    return task.environments(count) if own is None else Divided(own, count, mine)


def of_all(envs: Environments, rows: Floats | None) -> Floats | None:
    """(n, ...) of all environments, from rows that each rank knows for its own."""
    if rows is None or not isinstance(envs, Divided):
        return rows
    return np.concatenate(world().gathered(rows[envs.mine]))


__all__ = ["Divided", "environments", "of_all"]
