"""Control tasks and learned rewards for stable-baselines3: usable in a script of your own, without the loop."""

from __future__ import annotations

from typing import Any, TypeAlias

import gymnasium
import numpy as np
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from prefrl.envs.spaces import MOST, choices_of, combinations, counted, numbers_of
from prefrl.policies.rollout import Rollout, check_begun, stepped
from prefrl.protocols import ControlTask, StepRewards, Transition
from prefrl.types import Floats


class TaskEnv(VecEnv):  # type: ignore[misc]  # stable-baselines3 is untyped here
    """A control task's environments as a stable-baselines3 `VecEnv`. Rewards are the gold: wrap it in `LearnedReward`.

    It keeps what happened since the last `start`, for segments to be cut from. Raises FloatingPointError, which names
    the environment and the step, where an observation or an action is not finite.
    """

    def __init__(self, task: ControlTask, count: int) -> None:
        high = np.full(task.observation_size, np.inf, np.float32)
        self.discrete = task.action_bounds is None
        actions = (
            gymnasium.spaces.Discrete(task.action_size)
            if task.action_bounds is None
            else gymnasium.spaces.Box(*task.action_bounds)
        )
        super().__init__(count, gymnasium.spaces.Box(-high, high), actions)
        self.envs, self._rng = task.environments(count), np.random.default_rng(0)
        self.steps, self._last = 0, np.zeros((count, task.observation_size), np.float32)
        self._rows: list[tuple[Floats, Floats, Floats | None, Transition]] = []

    def start(self, rng: np.random.Generator) -> None:
        """What the next reset draws from; forgets what happened before."""
        self._rng, self._rows = rng, []

    def reset(self) -> Floats:
        self._last = self.envs.reset(self._rng)
        check_begun(self._last)
        return self._last

    def step_async(self, actions: np.ndarray) -> None:
        # What is executed is what is kept: a segment must not hold an action that the simulator never saw.
        self._actions = executed(self.action_space, actions)

    def step_wait(self) -> tuple[Floats, Floats, np.ndarray, list[dict[str, Any]]]:
        states = self.envs.states()  # before the step, as a segment pairs each state with the action taken in it
        # Checked here: an algorithm that has learned from a number that is none may go on without a word.
        step = stepped(self.envs, self._last, self._actions, len(self._rows))
        # A copy: some simulators go on writing into the array that they gave out.
        self._rows.append((self._last, self._actions, None if states is None else states.copy(), step))
        self._last, self.steps = step.observations, self.steps + self.num_envs
        return step.observations, step.rewards.astype(np.float32), step.terminated | step.truncated, _infos(step)

    def rollout(self) -> Rollout:
        """Everything since `start`."""
        observations, actions, states, steps = (list(column) for column in zip(*self._rows, strict=True))
        chosen = np.stack(actions, 1)
        return Rollout(
            observations=np.stack(observations, 1),
            choices=chosen,
            actions=chosen,
            final_observations=np.stack([s.final_observations for s in steps], 1),
            terminated=np.stack([s.terminated for s in steps], 1),
            truncated=np.stack([s.truncated for s in steps], 1),
            gold=np.stack([s.rewards for s in steps], 1),
            states=None if states[0] is None else np.stack(states, 1),
        )

    def close(self) -> None: ...

    def get_attr(self, attr_name: str, indices: object = None) -> list[Any]:
        if attr_name == "render_mode":
            return [None] * self.num_envs
        raise AttributeError(f"environments of a prefrl task have no attribute {attr_name!r}")

    def set_attr(self, attr_name: str, value: object, indices: object = None) -> None:
        raise AttributeError(f"environments of a prefrl task have no attribute {attr_name!r}")

    def env_method(self, method_name: str, *args: object, indices: object = None, **kwargs: object) -> list[Any]:
        raise AttributeError(f"environments of a prefrl task have no method {method_name!r}")

    def env_is_wrapped(self, wrapper_class: type, indices: object = None) -> list[bool]:
        return [False] * self.num_envs


Seen: TypeAlias = Floats | dict[str, np.ndarray]
"""(n, ...) observations, or a dict of such arrays."""


class LearnedReward(VecEnvWrapper):  # type: ignore[misc]
    """Any `VecEnv` with a reward model's rewards in place of its own, which are dropped.

    Put it inside of whatever normalises observations: a reward model sees them raw, as rows of numbers. Swap `learned`
    after a fit; with a replay buffer, `relabel` it too. A reward that looks back sees the steps of the running episode.
    Raises FloatingPointError where a reward is not finite, and says so where that is the observation's fault.
    """

    def __init__(self, venv: VecEnv, reward: StepRewards | None) -> None:
        super().__init__(venv)
        self.learned = reward
        self._observations: Seen = np.zeros(0)
        self._actions: Floats = np.zeros(0)
        self._recent: list[tuple[Floats, Floats, np.ndarray]] = []
        self._begins = np.ones(venv.num_envs, bool)

    def reset(self) -> Seen:
        self._observations = self.venv.reset()
        self._recent, self._begins = [], np.ones(self.num_envs, bool)
        return self._observations

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = executed(self.action_space, actions)
        self.venv.step_async(actions)

    def step_wait(self) -> tuple[Seen, Floats, np.ndarray, list[dict[str, Any]]]:
        observations, _, dones, infos = self.venv.step_wait()
        # The observation that the action was chosen on, not the one it led to.
        self._recent.append((flattened(self.observation_space, self._observations), self._actions, self._begins))
        self._recent = self._recent[-(1 if self.learned is None else self.learned.memory) :]
        # (n, up to memory, .) steps -> (n,): the reward of the newest of them.
        rewards = scored(self.learned, *(np.stack(part, 1) for part in zip(*self._recent, strict=True)))[:, -1]
        # A VecEnv resets at once, so what follows a done is the first observation of an episode.
        self._observations, self._begins = observations, dones
        return observations, rewards, dones, infos


def flattened(space: gymnasium.Space[Any], observations: Seen) -> Floats:
    """(N, O) float32 rows of N observations, in gymnasium's order: a dict's parts by name, each choice one-hot."""
    if isinstance(space, gymnasium.spaces.Dict):
        assert isinstance(observations, dict)
        return np.concatenate([flattened(part, observations[name]) for name, part in space.spaces.items()], 1)
    assert not isinstance(observations, dict)
    if isinstance(space, gymnasium.spaces.Discrete):
        return executed(space, observations)
    if isinstance(space, gymnasium.spaces.MultiDiscrete):
        chosen = counted(space, observations)
        each = [np.eye(n, dtype=np.float32)[chosen[:, i]] for i, n in enumerate(choices_of(space))]
        return np.concatenate(each, 1)
    return np.asarray(observations, np.float32).reshape(len(observations), -1)


def executed(space: gymnasium.Space[Any], actions: np.ndarray) -> Floats:
    """Actions as a reward model sees them, (n, A) float32: clipped to a box's bounds, one-hot where discrete, and of
    several choices the combination, as a prefrl task has it."""
    if isinstance(space, gymnasium.spaces.Box):
        clipped: Floats = np.clip(actions, space.low, space.high).astype(np.float32)
        return clipped
    if isinstance(space, gymnasium.spaces.Discrete):
        chosen = np.asarray(actions).reshape(-1).astype(np.int64) - int(space.start)  # a Discrete may count from 1
        return np.eye(int(space.n), dtype=np.float32)[chosen]
    if not 0 < combinations(space) <= MOST:
        raise ValueError(
            "actions must be a Box, Discrete, or a MultiDiscrete or MultiBinary of at most "
            f"{MOST} combinations, got {space}"
        )
    found: Floats = np.eye(combinations(space), dtype=np.float32)[numbers_of(space, actions)]
    return found


def _infos(step: Transition) -> list[dict[str, Any]]:
    infos: list[dict[str, Any]] = [{} for _ in step.rewards]
    for i in np.flatnonzero(step.terminated | step.truncated):
        infos[i] = {
            # The observation returned is the next episode's already: the value of a time limit must come from here.
            "terminal_observation": step.final_observations[i],
            "TimeLimit.truncated": bool(step.truncated[i]),
        }
    return infos


def scored(reward: StepRewards | None, observations: Floats, actions: Floats, begins: np.ndarray) -> Floats:
    """(n, T) float32 rewards of T steps of n environments."""
    if reward is None:
        raise ValueError("LearnedReward has no reward model yet: set its `learned`")
    rewards = reward.rewards(observations, actions, begins)
    if not np.isfinite(rewards).all():
        i, t = np.argwhere(~np.isfinite(rewards))[0]
        if not np.isfinite(observations[i]).all():
            seen = observations[i][~np.isfinite(observations[i]).all(1)][0]
            raise FloatingPointError(
                f"an observation of environment {i} is not finite: {seen}; the simulation diverged, or the environment "
                "is at fault"
            )
        raise FloatingPointError(
            f"the learned reward of environment {i} is {rewards[i, t]} at observation {observations[i, t]}, "
            f"action {actions[i, t]}; expected finite rewards: look at the reward model's last fit"
        )
    return rewards.astype(np.float32)
