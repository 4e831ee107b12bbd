"""Rollouts: acting in n environments, and the learned reward of what happened."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from typing import Any, TypeAlias, cast

import numpy as np

from prefrl.components import ConfigError
from prefrl.distributed import world
from prefrl.policies.divided import Divided, environments
from prefrl.protocols import ControlTask, Environments, RewardModel, StepRewardModel, Transition
from prefrl.types import Bools, Floats, Segment, State

Act: TypeAlias = Callable[[Floats, Bools | None, Bools], tuple[Floats, Floats]]
"""(n, O) observations, (n, A) which discrete actions are legal or None where all are, and (n,) which episodes begin
-> (n, A) what the policy chose, and (n, A) what the environment is to execute."""


@dataclass(frozen=True, eq=False)
class Rollout:
    """T steps of n environments. A row may hold several episodes, one after another."""

    observations: Floats
    """(n, T, O) float32."""
    choices: Floats
    """(n, T, A) float32: what the policy drew; of one that plans (n, T, M), all that it remembers."""
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
    legal: Bools | None = None
    """(n, T, A) which discrete actions there were; None where there always were all."""

    @property
    def ends(self) -> np.ndarray:
        """(n, T) bool: the episode stopped here."""
        ends: np.ndarray = self.terminated | self.truncated
        return ends

    @property
    def begins(self) -> np.ndarray:
        """(n, T) bool: the first step of an episode, or of the row."""
        begins: np.ndarray = np.roll(self.ends, 1, 1)  # wraps the row's last end to its start, which is set below
        begins[:, 0] = True
        return begins

    def state(self) -> State:
        return {field.name: getattr(self, field.name) for field in fields(self)}


def joined(parts: Sequence[Rollout], axis: int = 1) -> Rollout:
    """Rollouts that follow one another as one, or for axis 0 those of other environments."""
    arrays: dict[str, list[Any]] = {f.name: [getattr(part, f.name) for part in parts] for f in fields(Rollout)}
    whole: dict[str, Any] = {k: None if v[0] is None else np.concatenate(v, axis) for k, v in arrays.items()}
    return Rollout(**whole)


def collect(
    envs: Environments, observations: Floats, steps: int, act: Act, begins: Bools | None = None
) -> tuple[Rollout, Floats]:
    """Act for `steps` steps from `observations` (n, O); also returns the observations to go on from.

    `begins` (n,): which episodes begin with the first step; None where all do. Raises FloatingPointError where an
    observation or an action is not finite. Environments that are divided among ranks: all have to come here.
    """
    if not isinstance(envs, Divided):
        return _collect(envs, observations, steps, act, begins)

    def own() -> tuple[Rollout, Floats]:
        rollout, following = _collect(envs, observations, steps, act, begins)
        rows: dict[str, Any] = {name: None if x is None else x[envs.mine] for name, x in rollout.state().items()}
        return Rollout(**rows | {"states": rollout.states}), following[envs.mine]

    rollouts, following = zip(*world().each(own), strict=True)
    return joined(rollouts, 0), np.concatenate(following)


def _collect(
    envs: Environments, observations: Floats, steps: int, act: Act, begins: Bools | None
) -> tuple[Rollout, Floats]:
    rows = []
    begins = np.ones(len(observations), bool) if begins is None else begins
    check_begun(observations)
    for t in range(steps):
        # Before the step: a segment shows the state in which each action was taken. A copy: some simulators go on
        # writing into the array that they gave out.
        now, legal = envs.states(), envs.legal()
        states = None if now is None else now.copy()
        choices, actions = act(observations, legal, begins)
        step = stepped(envs, observations, actions, t)
        rows.append((observations, choices, actions, step, states, legal))
        observations, begins = step.observations, step.terminated | step.truncated
    steps_ = [row[3] for row in rows]
    rollout = Rollout(
        observations=np.stack([row[0] for row in rows], 1),  # T x (n, O) -> (n, T, O)
        choices=np.stack([row[1] for row in rows], 1),
        actions=np.stack([row[2] for row in rows], 1),
        final_observations=np.stack([s.final_observations for s in steps_], 1),
        terminated=np.stack([s.terminated for s in steps_], 1),
        truncated=np.stack([s.truncated for s in steps_], 1),
        gold=np.stack([s.rewards for s in steps_], 1),
        states=None if rows[0][4] is None else np.stack([cast(Floats, row[4]) for row in rows], 1),
        legal=None if rows[0][5] is None else np.stack([cast(Bools, row[5]) for row in rows], 1),
    )
    return rollout, observations


def stepped(envs: Environments, observations: Floats, actions: Floats, t: int) -> Transition:
    """Step `t` of a rollout, from `observations` (n, O) with `actions` (n, A).

    Raises FloatingPointError, which names the environment and the step, where an action or an observation that follows
    is not finite.
    """
    if not np.isfinite(actions).all():
        env = _first_bad(actions)
        raise FloatingPointError(
            f"the action of environment {env} in step {t} of the rollout is {actions[env]}, at observation "
            f"{observations[env]}; the policy's weights are no longer finite"
        )
    step = envs.step(actions)
    # The final ones: a reset in the same step would hide a simulation that went to infinity.
    if not np.isfinite(step.final_observations).all():
        env = _first_bad(step.final_observations)
        raise FloatingPointError(
            f"the observation of environment {env} after step {t} of the rollout is not finite: "
            f"{step.final_observations[env]}, after action {actions[env]}; the simulation diverged, or the environment "
            "is at fault"
        )
    if (step.terminated | step.truncated).any():  # elsewhere they are the final ones
        check_begun(step.observations)
    return step


def check_begun(observations: Floats) -> None:
    """Raises FloatingPointError where an observation (n, O) that an episode begins with is not finite."""
    if not np.isfinite(observations).all():
        env = _first_bad(observations)
        raise FloatingPointError(
            f"the first observation of an episode of environment {env} is not finite: {observations[env]}; the "
            "environment is at fault"
        )


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


def whole_episodes(task: ControlTask, act: Act, episodes: int, rng: np.random.Generator) -> Rollout:
    """One episode in each of `episodes` fresh environments; a row may go on after its first end."""
    envs = environments(task, episodes)
    parts: list[Rollout] = []
    observations, done = envs.reset(rng), np.zeros(episodes, bool)
    # Blocks, so that it ends soon after the slowest environment; all episodes end at the horizon at the latest.
    block = min(task.horizon, 100)
    while not done.all():
        steps = min(block, task.horizon - sum(p.ends.shape[1] for p in parts))
        begins = parts[-1].ends[:, -1] if parts else None
        rollout, observations = collect(envs, observations, steps, act, begins)
        parts.append(rollout)
        done |= rollout.ends.any(1)
    return joined(parts)


def step_rewards(reward: RewardModel[Segment]) -> StepRewardModel:
    """A control learner needs a reward for each step, not for whole segments alone."""
    if not isinstance(reward, StepRewardModel):
        raise ConfigError(
            f"a control learner needs a reward model with rewards(observations, actions), got {type(reward).__name__}; "
            "use reward.kind=mlp"
        )
    return reward


def _first_bad(rows: Floats) -> int:
    """The first of n rows with a number that is not finite."""
    return int(np.argwhere(~np.isfinite(rows))[0][0])
