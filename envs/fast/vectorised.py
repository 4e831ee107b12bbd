"""The one vectoriser: n environments of any world that is a value, stepped in one call."""

from __future__ import annotations

import numpy as np

from prefrl.protocols import Dynamics, Transition
from prefrl.types import Bools, Floats

SHOWN = 10
"""So many of the legal actions stand in a message."""


class Vectorised:
    """n environments of one `Dynamics`; implements `prefrl.protocols.Environments`."""

    def __init__(self, dynamics: Dynamics, count: int, horizon: int) -> None:
        self._dynamics, self._count, self._horizon = dynamics, count, horizon
        self._rng = np.random.default_rng(0)
        self._states: Floats = np.zeros((count, 0))
        self._legal: Bools | None = None
        self._elapsed = np.zeros(count, np.int64)

    def reset(self, rng: np.random.Generator) -> Floats:
        self._rng = rng
        self._states = self._dynamics.start(self._count, rng)
        self._legal = self._dynamics.legal(self._states)
        self._elapsed[:] = 0
        return self._dynamics.observe(self._states)

    def step(self, actions: Floats) -> Transition:
        """Raises `ValueError` for an action that is not legal."""
        if self._legal is not None:
            _check(actions, self._legal)
        states, rewards, terminated = self._dynamics.advance(self._states, actions, self._rng)
        self._elapsed += 1
        truncated = (self._elapsed >= self._horizon) & ~terminated
        final = observations = self._dynamics.observe(states)
        ended = terminated | truncated
        if ended.any():
            states[ended] = self._dynamics.start(int(ended.sum()), self._rng)
            self._elapsed[ended] = 0
            observations = self._dynamics.observe(states)
        self._states, self._legal = states, self._dynamics.legal(states)
        return Transition(observations, rewards, terminated, truncated, final)

    def states(self) -> Floats:
        return self._states

    def legal(self) -> Bools | None:
        return self._legal


def _check(actions: Floats, legal: Bools) -> None:
    chosen = actions.argmax(1)
    wrong = np.flatnonzero(~legal[np.arange(len(chosen)), chosen])
    if len(wrong):
        at = int(wrong[0])
        there = np.flatnonzero(legal[at]).tolist()
        some = ", ".join(map(str, there[:SHOWN])) + (", ..." if len(there) > SHOWN else "")
        raise ValueError(
            f"action {chosen[at]} of environment {at} is not legal there; expected one of [{some}]: use a "
            "learner that keeps to legal actions, such as learner.kind=control"
        )
