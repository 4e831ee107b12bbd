"""How a policy of pictures does: fresh ones, measured."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from prefrl.policies.denoiser import DenoiserPolicy
from prefrl.protocols import RewardModel
from prefrl.types import Evaluation, Floats, Metrics, Picture

EXAMPLES = 12
"""Pictures to look at."""


def drawn(
    policy: DenoiserPolicy, count: int, reward: RewardModel[Picture], rng: np.random.Generator
) -> tuple[Evaluation[Picture], int]:
    """About so many pictures, as many of each caption, and how many there are.

    Metrics: count, learned, kl (nats a picture: the mean over chains of the steps' exact KL to the starting policy,
    added up) and spread (see the task). Of the captions that have a gold: gold, gold_std, and gold/CAPTION where there
    are several captions.
    """
    captions = list(policy.task.captions)
    chains = policy.draw(evenly(captions, -(-count // len(captions)) * len(captions)), rng)
    found = policy.with_gold(chains)
    gold = np.array([one.gold for one in found], float)[:, 0]
    metrics = {
        "count": float(len(found)),
        **_golds(found, gold),
        "learned": float(reward.score(found).mean()),
        "kl": float(policy.kl(chains).sum(1).mean()),
        "spread": policy.task.spread(found),
    }
    return Evaluation(metrics, tuple(found[:EXAMPLES]), candidates=tuple(found)), len(found)


def evenly(captions: Sequence[str], count: int) -> list[str]:
    """So many captions in turn, so that any beginning of them has all about equally often."""
    return [captions[i % len(captions)] for i in range(count)]


def _golds(found: Sequence[Picture], gold: Floats) -> Metrics:
    """Of pictures with a gold (N,), NaN for those without one; by caption too, where there are several."""
    known = ~np.isnan(gold)
    if not known.any():
        return {}
    metrics = {"gold": float(gold[known].mean()), "gold_std": float(gold[known].std())}
    which = np.array([one.caption for one in found])
    if len(set(which)) > 1:
        metrics |= {f"gold/{one}": float(gold[which == one].mean()) for one in dict.fromkeys(which[known].tolist())}
    return metrics
