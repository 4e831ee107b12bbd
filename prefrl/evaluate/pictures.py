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

    Metrics: count, gold and gold_std (of the captions that have a gold), learned, kl (nats a picture: the mean over
    chains of the steps' exact KL to the starting policy, added up), spread (see the task), and gold/CAPTION where there
    are several.
    """
    captions = list(policy.task.captions)
    chains = policy.draw(evenly(captions, -(-count // len(captions)) * len(captions)), rng)
    found = policy.with_gold(chains)
    gold = np.array([one.gold for one in found], float)[:, 0]
    known = gold[~np.isnan(gold)]
    metrics = {
        "count": float(len(found)),
        "gold": float(known.mean()) if len(known) else float("nan"),
        "gold_std": float(known.std()) if len(known) else float("nan"),
        "learned": float(reward.score(found).mean()),
        "kl": float(policy.kl(chains).sum(1).mean()),
        "spread": policy.task.spread(found),
    }
    if len(captions) > 1:
        metrics |= _by_caption(found, gold)
    return Evaluation(metrics, tuple(found[:EXAMPLES]), candidates=tuple(found)), len(found)


def evenly(captions: Sequence[str], count: int) -> list[str]:
    """So many captions in turn, so that any beginning of them has all about equally often."""
    return [captions[i % len(captions)] for i in range(count)]


def _by_caption(found: Sequence[Picture], gold: Floats) -> Metrics:
    which = np.array([one.caption for one in found])
    return {f"gold/{caption}": float(gold[which == caption].mean()) for caption in dict.fromkeys(which.tolist())}
