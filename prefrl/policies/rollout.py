"""Rollouts: acting in n environments, cutting segments out of what happened, and evaluating a policy."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, TypeAlias, cast

import numpy as np

from prefrl.components import ConfigError
from prefrl.protocols import ControlTask, Environments, RewardModel, StepRewardModel, Task
from prefrl.types import Evaluation, Floats, Segment, State

Act: TypeAlias = Callable[[Floats], tuple[Floats, Floats]]
"""(n, O) observations -> (n, A) what the policy chose, and (n, A) what the environment is to execute."""
EXAMPLES, EXAMPLE_SECONDS = 3, 4.0
OVERLAP = 24
"""How many segments of a first pool share a step, on average. A first pool is dense on purpose: docs/decisions.md."""
PATIENCE = 4
"""A first pool is given up after this many times the steps of as many segments that share none."""


@dataclass(frozen=True, eq=False)
class Rollout:
    """T steps of n environments. A row may hold several episodes, one after another."""

    observations: Floats
    """(n, T, O) float32."""
    choices: Floats
    """(n, T, A) float32: what the policy drew."""
    actions: Floats
    """(n, T, A) float32: what was executed."""
    final_observations: Floats
    """(n, T, O) float32: what each step led to, before any reset."""
    terminated: np.ndarray
    """(n, T) bool."""
    truncated: np.ndarray
    """(n, T) bool."""
    gold: Floats
    """(n, T) float64. Hidden: for segments that an oracle is asked about, and for evaluation."""
    states: Floats | None
    """(n, T, S) float64 simulator states before each action."""

    @property
    def ends(self) -> np.ndarray:
        """(n, T) bool: the episode stopped here."""
        ends: np.ndarray = self.terminated | self.truncated
        return ends

    @property
    def begins(self) -> np.ndarray:
        """(n, T) bool: the first step of an episode, or of the row."""
        begins: np.ndarray = np.roll(self.ends, 1, 1)
        begins[:, 0] = True
        return begins

    def state(self) -> State:
        return {field.name: getattr(self, field.name) for field in fields(self)}


def joined(parts: Sequence[Rollout]) -> Rollout:
    """Rollouts that follow one another, as one."""
    arrays: dict[str, list[Any]] = {f.name: [getattr(part, f.name) for part in parts] for f in fields(Rollout)}
    whole: dict[str, Any] = {k: None if v[0] is None else np.concatenate(v, 1) for k, v in arrays.items()}
    return Rollout(**whole)


def collect(envs: Environments, observations: Floats, steps: int, act: Act) -> tuple[Rollout, Floats]:
    """Act for `steps` steps from `observations` (n, O); also returns the observations to go on from.

    Raises FloatingPointError where an observation or an action is not finite.
    """
    rows = []
    for t in range(steps):
        states = envs.states()
        choices, actions = act(observations)
        step = envs.step(actions)
        rows.append((observations, choices, actions, step, None if states is None else states.copy()))
        if not np.isfinite(step.final_observations).all():
            raise FloatingPointError(_not_finite(step.final_observations, actions, t))
        observations = step.observations
    steps_ = [row[3] for row in rows]
    rollout = Rollout(
        observations=np.stack([row[0] for row in rows], 1),
        choices=np.stack([row[1] for row in rows], 1),
        actions=np.stack([row[2] for row in rows], 1),
        final_observations=np.stack([s.final_observations for s in steps_], 1),
        terminated=np.stack([s.terminated for s in steps_], 1),
        truncated=np.stack([s.truncated for s in steps_], 1),
        gold=np.stack([s.rewards for s in steps_], 1),
        states=None if rows[0][4] is None else np.stack([cast(Floats, row[4]) for row in rows], 1),
    )
    return rollout, observations


def learned_rewards(reward: StepRewardModel, rollout: Rollout) -> Floats:
    """(n, T) learned rewards, scored in one batch. Raises FloatingPointError where one is not finite.

    A reward that looks back sees no step of another episode, nor what came before this rollout.
    """
    rewards = reward.rewards(rollout.observations, rollout.actions, rollout.begins)
    bad = np.argwhere(~np.isfinite(rewards))
    if len(bad):
        env, t = bad[0]
        raise FloatingPointError(
            f"the learned reward of environment {env}, step {t} of the rollout is {rewards[env, t]}; expected finite "
            "rewards: look at the reward model's last fit"
        )
    return rewards


def windows(rollout: Rollout, length: int) -> tuple[np.ndarray, Floats]:
    """Where segments of `length` steps may start, as (W, 2) pairs (environment, step), and a weight (W,) for each.

    A window lies inside one episode; the last start is included. The first and last window of an episode weigh as
    much as `length` others: its edges would else be seen `length` times less often than its middle.
    """
    ends, begins = rollout.ends, rollout.begins
    episode = begins.cumsum(1)
    last = ends.shape[1] - length
    if last < 0:
        return np.zeros((0, 2), np.int64), np.zeros(0)
    inside = episode[:, : last + 1] == episode[:, length - 1 :]
    starts = np.argwhere(inside)
    env, t = starts.T
    at_edge = begins[env, t] | ends[env, t + length - 1]
    return starts, np.where(at_edge, float(length), 1.0)


def cut(rollout: Rollout, length: int, count: int, name: str, rng: np.random.Generator) -> list[Segment]:
    """`count` distinct segments of a rollout, oldest first, gold attached, drawn by the weights of `windows`."""
    starts, weights = windows(rollout, length)
    if len(starts) < count:
        raise ValueError(
            f"{rollout.ends.size} steps hold {len(starts)} segments of {length} steps within one episode, but {count} "
            "were asked for; lower loop.pool or the segment length, or raise learner.steps_per_round"
        )
    chosen = rng.choice(len(starts), count, replace=False, p=weights / weights.sum())
    by_time = starts[chosen][np.argsort(starts[chosen, 1], kind="stable")]
    return [segment(rollout, int(env), int(t), length, name) for env, t in by_time]


def segment(rollout: Rollout, env: int, t: int, length: int, name: str) -> Segment:
    """Steps t ... t + length - 1 of one environment, by value; `name` makes its episode's name unique in a run."""
    before = np.flatnonzero(rollout.ends[env, :t])
    begin = int(before[-1]) + 1 if len(before) else 0
    part = (env, slice(t, t + length))
    return Segment(
        observations=rollout.observations[part].copy(),
        actions=rollout.actions[part].copy(),
        episode=f"{name}/{env}/{begin}",
        start=t - begin,
        states=None if rollout.states is None else rollout.states[part].copy(),
        gold=rollout.gold[part].copy(),
    )


def first_rollout(task: ControlTask, act: Act, count: int, most: int, rng: np.random.Generator) -> Rollout:
    """What a starting policy does: `count` windows in count * segment_steps / OVERLAP steps, or in more.

    It takes `horizon` steps at a time in each of at most `most` environments. Raises ValueError where episodes end too
    early to hold that many windows.
    """
    episodes = max(1, math.ceil(count * task.segment_steps / (OVERLAP * task.horizon)))
    passes = math.ceil(episodes / most)
    n = math.ceil(episodes / passes)
    envs, parts, held, longest = task.environments(n), list[Rollout](), 0, 0
    observations, age = envs.reset(rng), np.zeros(n, np.int64)
    while len(parts) < passes or held < count:
        if len(parts) >= PATIENCE * OVERLAP * passes:
            raise ValueError(_too_short(task, sum(p.ends.size for p in parts), held, count, longest))
        rollout, observations = collect(envs, observations, task.horizon, act)
        parts.append(rollout)
        ages = _ages(rollout.ends, age)
        held += int((ages >= task.segment_steps).sum())  # so many windows end here
        age, longest = np.where(rollout.ends[:, -1], 0, ages[:, -1]), max(longest, int(ages.max()))
    return joined(parts)


def _ages(ends: np.ndarray, before: np.ndarray) -> np.ndarray:
    """(n, T): which step of its episode each is, from 1, where `before` (n,) steps came earlier."""
    at = np.arange(ends.shape[1])
    begins = np.where(np.roll(ends, 1, 1), at, -before[:, None])
    begins[:, 0] = -before
    ages: np.ndarray = at + 1 - np.maximum.accumulate(begins, 1)
    return ages


def _too_short(task: ControlTask, steps: int, held: int, count: int, longest: int) -> str:
    return (
        f"{steps} steps of the starting policy hold {held} segments of {task.segment_steps} steps within one episode, "
        f"but {count} were asked for; the longest episode seen had {longest} steps: make task.segment_seconds (or "
        "segment_steps) smaller, or leave task.variable_horizon at false, so that episodes do not end early"
    )


def whole_episodes(task: ControlTask, act: Act, episodes: int, rng: np.random.Generator) -> Rollout:
    """One episode in each of `episodes` fresh environments; a row may go on after its first end."""
    envs = task.environments(episodes)
    parts: list[Rollout] = []
    observations, done = envs.reset(rng), np.zeros(episodes, bool)
    block = min(task.horizon, 100)
    while not done.all():
        steps = min(block, task.horizon - sum(p.ends.shape[1] for p in parts))
        rollout, observations = collect(envs, observations, steps, act)
        parts.append(rollout)
        done |= rollout.ends.any(1)
    return joined(parts)


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


def step_rewards(reward: RewardModel[Segment]) -> StepRewardModel:
    """A control learner needs a reward for each step, not for whole segments alone."""
    if not isinstance(reward, StepRewardModel):
        raise ConfigError(
            f"a control learner needs a reward model with rewards(observations, actions), got {type(reward).__name__}; "
            "use reward.kind=mlp"
        )
    return reward


def control(task: Task, kind: str) -> ControlTask:
    """A task, known to be of control. Raises `ConfigError` for others."""
    if task.kind != "control":
        raise ConfigError(f"learner kind {kind!r} acts in control tasks, but the task is of kind {task.kind!r}")
    return cast(ControlTask, task)


def _not_finite(observations: Floats, actions: Floats, t: int) -> str:
    env = int(np.argwhere(~np.isfinite(observations))[0][0])
    return (
        f"the observation of environment {env} after step {t} of the rollout is not finite: {observations[env]}, after "
        f"action {actions[env]}; the simulation diverged, or the environment is at fault"
    )
