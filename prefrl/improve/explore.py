"""Exploring before the first question: a policy that looks for states unlike those that were seen.

Variant: PEBBLE (Lee, Smith and Abbeel 2021, section 4.1), whose reward is the particle estimate of the entropy of
states. Here log(1 + distance) stands for its log(distance), so that a state that comes again is worth a finite 0 (as in
Liu and Abbeel 2021), observations are normalised before distances are taken, and everything replayed is scored anew
several times in place of every sample that is drawn. The critic is then put back, as in the authors' code.
"""

from __future__ import annotations

from copy import deepcopy
from typing import Any

import numpy as np

from prefrl.improve.vec_env import LearnedReward
from prefrl.types import Floats

NEIGHBOURS = 5
"""k, as in the paper."""
PARTS = 10
"""How often what is replayed is scored anew."""


def state_entropy(points: Floats, among: Floats, neighbours: int) -> Floats:
    """(N,) log(1 + distance) of points (N, O) to the so-many-th nearest of others (M, O); of the farthest where M is
    smaller."""
    from scipy.spatial import KDTree  # a quarter of a second, which few runs need

    # k as a list: that neighbour alone, (N, 1).
    distances = np.asarray(KDTree(among).query(points, k=[min(neighbours, len(among))])[0])
    found: Floats = np.log1p(distances[:, 0])
    return found


class StateEntropy:
    """Rewards for states that lie far from those seen, with std 1 over these; 0 before there are any."""

    def __init__(self) -> None:
        self._seen: Floats | None = None
        self._mean, self._std, self._scale = np.zeros(0), np.ones(0), 1.0

    @property
    def memory(self) -> int:
        return 1

    def see(self, observations: Floats) -> Floats:
        """All observations (N, O) up to now -> (N,) their rewards."""
        self._mean, std = observations.mean(0, dtype=np.float64), observations.std(0, dtype=np.float64)
        self._std = np.where(std > 0, std, 1.0)
        self._seen = self._normalised(observations)
        found = state_entropy(self._seen, self._seen, NEIGHBOURS + 1)  # each is its own nearest
        self._scale = float(found.std()) or 1.0
        return found / self._scale

    def rewards(self, observations: Floats, actions: Floats, begins: np.ndarray | None = None) -> Floats:
        shape = observations.shape[:2]
        if self._seen is None:
            return np.zeros(shape)
        points = self._normalised(observations.reshape(-1, observations.shape[2]))
        return state_entropy(points, self._seen, NEIGHBOURS).reshape(shape) / self._scale

    def _normalised(self, observations: Floats) -> Floats:
        found: Floats = (observations - self._mean) / self._std
        return found


def explore(model: Any, env: LearnedReward, steps: int, unit: int) -> None:
    """Let an off-policy algorithm of actor and critic look for new states, for `steps` steps: a multiple of `unit`.

    The actor keeps what it has learned. The critic is as it was before: it would else expect novelty.
    """
    critic = {name: x.clone() for name, x in model.policy.state_dict().items() if name.startswith("critic")}
    moments = deepcopy(model.critic.optimizer.state_dict())
    novelty, buffer = StateEntropy(), model.replay_buffer
    env.learned = novelty
    parts = np.array_split(np.arange(steps // unit), min(PARTS, steps // unit))
    for part in parts:
        model.learn(len(part) * unit, reset_num_timesteps=False, log_interval=None)
        size = buffer.size()
        seen = buffer.observations[:size].reshape(size * buffer.n_envs, -1)
        buffer.rewards[:size] = novelty.see(seen).reshape(size, buffer.n_envs)
    model.policy.load_state_dict(model.policy.state_dict() | critic)
    model.critic.optimizer.load_state_dict(moments)


__all__ = ["explore", "state_entropy"]
