"""What an answer is worth before it is given: (E, Q, K) raw scores of an ensemble -> (Q,) values.

Raw scores are the calibrated logits of the fitted likelihood; settled ones are on another scale. An answer is taken
to be the best of the K candidates, with the softmax of the scores as its probabilities (Plackett and Luce's first
choice). For a pair that is all there is to answer; of a ranking it is the first part, and its information is a lower
bound of the whole ranking's, which has K! outcomes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from itertools import combinations
from types import MappingProxyType
from typing import Literal, TypeAlias

import numpy as np
from scipy.special import entr, expit, softmax

from prefrl.types import Floats, Integers

Score: TypeAlias = Literal["disagreement", "entropy", "information"]


def disagreement(scores: Floats) -> Floats:
    """The members' std of the preference probability, averaged over pairs (Christiano et al. 2017, section 2.2.4)."""
    pairs = combinations(range(scores.shape[2]), 2)
    spread = [expit(scores[:, :, i] - scores[:, :, j]).std(0) for i, j in pairs]  # each (Q,)
    mean: Floats = np.mean(spread, axis=0)
    return mean


def entropy(scores: Floats) -> Floats:
    """The entropy of the members' mean prediction, in nats: also high where all agree that nobody can tell."""
    total: Floats = entr(_choices(scores).mean(0)).sum(-1)
    return total


def information(scores: Floats) -> Floats:
    """What the answer tells about which member is right, in nats: the entropy of the mean less the mean entropy.

    BALD (Houlsby et al. 2011, section 2); 0 where all members predict the same, at most log E.
    """
    gained: Floats = entropy(scores) - entr(_choices(scores)).sum(-1).mean(0)
    return gained


SCORES: Mapping[Score, Callable[[Floats], Floats]] = MappingProxyType(
    {"disagreement": disagreement, "entropy": entropy, "information": information}
)


def joint_information(scores: Floats, count: int) -> Integers:
    """`count` of Q queries, greedily, whose answers together tell most about the members' scores.

    The members are taken for samples of a Gaussian posterior with covariance C of all scores. The best-of-K answer to
    query q has the Fisher information F_q = diag(p) - p p', at the members' mean prediction p. To first order, a set
    S of answers then gains 1/2 log det(I + C_S F_S) nats (Bayesian D-optimality, Chaloner and Verdinelli 1995,
    section 2.2; greedy as the MaxDet selection of Holzmueller et al. 2023). A second query that says what the first
    said gains little. The exact joint information of E equally likely members (BatchBALD, Kirsch et al. 2019) is at
    most log E, which few queries exhaust.
    """
    blocks = _weighted_deviations(scores)
    precision, unit = np.eye(len(scores)), np.eye(scores.shape[2])
    chosen: list[int] = []
    for _ in range(count):
        # What each query adds to those chosen before, whose information is in the precision (E, E).
        gains = np.linalg.slogdet(unit + blocks @ np.linalg.inv(precision) @ blocks.transpose(0, 2, 1))[1]
        gains[chosen] = -np.inf
        chosen.append(int(gains.argmax()))
        precision += blocks[chosen[-1]].T @ blocks[chosen[-1]]
    return np.array(chosen, np.int64)


def _weighted_deviations(scores: Floats) -> Floats:
    """(Q, K, E): B_q with B_q B_q' similar to C_q F_q. With s = sqrt(p), F = R R' where R = diag(s) (I - s s')."""
    # (E, Q, K), over E - 1: an unbiased estimate of C from E members.
    deviations = (scores - scores.mean(0)).astype(np.float64) / np.sqrt(len(scores) - 1)
    root = np.sqrt(_choices(scores).mean(0))[:, :, None]
    scaled = root * deviations.transpose(1, 2, 0)
    blocks: Floats = scaled - root * (root * scaled).sum(1, keepdims=True)
    return blocks


def _choices(scores: Floats) -> Floats:
    """(E, Q, K): each member's probability that a candidate is the best of its query."""
    chances: Floats = softmax(scores.astype(np.float64), axis=-1)
    return chances
