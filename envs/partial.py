"""What a policy does not get to see: hidden numbers, moments without sight, and the last few observations at once."""

from __future__ import annotations

import numpy as np

from prefrl.protocols import Environments, Transition
from prefrl.types import Bools, Floats


class Partial:
    """Environments whose observations lack some numbers; implements `prefrl.protocols.Environments`.

    First the numbers in `hide` are left out; then each observation is all zeros with probability `flicker` (Hausknecht
    and Stone 2015); then the last `stack` are put one after another, the oldest first. At the start of an episode the
    first observation stands in for those before it.
    """

    def __init__(self, envs: Environments, size: int, hide: tuple[int, ...], flicker: float, stack: int) -> None:
        self._envs, self._flicker = envs, flicker
        self._seen = np.setdiff1d(np.arange(size), hide)
        self._stack = stack
        self._rng = np.random.default_rng(0)
        self._history: Floats = np.zeros((0, stack, len(self._seen)), np.float32)

    def reset(self, rng: np.random.Generator) -> Floats:
        # A stream of its own, so that what happens is what would have happened in full sight.
        (self._rng,) = rng.spawn(1)
        return self._begun(self._through(self._envs.reset(rng)))

    def step(self, actions: Floats) -> Transition:
        step = self._envs.step(actions)
        ended = step.terminated | step.truncated
        last = self._through(step.final_observations)
        self._history = np.concatenate([self._history[:, 1:], last[:, None]], 1)
        final = observations = self._rows()
        if ended.any():
            first = self._through(step.observations)[ended]
            self._history[ended] = first[:, None]  # (k, 1, O) fills (k, stack, O)
            observations = self._rows()
        return step._replace(observations=observations, final_observations=final)

    def states(self) -> Floats | None:
        return self._envs.states()

    def legal(self) -> Bools | None:
        return self._envs.legal()

    def _begun(self, observations: Floats) -> Floats:
        self._history = np.repeat(observations[:, None], self._stack, 1)
        return self._rows()

    def _rows(self) -> Floats:
        """(n, stack x O), a copy."""
        return self._history.reshape(len(self._history), -1).copy()

    def _through(self, observations: Floats) -> Floats:
        """What comes through of observations (n, size)."""
        seen = observations[:, self._seen]
        if not self._flicker:
            return seen
        return np.where(self._rng.random((len(seen), 1)) < self._flicker, np.float32(0), seen)


__all__ = ["Partial"]
