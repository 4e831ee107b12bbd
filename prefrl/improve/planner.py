"""Planning in a learned world by the learned reward, without a policy: CEM and MPPI over sequences of actions.

Discrete actions are planned by `prefrl.improve.tree`.

Variant: PETS's model-predictive control (Chua et al. 2018, algorithm 1): in each step sequences of actions are drawn,
each is followed by one member of the ensemble, and the first action of what did best is executed. `cem` fits a
Gaussian to the best sequences, some times over (Rubinstein and Kroese 2004); `mppi` weighs all by the exponential of
their return (Williams et al. 2017, equation 10, without its control cost). The next step goes on from the same plan,
one step later. What differs: sequences of an iteration are divided among the members in place of many particles for
each; a plan is no longer than the world's reach. What is left out: predicted variances, coloured noise, a value at the
end of a plan.
"""

from __future__ import annotations

import math
from dataclasses import fields
from typing import Literal

import numpy as np
import torch
from pydantic import Field, model_validator

from prefrl.components import ConfigError, Settings, filled_in
from prefrl.envs.learned import World, WorldSettings
from prefrl.improve.grounded import Grounded
from prefrl.improve.player import Player
from prefrl.improve.tree import TreePlanner, TreeSearch
from prefrl.policies.acting import Actor, Memory, played
from prefrl.policies.rollout import step_rewards
from prefrl.protocols import ControlTask, RewardModel, StepRewardModel, Store, Task, simulated
from prefrl.seeding import Device, device_of, to_numpy
from prefrl.types import Evaluation, Floats, Metrics, Segment, State, Steps

ALGORITHMS: dict[str, dict[str, object]] = {
    "cem": {},
    "mppi": {"iterations": 1, "candidates": 500},
    "mcts": {"plan": 80, "discount": 0.95, "episodes": 16},
}
"""Defaults that differ from the fields below."""
DRAWS = ("world", "candidates", "iterations", "std")
OWN: dict[str, tuple[str, ...]] = {
    "cem": (*DRAWS, "elites"),
    "mppi": (*DRAWS, "temperature"),
    "mcts": ("simulations", "exploration", "epsilon"),
}
"""The settings that not all of them have."""
NARROWEST = 0.05
"""The least standard deviation that cem draws with, as a share of `std`."""


class PlannerSettings(Settings):
    """Planning in a learned world by the learned reward; there is no policy."""

    kind: Literal["planner"] = "planner"
    algorithm: Literal["cem", "mppi", "mcts"] = "cem"
    """What fills in the defaults. For continuous actions: cem fits a Gaussian to the best sequences, over and over;
    mppi weighs all of many by their returns, once. For discrete actions in states that are seen one-hot: mcts, a tree
    search in transitions that are counted."""
    world: WorldSettings = WorldSettings()
    """The ensemble of dynamics."""
    episodes: int = Field(1, ge=1)
    """Real episodes of a round, played by planning, which the next round asks about and learns from. In the first one
    random actions play as many as its queries need."""
    plan: int = Field(25, ge=1)
    """Steps of a plan; fewer where the world cannot be trusted so far."""
    candidates: int = Field(120, ge=2)
    """Sequences that are tried in an iteration."""
    iterations: int = Field(3, ge=1)
    """How often sequences are drawn in a step, each time around what did best."""
    elites: float = Field(0.1, gt=0, le=1)
    """cem: the share of the sequences that the next Gaussian is fitted to."""
    temperature: float = Field(0.5, gt=0)
    """mppi: by which differences of returns are divided, in standard deviations of them; low follows the best alone."""
    std: float = Field(0.5, gt=0)
    """What sequences are drawn with first, in halves of the range of an action."""
    simulations: int = Field(1000, ge=1)
    """mcts: ways that are tried from each state, in each round."""
    exploration: float = Field(0.3, ge=0)
    """mcts: weight of the bonus for actions that were tried seldom, in spans of what can be gained."""
    epsilon: float = Field(0.2, ge=0, le=1)
    """mcts: how often an action is random in real episodes. Evaluations are greedy."""
    discount: float = Field(0.99, gt=0, lt=1)
    """What a reward a step later counts for in a plan."""
    evaluation_episodes: int = Field(5, ge=1)
    """Real episodes of an evaluation, side by side; each step of each is planned, which takes its time."""
    device: Device = "auto"
    """Where the world and the reward model compute: `auto` is the GPU where there is one."""
    threads: int | None = Field(1, ge=1)
    """With how many threads torch and BLAS compute; null leaves it to them."""

    @model_validator(mode="before")
    @classmethod
    def _fill_in(cls, given: object) -> object:
        return filled_in(given, ALGORITHMS)

    @model_validator(mode="after")
    def _none_of_others(self) -> PlannerSettings:
        """What another algorithm's settings say would be ignored. Defaults may stand, as a saved run has them all."""
        others = {name for names in OWN.values() for name in names} - {*OWN[self.algorithm]}
        for name in sorted(others & self.model_fields_set):
            if getattr(self, name) != type(self).model_fields[name].default:
                whose = " and ".join(one for one, names in OWN.items() if name in names)
                raise ValueError(
                    f"{name} is a setting of {whose}, and algorithm={self.algorithm} has none: leave it out"
                )
        return self

    def shrunk(self) -> PlannerSettings:
        least = {"plan": min(self.plan, 3), "evaluation_episodes": 1, "episodes": 1}
        if self.algorithm == "mcts":
            return self.model_copy(update={**least, "simulations": 2})
        return self.model_copy(update={**least, "candidates": 10, "iterations": 1, "world": self.world.shrunk()})

    def with_evaluation_of(self, other: PlannerSettings) -> PlannerSettings:
        return self.model_copy(update={"evaluation_episodes": other.evaluation_episodes})

    def work(self) -> float:
        tried = self.simulations if self.algorithm == "mcts" else self.candidates * self.iterations
        return float(tried * self.plan)

    def real_work(self) -> float:
        return float(self.episodes)

    def build(self, task: Task, rng: np.random.Generator) -> Planner | TreePlanner:
        """Raises `ConfigError` for actions, or states, that the algorithm is not for, and where not all actions are
        always legal."""
        found = simulated(task, f"learner kind {self.kind!r} plays real episodes of control")
        if self.algorithm != "mcts":
            return Planner(self, found, rng)
        own = self.model_dump(include={one.name for one in fields(TreeSearch)})
        return TreePlanner(TreeSearch(**own), found)

    def formula(self) -> str:
        if self.algorithm == "mcts":
            return (
                f"Q_t(s,a) = r(s,a) + {self.discount:g} sum_s' p(s'|s,a) max Q_t+1(s',.),  t below {self.plan}\n"
                f"p by counting; ways go by Q + {self.exploration:g} x span x sqrt(ln n(s) / n(s,a))"
            )
        better = {
            "cem": f"mean and std of the best {self.elites:.0%} of {self.candidates} draws, {self.iterations} times",
            "mppi": f"mean of {self.candidates} sequences, weighted by exp(return / {self.temperature:g} std)",
        }[self.algorithm]
        return (
            f"maximise  sum over {self.plan} steps t of {self.discount:g}^t r(s_t, a_t),  s_t+1 by a member\n"
            f"by the {better}; then a_0 is executed"
        )


class Planner:
    """A `prefrl.protocols.Learner` of segments that acts by planning: what it learns is the world."""

    def __init__(self, settings: PlannerSettings, task: ControlTask, rng: np.random.Generator) -> None:
        self._settings, self._task = settings, task
        self.ground = Grounded(settings.world, task, device_of(settings.device), rng)
        self._player = Player(task, 1)
        self._low, self._high = _bounds(task)
        self._imagined, self._last = 0, False

    @property
    def steps(self) -> Steps:
        return self._player.steps.add(learn=self.ground.spent, imagined=self._imagined)

    def sample(self, count: int, rng: np.random.Generator) -> list[Segment]:
        """Segments of the real episodes that were planned last; before the first round, of random actions."""
        if not self.ground.begun:
            self.ground.begin(count, played(self._at_random(), rng), 16, rng)
        return self.ground.segments(count, rng)

    def improve(self, reward: RewardModel[Segment], store: Store[Segment], rng: np.random.Generator) -> Metrics:
        """Fit the world on all real steps, then play by planning in it, but for the last round of a run: nobody would
        learn from that. Metrics: those of `World.fit`."""
        if not self.ground.begun:
            self.ground.play(self._settings.episodes, played(self._at_random(), rng), rng)
        metrics = self.ground.learn(rng)
        if not self._last:
            self.ground.play(self._settings.episodes, played(self.planning(reward), rng), rng)
        return metrics

    def evaluate(self, reward: RewardModel[Segment], rng: np.random.Generator) -> Evaluation[Segment]:
        """Real episodes, planned from the same draws in every step; before the first fit no action is taken."""
        act = played(self.planning(reward), None)
        found = self._player.evaluate(self._settings.evaluation_episodes, act, reward, rng)
        return Evaluation(found.metrics, found.examples, (*found.notes, *self.ground.notes), found.candidates)

    def pace(self, begin: float, end: float) -> None:
        self._last = end >= 1

    def planning(self, reward: RewardModel[Segment]) -> Actor:
        """Acts by planning with this reward; what it remembers of an episode is its plan, (n, steps x A)."""
        if not self.ground.world.reach:
            return self._at_random()
        search = Search(self._settings, self.ground.world, step_rewards(reward), (self._low, self._high))

        def act(observations: Floats, rng: np.random.Generator | None, memory: Memory) -> tuple[Floats, Memory]:
            # Without a generator the same draws everywhere: one observation and plan always lead to one action.
            plan = search(observations, rng or np.random.default_rng(0), memory)
            self._imagined += search.cost(len(observations))
            following = np.concatenate([plan[:, 1:], np.zeros_like(plan[:, :1])], 1)
            return search.scaled(plan[:, 0]), following.reshape(len(plan), -1)

        return act

    def state(self) -> State:
        parts = {"ground": self.ground.state(), "player": self._player.state()}
        return parts | {"imagined": self._imagined}

    def load(self, state: State) -> None:
        self.ground.load(state["ground"])
        self._player.load(state["player"])
        self._imagined = state["imagined"]

    def _at_random(self) -> Actor:
        def act(observations: Floats, rng: np.random.Generator | None, memory: Memory) -> tuple[Floats, Memory]:
            middle = np.broadcast_to((self._low + self._high) / 2, (len(observations), len(self._low)))
            drawn = middle if rng is None else rng.uniform(self._low, self._high, middle.shape)
            return drawn.astype(np.float32), memory

        return act


def _bounds(task: ControlTask) -> tuple[Floats, Floats]:
    """Raises `ConfigError` where there are none."""
    if task.action_bounds is None:
        raise ConfigError(
            f"learner.kind=planner draws sequences of continuous actions, and those of {task.name} are discrete: use "
            "learner.kind=dyna, or learner.algorithm=mcts where states are seen one-hot"
        )
    if not all(np.isfinite(side).all() for side in task.action_bounds):
        raise ConfigError(f"learner.kind=planner draws actions within bounds, and those of {task.name} have none")
    return task.action_bounds


class Search:
    """Finds plans for n states at once, in a world as it is."""

    def __init__(
        self, settings: PlannerSettings, world: World, reward: StepRewardModel, bounds: tuple[Floats, Floats]
    ) -> None:
        self._settings, self._world, self._reward = settings, world, reward
        self._low, self._high = bounds
        self.length = min(settings.plan, world.reach)
        self._count = -(-settings.candidates // world.members) * world.members
        """Sequences, as many for each member."""

    def cost(self, count: int) -> int:
        """Imagined steps of a step of so many states."""
        return count * self._count * self._settings.iterations * self.length

    def scaled(self, actions: Floats) -> Floats:
        """(..., A) within [-1, 1] -> within the bounds."""
        middle, half = (self._low + self._high) / 2, (self._high - self._low) / 2
        found: Floats = (middle + half * actions).astype(np.float32)
        return found

    def __call__(self, observations: Floats, rng: np.random.Generator, memory: Memory) -> Floats:
        """(n, O) and what is left of the plans before -> (n, H, A) plans within [-1, 1]."""
        n, size = len(observations), len(self._low)
        mean = np.zeros((n, self.length, size)) if memory is None else memory.reshape(n, self.length, size)
        std = np.full_like(mean, self._settings.std)
        for _ in range(self._settings.iterations):
            noise = rng.standard_normal((self._count, self.length, size))  # the same for all states
            drawn = np.clip(mean[:, None] + std[:, None] * noise, -1.0, 1.0)
            worth = self.worth(observations, drawn)
            if self._settings.algorithm == "cem":
                mean, std = self._best(drawn, worth)
            else:
                mean = self._weighted(drawn, worth)
        return mean.astype(np.float32)

    @torch.no_grad()
    def worth(self, observations: Floats, plans: Floats) -> Floats:
        """(n, O) and (n, C, H, A) -> (n, C): the discounted learned return, each sequence by the member of its turn."""
        n, count, length, _ = plans.shape
        members, device = self._world.members, self._world.device
        actions = self.scaled(plans)
        # Sequence c is of member c % E: (n, C, ...) -> (E, n C / E, ...).
        own = actions.reshape(n, count // members, members, length, -1).transpose(2, 0, 1, 3, 4)
        own = np.ascontiguousarray(own).reshape(members, -1, length, actions.shape[-1])
        acts = torch.from_numpy(own).to(device)
        state = torch.from_numpy(np.repeat(observations, count // members, 0)).to(device).expand(members, -1, -1)
        seen = []
        for t in range(length):
            seen.append(state)
            state = self._world.predict(state, acts[:, :, t])[..., : observations.shape[1]]
        states = to_numpy(torch.stack(seen, 2)).reshape(-1, length, observations.shape[1])
        rewards = self._reward.rewards(states, own.reshape(-1, length, actions.shape[-1]))
        returns = rewards @ (self._settings.discount ** np.arange(length))
        found: Floats = returns.reshape(members, n, -1).transpose(1, 2, 0).reshape(n, count)
        return found

    def _best(self, plans: Floats, worth: Floats) -> tuple[Floats, Floats]:
        """Mean and std (n, H, A) of the best sequences."""
        count = max(2, math.ceil(self._settings.elites * worth.shape[1]))
        at = np.argpartition(-worth, count - 1, 1)[:, :count]
        elites = np.take_along_axis(plans, at[:, :, None, None], 1)
        return elites.mean(1), np.maximum(elites.std(1), NARROWEST * self._settings.std)

    def _weighted(self, plans: Floats, worth: Floats) -> Floats:
        """(n, H, A): the mean, weighted by the exponential of returns."""
        spread = self._settings.temperature * worth.std(1, keepdims=True) + 1e-8
        weights = np.exp((worth - worth.max(1, keepdims=True)) / spread)
        found: Floats = np.einsum("nc,ncha->nha", weights / weights.sum(1, keepdims=True), plans)
        return found


__all__ = ["Planner", "PlannerSettings", "Search"]
