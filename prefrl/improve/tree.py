"""Monte-Carlo tree search in a learned world of few states, by the learned reward, without a policy.

Variant: UCT (Kocsis and Szepesvari 2006): in each simulation an action is chosen by its value and a bonus for those
that were tried seldom (UCB1), and where it leads is drawn. Values are backed up as in DP-UCT (Keller and Helmert 2013,
section 4): the best action's, over all that may follow, since the tables say how probable it is. Nodes are pairs of a
depth and a state, so that ways that meet share what was found behind; all roots are searched side by side, in one such
graph. What is left out: playouts beyond it (a state that was never reached is worth 0, the middle of the rewards) and
progressive widening.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from prefrl.components import ConfigError
from prefrl.envs.counted import Counted
from prefrl.envs.exact import MDP
from prefrl.improve.grounded import all_legal
from prefrl.improve.player import Player
from prefrl.policies.acting import Actor, Memory, played
from prefrl.policies.divided import environments
from prefrl.policies.rollout import Rollout, step_rewards, whole_episodes
from prefrl.protocols import ControlTask, RewardModel, StepRewardModel, Store
from prefrl.sample.segments import first_rollout
from prefrl.types import Evaluation, Floats, Integers, Metrics, Segment, State, Steps

SHOWN = 10
"""So many numbers of an observation stand in a message."""


@dataclass(frozen=True)
class TreeSearch:
    """How it is searched and played; `prefrl.improve.planner.PlannerSettings` says what each number means."""

    simulations: int
    plan: int
    exploration: float
    epsilon: float
    discount: float
    episodes: int
    evaluation_episodes: int


def tree_search(
    mdp: MDP, roots: Integers, simulations: int, depth: int, exploration: float, rng: np.random.Generator
) -> Floats:
    """(R,) states -> (R, A): what each action is worth there, the best of what follows included, `depth` steps on.

    `exploration` weighs the bonus, in spans of the rewards times the steps that are left (discounted).
    """
    values = np.zeros((depth + 1, *mdp.rewards.shape))
    tried = np.zeros_like(values)
    span = float(np.ptp(mdp.rewards)) or 1.0
    weights = exploration * span * np.array([sum(mdp.discount**k for k in range(depth - t)) for t in range(depth)])
    below = mdp.transitions.cumsum(2)
    for _ in range(simulations):
        here, path = roots, []
        for t in range(depth):
            chosen = _ucb(values[t, here], tried[t, here], weights[t], rng)
            path.append((here, chosen))
            sums = below[here, chosen]
            here = (rng.random((len(roots), 1)) * sums[:, -1:] >= sums).sum(1)
        for t in reversed(range(depth)):
            here, chosen = path[t]
            best = np.where(tried[t + 1] > 0, values[t + 1], -np.inf).max(1)  # (S,)
            best = np.where(np.isfinite(best), best, 0.0)
            values[t, here, chosen] = mdp.rewards[here, chosen] + mdp.discount * mdp.transitions[here, chosen] @ best
            np.add.at(tried[t], (here, chosen), 1.0)
    found: Floats = np.where(tried[0, roots] > 0, values[0, roots], -np.inf)
    return found


def _ucb(values: Floats, tried: Floats, weight: float, rng: np.random.Generator) -> Integers:
    """(R,): the actions to try next; those that never were come first, in any order."""
    total = np.maximum(tried.sum(1, keepdims=True), 1.0)
    with np.errstate(divide="ignore"):
        bonus = weight * np.sqrt(np.log(total + 1.0) / tried)  # infinite where it was never tried
    worth = np.where(tried > 0, values + bonus, np.inf)
    best = worth == worth.max(1, keepdims=True)
    found: Integers = np.where(best, rng.random(worth.shape), -1.0).argmax(1)
    return found


def _countable(task: ControlTask) -> None:
    """Raises `ConfigError` for a task whose states and actions cannot be counted; takes one step to find out."""
    if task.action_bounds is not None:
        raise ConfigError(
            f"learner.algorithm=mcts counts discrete actions, and those of {task.name} are continuous: use "
            "learner.algorithm=cem"
        )
    envs = environments(task, 1)
    first = envs.reset(np.random.default_rng(0))
    after = envs.step(np.eye(1, task.action_size, dtype=np.float32))
    for seen in (first, after.final_observations, after.observations):
        if not (((seen == 0) | (seen == 1)).all() and (seen.sum(1) == 1).all()):
            raise ConfigError(
                f"learner.algorithm=mcts counts states, which have to be seen one-hot, as task.kind=gridworld shows "
                f"them; {task.name} shows {_start_of(seen[0])}: use learner.kind=dyna"
            )


def _start_of(numbers: Floats) -> str:
    """At most ten of them."""
    return f"[{', '.join(f'{x:.4g}' for x in numbers[:SHOWN])}{', ...' if len(numbers) > SHOWN else ''}]"


class TreePlanner:
    """A `prefrl.protocols.Learner` of segments: it counts transitions, and plans in them for all states in a round."""

    def __init__(self, settings: TreeSearch, task: ControlTask) -> None:
        """Raises `ConfigError` for actions that are continuous or not always legal, and for states that are not seen
        one-hot."""
        self._settings, self._task = settings, task
        all_legal(task)
        _countable(task)
        self.world = Counted(task.observation_size, task.action_size)
        self.values: Floats = np.zeros((task.observation_size, task.action_size))
        """What each action was found to be worth, by the newest reward."""
        self._player = Player(task, 16)
        self._imagined, self._last = 0, False

    @property
    def steps(self) -> Steps:
        return self._player.steps.add(imagined=self._imagined)

    def sample(self, count: int, rng: np.random.Generator) -> list[Segment]:
        """Segments of the episodes that were planned last; before the first round, of random actions."""
        if not self._player.moved:
            rollout = first_rollout(self._task, played(self._acting(True), rng), count, 16, rng)
            self._player.explored(rollout)
            self.world.add(rollout)
        return self._player.sample(count, played(self._acting(True), rng), rng)

    def improve(self, reward: RewardModel[Segment], store: Store[Segment], rng: np.random.Generator) -> Metrics:
        """Search from every state, then play by what was found, but for a run's last round.

        Metrics: pairs_seen, the share of pairs of a state and an action that were tried.
        """
        if not self._player.moved:
            self._play(rng)
        mdp, states = self.learned(step_rewards(reward)), len(self.values)
        search = self._settings
        given = search.simulations, search.plan, search.exploration
        self.values = tree_search(mdp, np.arange(states), *given, rng)
        self._imagined += states * search.simulations * search.plan
        if not self._last:
            self._play(rng)
        return {"pairs_seen": self.world.seen}

    def learned(self, reward: StepRewardModel) -> MDP:
        """The world as it is known, with the learned rewards, shifted so that 0 is their middle.

        A shift changes no plan, and makes what is unknown neither good nor bad.
        """
        states, actions = self.values.shape
        here, chosen = np.eye(states, dtype=np.float32).repeat(actions, 0), np.tile(np.eye(actions), (states, 1))
        found = reward.rewards(here[:, None], chosen[:, None].astype(np.float32)).reshape(states, actions)
        rewards = found.astype(np.float64)
        return self.world.mdp(rewards - (rewards.max() + rewards.min()) / 2, self._settings.discount)

    def evaluate(self, reward: RewardModel[Segment], rng: np.random.Generator) -> Evaluation[Segment]:
        """Real episodes of the best actions."""
        act = played(self._acting(False), None)
        return self._player.evaluate(self._settings.evaluation_episodes, act, reward, rng)

    def pace(self, begin: float, end: float) -> None:
        self._last = end >= 1

    def state(self) -> State:
        own = {"counts": self.world.counts, "starts": self.world.starts, "values": self.values}
        return own | {"imagined": self._imagined, "player": self._player.state()}

    def load(self, state: State) -> None:
        self.world.counts, self.world.starts = state["counts"].copy(), state["starts"].copy()
        self.values, self._imagined = state["values"].copy(), state["imagined"]
        self._player.load(state["player"])

    def _play(self, rng: np.random.Generator) -> None:
        rollout: Rollout = whole_episodes(self._task, played(self._acting(True), rng), self._settings.episodes, rng)
        self._player.learned_from(rollout)
        self.world.add(rollout)

    def _acting(self, explores: bool) -> Actor:
        """The best action; while it explores any, now and then, and always before the first search."""
        chance = (self._settings.epsilon if self.values.any() else 1.0) if explores else 0.0

        def act(observations: Floats, rng: np.random.Generator | None, memory: Memory) -> tuple[Floats, Memory]:
            best = self.values[observations.argmax(1)].argmax(1)
            if rng is not None:
                other = rng.integers(self.values.shape[1], size=len(best))
                best = np.where(rng.random(len(best)) < chance, other, best)
            chosen: Floats = np.eye(self.values.shape[1], dtype=np.float32)[best]
            return chosen, memory

        return act


__all__ = ["TreePlanner", "tree_search"]
