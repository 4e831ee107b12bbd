"""Control tasks and learned rewards for stable-baselines3: usable in a script of your own, without the loop."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from prefrl.improve.rollout import Rollout
from prefrl.protocols import ControlTask, StepRewardModel, Transition
from prefrl.types import Floats


class TaskEnv(VecEnv):  # type: ignore[misc]  # stable-baselines3 is untyped here
    """A control task's environments as a stable-baselines3 `VecEnv`. Rewards are the gold: wrap it in `LearnedReward`.

    It keeps what happened since the last `start`, for segments to be cut from.
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
        return self._last

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = executed(self.action_space, actions)

    def step_wait(self) -> tuple[Floats, Floats, np.ndarray, list[dict[str, Any]]]:
        states = self.envs.states()
        step = self.envs.step(self._actions)
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


class LearnedReward(VecEnvWrapper):  # type: ignore[misc]
    """Any `VecEnv` with a reward model's rewards in place of its own, which are dropped.

    Put it inside of whatever normalises observations: a reward model sees them raw. Swap `learned` after a fit; with
    a replay buffer, `relabel` it too. Raises FloatingPointError where a reward is not finite.
    """

    def __init__(self, venv: VecEnv, reward: StepRewardModel | None) -> None:
        super().__init__(venv)
        self.learned = reward
        self._observations: Floats = np.zeros(0)
        self._actions: Floats = np.zeros(0)

    def reset(self) -> Floats:
        self._observations = self.venv.reset()
        return self._observations

    def step_async(self, actions: np.ndarray) -> None:
        self._actions = executed(self.action_space, actions)
        self.venv.step_async(actions)

    def step_wait(self) -> tuple[Floats, Floats, np.ndarray, list[dict[str, Any]]]:
        observations, _, dones, infos = self.venv.step_wait()
        rewards = _score(self.learned, self._observations, self._actions)
        self._observations = observations
        return observations, rewards, dones, infos


def relabel(buffer: ReplayBuffer, reward: StepRewardModel) -> None:
    """Recompute every reward of a replay buffer (Lee et al. 2021, PEBBLE, section 4.2), in place.

    Raises ValueError for buffers that keep something else than one transition a slot.
    """
    if type(buffer) is not ReplayBuffer:
        raise ValueError(f"relabel needs stable-baselines3's plain ReplayBuffer, got {type(buffer).__name__}")
    size, space = buffer.size(), buffer.action_space
    if size == 0:
        return
    actions = buffer.actions[:size]
    if isinstance(space, gymnasium.spaces.Box):  # the buffer keeps actions scaled to [-1, 1]
        actions = space.low + 0.5 * (actions + 1.0) * (space.high - space.low)
    flat = executed(space, actions.reshape(size * buffer.n_envs, -1))
    observations = buffer.observations[:size].reshape(size * buffer.n_envs, -1)
    buffer.rewards[:size] = _score(reward, observations, flat).reshape(size, buffer.n_envs)


def executed(space: gymnasium.Space[Any], actions: np.ndarray) -> Floats:
    """Actions as a reward model sees them, (n, A) float32: clipped to a box's bounds, one-hot where discrete."""
    if isinstance(space, gymnasium.spaces.Box):
        clipped: Floats = np.clip(actions, space.low, space.high).astype(np.float32)
        return clipped
    if isinstance(space, gymnasium.spaces.Discrete):
        chosen = np.asarray(actions).reshape(-1).astype(np.int64) - int(space.start)
        return np.eye(int(space.n), dtype=np.float32)[chosen]
    raise ValueError(f"actions must be a Box or Discrete, got {space}")


def _infos(step: Transition) -> list[dict[str, Any]]:
    infos: list[dict[str, Any]] = [{} for _ in step.rewards]
    for i in np.flatnonzero(step.terminated | step.truncated):
        infos[i] = {
            "terminal_observation": step.final_observations[i],
            "TimeLimit.truncated": bool(step.truncated[i]),
        }
    return infos


def _score(reward: StepRewardModel | None, observations: Floats, actions: Floats) -> Floats:
    """(n,) float32 rewards of n single steps."""
    if reward is None:
        raise ValueError("LearnedReward has no reward model yet: set its `learned`")
    rewards = reward.rewards(observations[:, None], actions[:, None])[:, 0]
    if not np.isfinite(rewards).all():
        i = int(np.flatnonzero(~np.isfinite(rewards))[0])
        raise FloatingPointError(
            f"the learned reward of environment {i} is {rewards[i]} at observation {observations[i]}, "
            f"action {actions[i]}; expected finite rewards: look at the reward model's last fit"
        )
    return rewards.astype(np.float32)
