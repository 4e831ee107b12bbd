"""What a small network's outputs say of choices, and the gradient of the outputs, by hand in NumPy.

`MLPPolicy.log_prob` says the same in torch; tests hold one against the other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np

from prefrl.types import Bools, Floats

ILLEGAL = -1e9
"""The logit of an action that is not legal (Huang and Ontanon 2022, section 3): its probability is 0, and 0 times its
logarithm is 0 as well, where minus infinity would make NaN of it."""

Slopes: TypeAlias = tuple[Floats, Floats | None]
"""The gradients of the outputs (B, A), and of the log standard deviations (A,) where there are any."""


@dataclass(frozen=True, eq=False)
class Gaussian:
    """B choices of a normal distribution whose log standard deviations are the same in every state."""

    outputs: Floats
    """(B, A) the means."""
    choices: Floats
    """(B, A)."""
    log_std: Floats
    """(A,)."""

    @cached_property
    def _precision(self) -> Floats:
        found: Floats = np.exp(-self.log_std)
        return found

    @cached_property
    def _scaled(self) -> Floats:
        return (self.choices - self.outputs) * self._precision

    def log_prob(self) -> tuple[Floats, Floats]:
        """Log-probabilities (B, 1) and entropies (B, 1), in nats."""
        size = self.outputs.shape[1]
        # A Python number, which leaves float32 what it is.
        constant = float(self.log_std.sum()) + 0.5 * size * math.log(2 * math.pi)
        logp = -0.5 * np.einsum("ba,ba->b", self._scaled, self._scaled)[:, None] - constant
        # A Gaussian's entropy hangs on its std alone.
        return logp, np.full_like(logp, constant + 0.5 * size)

    def slopes(self, of_logp: Floats, of_entropy: float) -> Slopes:
        """From a loss's gradients of the log-probabilities (B, 1) and of each entropy."""
        weighted = of_logp * self._scaled
        # d logp / d log_std is scaled^2 - 1, and d entropy / d log_std is 1.
        of_std = np.einsum("ba,ba->a", weighted, self._scaled) - of_logp.sum() + of_entropy * len(of_logp)
        return weighted * self._precision, of_std


@dataclass(frozen=True, eq=False)
class Categorical:
    """B choices, one-hot."""

    outputs: Floats
    """(B, A) logits."""
    choices: Floats
    """(B, A)."""
    legal: Bools | None
    """(B, A); None where all actions were."""

    @cached_property
    def _logp(self) -> Floats:
        logits = self.outputs if self.legal is None else np.where(self.legal, self.outputs, np.float32(ILLEGAL))
        # Off the largest, so that nothing overflows.
        apart = logits - logits.max(1, keepdims=True)
        found: Floats = apart - np.log(np.exp(apart).sum(1, keepdims=True))
        return found

    @cached_property
    def _p(self) -> Floats:
        found: Floats = np.exp(self._logp)
        return found

    @cached_property
    def _entropy(self) -> Floats:
        found: Floats = -np.einsum("ba,ba->b", self._p, self._logp)[:, None]
        return found

    def log_prob(self) -> tuple[Floats, Floats]:
        """Log-probabilities (B, 1) and entropies (B, 1), in nats."""
        return np.einsum("ba,ba->b", self._logp, self.choices)[:, None], self._entropy  # one-hot: picks the chosen one

    def slopes(self, of_logp: Floats, of_entropy: float) -> Slopes:
        """From a loss's gradients of the log-probabilities (B, 1) and of each entropy.

        What is not legal has the probability 0, and so no slope.
        """
        found = of_logp * (self.choices - self._p)
        if of_entropy:
            found -= of_entropy * self._p * (self._logp + self._entropy)  # d entropy / d logit is -p (log p + entropy)
        return found, None


__all__ = ["ILLEGAL", "Categorical", "Gaussian", "Slopes"]
