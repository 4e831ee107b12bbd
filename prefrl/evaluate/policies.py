"""How a policy does: fresh behaviour, measured."""

from __future__ import annotations

import numpy as np

from prefrl.policies.rollout import Rollout, learned_rewards, step_rewards
from prefrl.protocols import ControlTask, RewardModel
from prefrl.sample.segments import segment
from prefrl.types import Evaluation, Segment

EXAMPLES, EXAMPLE_SECONDS = 3, 4.0


def evaluation(task: ControlTask, rollout: Rollout, reward: RewardModel[Segment]) -> Evaluation[Segment]:
    """Over the first episode of each row: mean `gold`, `learned` and `length`, `gold_std`; and openings to look at."""
    lengths = rollout.ends.argmax(1) + 1
    mask = np.arange(rollout.ends.shape[1]) < lengths[:, None]
    gold = np.where(mask, rollout.gold, 0.0).sum(1)
    learned = np.where(mask, learned_rewards(step_rewards(reward), rollout), 0.0).sum(1)
    shown = max(1, round(EXAMPLE_SECONDS * task.fps))
    examples = [
        segment(rollout, i, 0, min(int(lengths[i]), shown), "evaluation") for i in range(min(EXAMPLES, len(gold)))
    ]
    metrics = {
        "gold": float(gold.mean()),
        "gold_std": float(gold.std()),
        "learned": float(learned.mean()),
        "length": float(lengths.mean()),
    }
    return Evaluation(metrics, tuple(examples))
