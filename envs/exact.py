"""What is exact in a world with few states: distributions, values, improvement, gradients and regret.

A policy is a table (S, A) of probabilities. Under it the pairs of a state and an action are a Markov chain, and all
that reinforcement learning is about is linear algebra over that chain: mu_{t+1} = mu_t T, J = sum_t gamma^t mu_t . r,
and Q = r + gamma T Q. Source: Puterman 1994, chapters 5 and 6; Sutton et al. 2000 (theorem 1) for the gradient. It is
the oracle of the tests of `prefrl/improve/objectives.py`, and what docs/theory.md draws. float64 throughout, for S x A
up to a few thousand.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from prefrl.types import Floats

ROUNDING = 1e-9
"""How far probabilities may be from adding up to 1."""


@dataclass(frozen=True, eq=False)
class MDP:
    """A Markov decision process as tables. Raises `ValueError` for tables that are none."""

    transitions: Floats
    """(S, A, S): how probable each next state is."""
    rewards: Floats
    """(S, A): the reward of an action in a state."""
    start: Floats
    """(S,): how probable each first state is."""
    discount: float = 0.95

    def __post_init__(self) -> None:
        states, actions = self.rewards.shape
        if self.transitions.shape != (states, actions, states) or self.start.shape != (states,):
            raise ValueError(
                f"expected transitions (S, A, S), rewards (S, A) and start (S,), got {self.transitions.shape}, "
                f"{self.rewards.shape} and {self.start.shape}"
            )
        for name, table in (("transitions", self.transitions), ("start", self.start)):
            if (table < 0).any() or np.abs(table.sum(-1) - 1).max() > ROUNDING:
                raise ValueError(f"{name}: expected probabilities that add up to 1, got {table.sum(-1)} in all")
        if not 0 <= self.discount < 1:
            raise ValueError(f"expected a discount of at least 0 and below 1, got {self.discount}")


# --- The chain over pairs of a state and an action ----------------------------------------------------------------


def chain(mdp: MDP, policy: Floats) -> Floats:
    """(SA, SA) transition operator: row (s, a) holds how probable each pair (s', a') is next."""
    pairs = mdp.rewards.size
    return (mdp.transitions[..., None] * policy).reshape(pairs, pairs)


def marginals(mdp: MDP, policy: Floats, steps: int) -> Floats:
    """(steps, S, A): mu_t, how probable each pair is at step t, from t = 0."""
    operator, mu = chain(mdp, policy), (mdp.start[:, None] * policy).ravel()
    found = np.empty((steps, *policy.shape))
    for t in range(steps):
        found[t] = mu.reshape(policy.shape)
        mu = mu @ operator
    return found


def stationary(mdp: MDP, policy: Floats) -> Floats:
    """(S, A): the distribution that a step leaves as it is. Raises `ValueError` where there is more than one."""
    operator = chain(mdp, policy)
    pairs = len(operator)
    # mu T = mu and sum mu = 1; one equation more than unknowns, and all of them hold.
    equations = np.vstack([operator.T - np.eye(pairs), np.ones(pairs)])
    mu, _, rank, _ = np.linalg.lstsq(equations, np.append(np.zeros(pairs), 1.0))
    if rank < pairs:
        raise ValueError("the chain falls into parts that never meet, so that it has no single stationary distribution")
    found: Floats = mu.reshape(policy.shape)
    return found


def occupancy(mdp: MDP, policy: Floats) -> Floats:
    """(S, A): mu-bar = (1 - gamma) sum_t gamma^t mu_t, the discounted share of time in each pair.

    It is the stationary distribution of a chain that begins anew with probability 1 - gamma.
    """
    first = (mdp.start[:, None] * policy).ravel()
    operator = np.eye(len(first)) - mdp.discount * chain(mdp, policy).T
    found: Floats = (1 - mdp.discount) * np.linalg.solve(operator, first).reshape(policy.shape)
    return found


# --- Values --------------------------------------------------------------------------------------------------------


def action_values(mdp: MDP, policy: Floats) -> Floats:
    """(S, A): Q, the discounted return of an action and then the policy; Q = r + gamma T Q."""
    operator = np.eye(mdp.rewards.size) - mdp.discount * chain(mdp, policy)
    found: Floats = np.linalg.solve(operator, mdp.rewards.ravel()).reshape(policy.shape)
    return found


def state_values(policy: Floats, values: Floats) -> Floats:
    """(..., S): V, the mean of Q (..., S, A) over the policy's actions."""
    found: Floats = (policy * values).sum(-1)
    return found


def advantages(policy: Floats, values: Floats) -> Floats:
    """(..., S, A): A = Q - V, whose mean over the policy's actions is 0."""
    return values - state_values(policy, values)[..., None]


def returns_to_go(mdp: MDP, policy: Floats, horizon: int) -> Floats:
    """(horizon, S, A): Q_t, the undiscounted return of an action at step t and then the policy, to the horizon."""
    found = np.empty((horizon, *policy.shape))
    following: Floats = np.zeros(len(policy))
    for t in reversed(range(horizon)):
        found[t] = mdp.rewards + mdp.transitions @ following
        following = state_values(policy, found[t])
    return found


def objective(mdp: MDP, policy: Floats, horizon: int | None = None) -> float:
    """J: the expected return, discounted for ever, or undiscounted to a horizon."""
    if horizon is not None:
        return float((marginals(mdp, policy, horizon) * mdp.rewards).sum())
    return float(mdp.start @ state_values(policy, action_values(mdp, policy)))


def gradient(mdp: MDP, policy: Floats, horizon: int | None = None) -> Floats:
    """(S, A): the derivative of `objective` by the logits of a softmax policy.

    sum_t gamma^t mu_t(s, a) A_t(s, a): the policy gradient theorem, where A stands for Q, since a logit moves its
    state's other actions as well.
    """
    if horizon is None:
        found: Floats = occupancy(mdp, policy) * advantages(policy, action_values(mdp, policy)) / (1 - mdp.discount)
        return found
    steps = marginals(mdp, policy, horizon) * advantages(policy, returns_to_go(mdp, policy, horizon))
    summed: Floats = steps.sum(0)
    return summed


# --- Improvement ---------------------------------------------------------------------------------------------------


def greedy(values: Floats) -> Floats:
    """(S, A): the policy that takes the action of the highest Q, the first of those that are equal."""
    found: Floats = np.eye(values.shape[1])[values.argmax(1)]
    return found


def soft(values: Floats, temperature: float) -> Floats:
    """(S, A): pi ~ exp(Q / temperature), which is `greedy` at 0 and uniform at infinity."""
    scaled = np.exp((values - values.max(1, keepdims=True)) / temperature)
    found: Floats = scaled / scaled.sum(1, keepdims=True)
    return found


def value_iteration(mdp: MDP, tolerance: float = 1e-12) -> Floats:
    """(S, A): Q* to `tolerance`, by Q <- r + gamma T max Q, which brings any two tables nearer by gamma."""
    values: Floats = np.zeros_like(mdp.rewards)
    while True:
        better: Floats = mdp.rewards + mdp.discount * mdp.transitions @ values.max(1)
        # What is left of the way is at most gamma / (1 - gamma) times the last step.
        if np.abs(better - values).max() * mdp.discount <= tolerance * (1 - mdp.discount):
            return better
        values = better


def policy_iteration(mdp: MDP) -> tuple[Floats, Floats]:
    """The best policy and its Q: greedy for the values of the one before, from the uniform one until none is better."""
    policy = np.full_like(mdp.rewards, 1 / mdp.rewards.shape[1])
    while True:
        values = action_values(mdp, policy)
        gain = values.max(1) - state_values(policy, values)
        if gain.max() <= ROUNDING:  # rounding alone could turn back and forth between equally good ones
            return policy, values
        policy = greedy(values)


def best_objective(mdp: MDP) -> float:
    """J of the best policy."""
    return objective(mdp, policy_iteration(mdp)[0])


def regret(mdp: MDP, policy: Floats) -> float:
    """How far J is below its best, as a share of the span between the best and the worst policy; 0 without a span."""
    best, worst = best_objective(mdp), -best_objective(replace(mdp, rewards=-mdp.rewards))
    return (best - objective(mdp, policy)) / (best - worst) if best > worst else 0.0


__all__ = [
    "MDP",
    "action_values",
    "advantages",
    "best_objective",
    "chain",
    "gradient",
    "greedy",
    "marginals",
    "objective",
    "occupancy",
    "policy_iteration",
    "regret",
    "returns_to_go",
    "soft",
    "state_values",
    "stationary",
    "value_iteration",
]
