"""Random decision processes and policies, as tables."""

import numpy as np

from prefrl.envs.exact import MDP
from prefrl.types import Floats


def world(seed: int, states: int = 5, actions: int = 3, discount: float = 0.9) -> MDP:
    rng = np.random.default_rng(seed)
    transitions = rng.dirichlet(np.full(states, 0.4), (states, actions))
    return MDP(transitions, rng.normal(size=(states, actions)), rng.dirichlet(np.ones(states)), discount)


def policy(seed: int, mdp: MDP) -> Floats:
    states, actions = mdp.rewards.shape
    return np.random.default_rng([seed, 1]).dirichlet(np.ones(actions), states)
