"""Observations of mean 0 and std 1 for a policy, whose first layers follow when the statistics move."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from prefrl.types import Floats, State

STEADY = 2.0
"""By how much the scale of an input may change at once for the first layers to follow it."""
STILL = 1e-8
"""The variance of an input that does not change."""
CLIP = 10.0
"""Normalised observations are clipped to this many standard deviations."""


@dataclass(frozen=True, eq=False)
class Scaling:
    """What the statistics were when this was made, to act with."""

    mean: Floats
    scale: Floats
    """(O,) float32: what is taken off, and what the rest is multiplied by."""
    clip: float = CLIP
    """Standard deviations."""

    def __call__(self, observations: Floats) -> Floats:
        """(..., O) -> (..., O) float32."""
        scaled = (observations - self.mean) * self.scale
        # A state far outside of what was seen would otherwise saturate the first layer.
        # As np.clip, in half its time.
        return np.minimum(np.maximum(scaled, -self.clip, out=scaled), self.clip, out=scaled)


class Move(NamedTuple):
    """How normalised inputs changed: a new one times `ratio`, plus `shift`, is the old one. (O,) each."""

    ratio: Floats
    shift: Floats

    @torch.no_grad()
    def fold(self, weight: Tensor, bias: Tensor) -> None:
        """Make a first layer, (O, out) and (out,), do on new inputs what it did on old ones."""
        by, moved = (torch.from_numpy(x).to(weight) for x in self)
        bias += moved @ weight
        weight *= by[:, None]


class Normaliser:
    """The mean and the variance of all observations so far; before the first ones, 0 and 1."""

    def __init__(self, size: int, calm: bool = False) -> None:
        """`calm`: an input that never changed keeps its scale, and is not blown up where it changes for the first time,
        in a state where the critic knows nothing: its guess would then outweigh every return."""
        self.calm = calm
        self.mean, self.variance, self.count = np.zeros(size), np.ones(size), 0.0
        self.raw = False
        """Whether observations are seen as they are, for good: by a policy that learned without a normaliser."""
        self.frozen = False
        """Whether the statistics stay what they are, for good."""

    @property
    def scale(self) -> Floats:
        found: Floats = 1.0 / np.sqrt(self.variance + 1e-8)  # eps: some inputs never change
        return np.where(self.variance > STILL, found, 1.0) if self.calm else found

    def now(self) -> Scaling:
        mean, scale = self.mean.astype(np.float32), self.scale.astype(np.float32)
        return Scaling(mean, scale, np.inf if self.raw else CLIP)

    def observe(self, observations: Floats) -> Move | None:
        """Add observations (..., O) to the statistics (Chan et al. 1979).

        First layers are to change with the move that is returned, so that what the policy does stays the same (as
        Pop-Art does for outputs, van Hasselt et al. 2016): a mean that moved by a fifth of a standard deviation has
        ruined policies. The first time there is none, when weights are random and are to see inputs of one size. Never
        between acting and learning: the probability ratio would not start at 1.
        """
        if self.raw or self.frozen:
            return None
        mean, scale = self.mean, self.scale
        # In float64: float32 sums lose small changes over many rounds.
        new = observations.reshape(-1, observations.shape[-1]).astype(np.float64)
        total = self.count + len(new)
        delta = new.mean(0) - self.mean
        squares = self.variance * self.count + new.var(0) * len(new) + delta**2 * self.count * len(new) / total
        self.mean = self.mean + delta * len(new) / total
        known, self.variance, self.count = self.count > 0, squares / total, total
        return self._move(mean, scale) if known else None

    def state(self) -> State:
        found = {"mean": self.mean, "variance": self.variance, "count": self.count}
        flags = {"raw": self.raw, "frozen": self.frozen}
        return found | {name: True for name, is_set in flags.items() if is_set}

    def load(self, state: State) -> None:
        self.mean, self.variance, self.count = state["mean"], state["variance"], state["count"]
        self.raw, self.frozen = state.get("raw", False), state.get("frozen", False)

    def _move(self, mean: Floats, scale: Floats) -> Move:
        """From these statistics (O,) to the present ones."""
        ratio, shift = scale / self.scale, (self.mean - mean) * scale
        # An input that hardly changed before was blown up, and clipped: its weights are not to become as large.
        steady = (ratio > (0 if self.calm else 1 / STEADY)) & (ratio < STEADY)
        return Move(np.where(steady, ratio, 1.0), np.where(steady, shift, 0.0))


__all__ = ["CLIP", "STEADY", "Move", "Normaliser", "Scaling"]
