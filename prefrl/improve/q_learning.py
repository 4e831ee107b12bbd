"""Tabular Q-learning (Watkins and Dayan 1992): the smallest value-based learner, where states can be counted.

Variant: epsilon-greedy behaviour, Q(s, a) += rate (r + gamma max_a' Q(s', a') - Q(s, a)) with a constant rate. What
differs: rewards are learned and change from round to round, so a round's steps are gone through `passes` times, each
time from the last step to the first, so that one pass carries a reward all the way. Q goes on from round to round.
What is left out: rates that fall with visits, for which the convergence is proven, and eligibility traces.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import torch
from pydantic import Field

from prefrl.components import ConfigError, Settings
from prefrl.improve.player import Player
from prefrl.policies.acting import Actor, Memory, played
from prefrl.policies.divided import environments
from prefrl.policies.loaded import check_leaves
from prefrl.policies.rollout import Act, Rollout, collect, learned_rewards, step_rewards
from prefrl.protocols import ControlTask, RewardModel, Store, Task, simulated
from prefrl.seeding import Device
from prefrl.types import Evaluation, Floats, Metrics, Segment, State, Steps


class QLearningSettings(Settings):
    """A table of action values, for discrete actions in states that are seen one-hot."""

    kind: Literal["q_learning"] = "q_learning"
    environments: int = Field(16, ge=1)
    """How many are stepped side by side."""
    steps_per_round: int = Field(7680, ge=1)
    """Environment steps of one round's learning: a multiple of `environments`."""
    epsilon: float = Field(0.5, ge=0, le=1)
    """How often an action is random while it learns. Evaluations are greedy."""
    rate: float = Field(0.1, gt=0, le=1)
    """How far a value moves to what a step says of it."""
    passes: int = Field(10, ge=1)
    """How often a round's steps are gone through."""
    discount: float = Field(0.95, ge=0, lt=1)
    """What a reward a step later counts for."""
    evaluation_episodes: int = Field(20, ge=1)
    """Episodes of an evaluation."""
    device: Device = "auto"
    """Where the reward model computes. The table is NumPy's."""

    def shrunk(self) -> QLearningSettings:
        steps = min(self.steps_per_round, 20 * self.environments)
        return self.model_copy(update={"steps_per_round": steps, "passes": 1, "evaluation_episodes": 1})

    def with_evaluation_of(self, other: QLearningSettings) -> QLearningSettings:
        return self.model_copy(update={"evaluation_episodes": other.evaluation_episodes})

    def work(self) -> float:
        return float(self.steps_per_round)

    def build(self, task: Task, rng: np.random.Generator) -> QLearning:
        """Raises `ConfigError` for actions that cannot be counted, and for states that are not seen one-hot."""
        found = simulated(task, f"learner kind {self.kind!r} acts in control tasks")
        if found.action_bounds is not None:
            raise ConfigError(
                f"learner.kind=q_learning needs discrete actions, and {found.name} has continuous ones: use "
                "learner.kind=control"
            )
        if self.steps_per_round % self.environments:
            raise ConfigError(
                f"learner.steps_per_round must be a multiple of learner.environments={self.environments}, got "
                f"{self.steps_per_round}"
            )
        first = environments(found, 1).reset(np.random.default_rng(0))
        if not _one_hot(first):
            raise ConfigError(
                f"learner.kind=q_learning needs states that are seen one-hot, as task.kind=gridworld and gymnasium's "
                f"Discrete observations are; {found.name} shows {first[0]}"
            )
        return QLearning(self, found)

    def formula(self) -> str:
        return f"Q(s,a) += {self.rate:g} ( r + {self.discount:g} max Q(s',.) - Q(s,a) ), {self.passes} passes a round"


class QLearning:
    """A `prefrl.protocols.Learner` of segments whose all is a table (S, A)."""

    def __init__(self, settings: QLearningSettings, task: ControlTask) -> None:
        self._settings, self._task = settings, task
        self.values: Floats = np.zeros((task.observation_size, task.action_size))
        self._player = Player(task, settings.environments)

    @property
    def steps(self) -> Steps:
        return self._player.steps

    def sample(self, count: int, rng: np.random.Generator) -> list[Segment]:
        """Segments of the last round; before the first one, of random actions (query steps)."""
        return self._player.sample(count, self._exploring(rng), rng)

    def improve(self, reward: RewardModel[Segment], store: Store[Segment], rng: np.random.Generator) -> Metrics:
        """A round of exploring, and passes over it. Metrics: reward (mean of the learned one a step), td_error (mean
        size of what a value was off in the last pass)."""
        envs = environments(self._task, self._settings.environments)
        steps = self._settings.steps_per_round // self._settings.environments
        rollout, _ = collect(envs, envs.reset(rng), steps, self._exploring(rng))
        rewards = learned_rewards(step_rewards(reward), rollout)
        for _ in range(self._settings.passes):
            errors = self._pass(rollout, rewards)
        self._player.learned_from(rollout)
        return {"reward": float(rewards.mean()), "td_error": float(np.abs(errors).mean())}

    def evaluate(self, reward: RewardModel[Segment], rng: np.random.Generator) -> Evaluation[Segment]:
        """The greedy policy in fresh environments."""
        return self._player.evaluate(self._settings.evaluation_episodes, played(self.actor(), None), reward, rng)

    def actor(self) -> Actor:
        def act(observations: Floats, rng: np.random.Generator | None, memory: Memory) -> tuple[Floats, Memory]:
            return self._chosen(observations, rng), memory

        return act

    def save(self, path: Path) -> None:
        """As DQN of stable-baselines3 without a hidden layer: its only weights are the table.

        Raises `ConfigError` as `check_leaves` does.
        """
        check_leaves(self._task)
        from stable_baselines3 import DQN

        from prefrl.improve.vec_env import TaskEnv

        model = DQN("MlpPolicy", TaskEnv(self._task, 1), policy_kwargs={"net_arch": []}, buffer_size=1)
        with torch.no_grad():
            for network in (model.q_net, model.q_net_target):
                weights, bias = network.parameters()
                weights.copy_(torch.from_numpy(self.values.T))
                bias.zero_()
        model.save(path)

    def state(self) -> State:
        return {"values": self.values} | self._player.state()

    def load(self, state: State) -> None:
        self.values = np.asarray(state["values"], np.float64)
        self._player.load(state)

    def _pass(self, rollout: Rollout, rewards: Floats) -> Floats:
        """Move values by each step, all environments' last ones first; (T, n) what they were off."""
        here, chosen, after = (x.argmax(2) for x in (rollout.observations, rollout.actions, rollout.final_observations))
        kept = self._settings.discount * ~rollout.terminated  # a time limit is no end: what follows counts
        errors = np.empty(rewards.T.shape)
        for t in reversed(range(len(errors))):
            for i in range(len(here)):  # one by one: two environments may be in the same state
                target = rewards[i, t] + kept[i, t] * self.values[after[i, t]].max()
                errors[t, i] = target - self.values[here[i, t], chosen[i, t]]
                self.values[here[i, t], chosen[i, t]] += self._settings.rate * errors[t, i]
        return errors

    def _exploring(self, rng: np.random.Generator) -> Act:
        return played(self.actor(), rng)

    def _chosen(self, observations: Floats, rng: np.random.Generator | None) -> Floats:
        """(n, S) -> (n, A) one-hot: the best action, or with chance epsilon any."""
        best = self.values[observations.argmax(1)].argmax(1)
        if rng is not None:
            epsilon = self._settings.epsilon if self.values.any() else 1.0
            explores = rng.random(len(best)) < epsilon
            best = np.where(explores, rng.integers(self.values.shape[1], size=len(best)), best)
        found: Floats = np.eye(self.values.shape[1], dtype=np.float32)[best]
        return found


def _one_hot(observations: Floats) -> bool:
    return bool(((observations == 0) | (observations == 1)).all() and (observations.sum(1) == 1).all())
