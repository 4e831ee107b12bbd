"""The best policy of a run, by the newest reward and without gold: what a round may lose before it is undone.

The usual way is to keep the last policy whatever it does, and an update can go wrong or follow a reward that did. Here
the episodes of evaluations, which begin alike in all rounds, are kept and scored anew by each fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from prefrl.evaluate.policies import returns
from prefrl.policies.rollout import Rollout
from prefrl.protocols import RewardModel
from prefrl.types import Floats, Segment, State

ERRORS = 2.0
"""Standard errors of the paired difference, beyond which a loss is one."""


class Undone(NamedTuple):
    """A round that lost too much."""

    round: int
    """Whose policy stands again."""
    before: float
    """What that one's episodes are worth by the newest reward, and below what the undone one's were."""
    after: float


@dataclass
class Best:
    """Episodes of the starting policy, and episodes and weights of the best one."""

    start: Rollout | None = None
    rollout: Rollout | None = None
    weights: State | None = None
    round: int = 0

    def settle(
        self, rollout: Rollout, weights: State, round: int, reward: RewardModel[Segment], most_lost: float
    ) -> Undone | None:
        """Count an evaluated policy in, or say that it lost clearly and is to be undone.

        Clearly: more than `most_lost` of all that was gained since the start, and more than chance (two standard errors
        of the paired difference).
        """
        if self.start is None or self.rollout is None or not reward.fitted:
            self.start = self.start or rollout
            self.rollout, self.weights, self.round = rollout, weights, round
            return None
        start, best, new = (_learned(one, reward) for one in (self.start, self.rollout, rollout))
        if _lost(start, best, new, most_lost):
            return Undone(self.round, float(best.mean()), float(new.mean()))
        if new.mean() >= best.mean():
            self.rollout, self.weights, self.round = rollout, weights, round
        return None

    def state(self) -> State:
        rollouts = {"start": self.start, "rollout": self.rollout}
        kept = {name: None if one is None else one.state() for name, one in rollouts.items()}
        return kept | {"weights": self.weights, "round": self.round}

    @classmethod
    def of(cls, state: State) -> Best:
        start, rollout = (None if state[name] is None else Rollout(**state[name]) for name in ("start", "rollout"))
        return cls(start, rollout, state["weights"], state["round"])


def _learned(rollout: Rollout, reward: RewardModel[Segment]) -> Floats:
    """(n,) the learned return of each first episode."""
    return returns(rollout, reward).learned


def _lost(start: Floats, best: Floats, new: Floats, most_lost: float) -> bool:
    lost = best - new  # (n,) pairs: episodes of an evaluation begin alike in all rounds
    error = float(lost.std(ddof=1)) / np.sqrt(len(lost)) if len(lost) > 1 else 0.0
    gained = max(0.0, float(best.mean() - start.mean()))
    return float(lost.mean()) > max(most_lost * gained, ERRORS * error)
