"""A world of few states that is learned by counting: how often each action led where.

States are seen one-hot, and known by their number. The estimate of each transition is its share among those seen
(maximum likelihood); what was never tried is thought to change nothing.
"""

from __future__ import annotations

import numpy as np

from prefrl.envs.exact import MDP
from prefrl.policies.rollout import Rollout
from prefrl.types import Floats


class Counted:
    """Counts (S, A, S) of transitions."""

    def __init__(self, states: int, actions: int) -> None:
        self.counts: Floats = np.zeros((states, actions, states))
        self.starts: Floats = np.zeros(states)
        """(S,): how often an episode began there."""

    @property
    def seen(self) -> float:
        """The share of all pairs of a state and an action that were tried."""
        return float((self.counts.sum(2) > 0).mean())

    def add(self, rollout: Rollout) -> None:
        """Count all steps of a rollout whose states and actions are one-hot."""
        here, chosen, after = (x.argmax(2) for x in (rollout.observations, rollout.actions, rollout.final_observations))
        np.add.at(self.counts, (here, chosen, after), 1.0)
        np.add.at(self.starts, here[rollout.begins], 1.0)

    def mdp(self, rewards: Floats, discount: float) -> MDP:
        """The tables as far as they are known, with rewards (S, A). Raises `ValueError` where nothing was counted."""
        if not self.starts.any():
            raise ValueError("nothing was counted yet: add a rollout first")
        tried = self.counts.sum(2, keepdims=True)
        stays = np.broadcast_to(np.eye(len(self.starts))[:, None], self.counts.shape)
        transitions = np.where(tried > 0, self.counts / np.maximum(tried, 1.0), stays)
        return MDP(transitions, rewards, self.starts / self.starts.sum(), discount)


__all__ = ["Counted"]
