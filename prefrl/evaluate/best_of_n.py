"""Best-of-n: of n responses to a prompt the one that scores highest, how good it is, and how far from the base.

It needs no learning, and much sampling: what a learner should beat at the same distance from its start. The estimate
from one pool is that of WebGPT's appendix (Nakano et al. 2021; also Gao et al. 2023), for scores that may tie or be
missing as well.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.special import gammaln

from prefrl.types import Floats, Integers


def best(scores: Floats) -> Integers:
    """(..., K) scores -> (...): which is the highest, the first of equals. NaN never wins; where all are, the first."""
    found: Integers = np.where(np.isnan(scores), -np.inf, scores).argmax(-1)
    return found


def kl_bound(n: ArrayLike) -> Any:
    """log n - (n - 1) / n, in nats: KL(best of n || base) where no response comes twice (Stiennon et al. 2020).

    Where responses repeat, or their scores tie, the KL is smaller (Beirami et al. 2024).
    """
    count = np.asarray(n, np.float64)
    return np.log(count) - (count - 1) / count


def masses_of_best(masses: Floats, n: int) -> Floats:
    """(C,) the probabilities that the best of n is of each class of equal scores, from those of one draw.

    `masses` (C,): worst class first, adding up to 1. Within a class the shares stay as they are, so these are enough
    for the KL between all responses.
    """
    upto = np.cumsum(masses)
    # F^n - (F - m)^n, without the difference of two numbers that are nearly the same.
    with np.errstate(divide="ignore", invalid="ignore"):
        inside = -np.expm1(n * np.log1p(-np.minimum(masses / upto, 1.0)))
    return np.where(masses > 0, upto**n * inside, 0.0)


def kl(masses: Floats, n: int) -> float:
    """KL(best of n || base) in nats, exactly, for a base that can be enumerated; `masses` as in `masses_of_best`."""
    drawn = masses_of_best(masses, n)
    some = drawn > 0  # the rest counts as 0 log 0
    return float((drawn[some] * np.log(drawn[some] / masses[some])).sum())


def expected(judged: Floats, measured: Floats) -> Floats:
    """What the best of n is worth on average, for every n up to the N responses that there are to each prompt.

    judged (P, N): the scores that choose; measured (P, N): those that count, which may be the same. Returns (P, N):
    column n - 1 is unbiased for n, being the mean over all sets of n of a prompt's N responses. Of equal scores each is
    as likely to be chosen. NaN in `judged` never wins, as in `best`; in `measured` it makes all of its prompt NaN.
    """
    values = np.where(np.isnan(judged), -np.inf, judged)
    order = np.argsort(values, 1, kind="stable")
    ranked = _shared(np.take_along_axis(values, order, 1), np.take_along_axis(measured, order, 1))
    found: Floats = ranked @ _chances(judged.shape[1]).T
    return found


def _shared(scores: Floats, measured: Floats) -> Floats:
    """(P, N), both in the order of the scores: in place of each number the mean over those whose scores are equal."""
    first = np.ones(scores.shape, bool)
    first[:, 1:] = scores[:, 1:] != scores[:, :-1]
    group = first.ravel().cumsum() - 1  # each row begins a group of its own
    means = np.bincount(group, measured.ravel()) / np.bincount(group)
    found: Floats = means[group].reshape(scores.shape)
    return found


def _chances(count: int) -> Floats:
    """(N, N): that the i-th lowest of N is the highest of n drawn without putting back, C(i - 1, n - 1) / C(N, n)."""
    n, i = np.ogrid[1 : count + 1, 1 : count + 1]
    below = np.maximum(i - n, 0)  # gammaln has a pole where there are fewer than n - 1 below
    logs = _log_choose(i - 1, n - 1, below) - _log_choose(np.array(count), n, count - n)
    return np.where(i >= n, np.exp(logs), 0.0)


def _log_choose(of: Integers, some: Integers, rest: Integers) -> Floats:
    found: Floats = gammaln(of + 1) - gammaln(some + 1) - gammaln(rest + 1)
    return found
