"""How well predicted preferences agree with judged ones. All take (M,) arrays and return NaN where undefined."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import log_expit, logsumexp

from prefrl.fit.settings import Ties
from prefrl.types import Floats, Integers

HOTTEST = 10.0
CERTAINTY = 0.5
"""Standard deviation of the logarithm of temperatures, before any comparison has been seen."""


def accuracy(predicted: Floats, preference: Floats) -> float:
    """The share of comparisons, ties left out, whose winner is predicted; an even prediction counts half."""
    decided = preference != 0.5
    if not decided.any():
        return float("nan")
    sides = np.sign(predicted[decided] - 0.5) * np.sign(preference[decided] - 0.5)
    return float((0.5 + 0.5 * sides).mean())


def brier(predicted: Floats, preference: Floats) -> float:
    """The mean squared distance from prediction to judgement (Brier 1950)."""
    return float(((predicted - preference) ** 2).mean()) if len(predicted) else float("nan")


def calibration_error(predicted: Floats, preference: Floats, bins: int = 10) -> float:
    """Expected calibration error: |mean predicted - mean judged| over equal-width bins, weighted by their counts.

    Both directions of each comparison are counted, so that the order of the candidates does not matter.
    """
    p, y = np.concatenate([predicted, 1 - predicted]), np.concatenate([preference, 1 - preference])
    if not len(p):
        return float("nan")
    at = np.minimum((p * bins).astype(int), bins - 1)  # 1.0 belongs to the last bin
    gaps = [abs(float((p[at == b] - y[at == b]).mean())) * float((at == b).mean()) for b in np.unique(at)]
    return float(sum(gaps))


@dataclass(frozen=True, eq=False)
class Answering:
    """How what is felt becomes an answer: which differences are called a tie, and how often it is another answer."""

    ties: Ties = "half"
    tie: Floats | float = 0.0
    """nu (Davidson) or the threshold (Rao and Kupper); one for all members, or one for each (E, 1)."""
    error: Floats | float = 0.0
    """(M,) how often an answer is one of the others, see `losses.with_errors`."""

    def of(self, at: Integers) -> Answering:
        """The same for the comparisons at these places."""
        return replace(self, error=self.error[at] if isinstance(self.error, np.ndarray) else self.error)

    def expected(self, logits: Floats) -> Floats:
        """(E, M) logits -> (M,) the preference that is expected: P(first) + P(tie) / 2, in the members' mean."""
        found: Floats = np.exp(self.log_expected(logits))
        return found

    def log_expected(self, logits: Floats) -> Floats:
        """Its logarithm, finite however sure the members are."""
        felt = logsumexp(self._log_felt(logits), axis=0) - math.log(len(logits))  # log of the members' mean probability
        outcomes = 2 if self.ties == "half" else 3
        # An error e is a blind answer with probability e n / (n - 1), and blind answers come to a half on average.
        blind = self.error * outcomes / (outcomes - 1) * np.ones(len(felt))
        p = np.exp(felt)
        found: Floats = np.where(blind == 0, felt, np.log(np.maximum(p + blind * (0.5 - p), np.finfo(np.float64).tiny)))
        return found

    def _log_felt(self, logits: Floats) -> Floats:
        if self.ties == "rao_kupper":
            wins, loses = log_expit(logits - self.tie), log_expit(-logits - self.tie)
            # A tie counts half: its probability is P(first) P(second) (exp(2 threshold) - 1), see `losses.rao_kupper`.
            tied: Floats = np.logaddexp(wins, wins + loses + np.log(np.expm1(2 * self.tie) / 2))
            return tied
        if self.ties == "half":
            felt: Floats = log_expit(logits)
            return felt
        # Over the geometric mean of both scores: weights exp(d / 2), exp(-d / 2), and nu for the tie.
        first, tie = logits / 2, np.log(self.tie)
        norm = np.logaddexp(np.logaddexp(first, -first), tie)
        davidson: Floats = np.logaddexp(first, tie - math.log(2)) - norm
        return davidson


def temperature(
    logits: Floats, preference: Floats, answering: Answering | None = None, weight: Floats | float = 1.0
) -> float:
    """What to divide logits (E, M) by, so that the members' mean probability fits preferences (M,) best.

    Guo et al. 2017, section 4.2, with a normal prior on log T about 0: a few comparisons cannot say much. 1 for none.
    `weight`: how much each comparison counts, which matters beside the prior.
    """
    answering = answering or Answering()

    def loss(log_t: float) -> float:
        cooled = logits / math.exp(log_t)
        return float((log_t / CERTAINTY) ** 2 / 2 + (weight * log_losses(cooled, preference, answering)).sum())

    if not len(preference):
        return 1.0
    from scipy.optimize import minimize_scalar  # half a second, which many commands do without

    bound = math.log(HOTTEST)
    return math.exp(float(minimize_scalar(loss, bounds=(-bound, bound), method="bounded").x))


def log_losses(logits: Floats, preference: Floats, answering: Answering) -> Floats:
    """(M,) negative log-likelihoods of preferences (M,) by the mean of the members' probabilities, in nats."""
    log_p, log_q = (answering.log_expected(sign * logits) for sign in (1, -1))
    return -(preference * log_p + (1 - preference) * log_q)
