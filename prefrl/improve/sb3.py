"""stable-baselines3's algorithms on the learned reward, in the loop or in a script of your own.

In a script: `env = LearnedReward(any_vec_env, reward_model)`, and after each fit of the reward model
`relabel(model.replay_buffer, reward_model)` where the algorithm keeps a replay buffer. True rewards are never used.
"""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Literal

import gymnasium
import numpy as np
import torch
from pydantic import Field, JsonValue
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecEnv, VecEnvWrapper

from prefrl.components import ConfigError, Settings
from prefrl.improve.rollout import (
    Rollout,
    control,
    cut,
    evaluation,
    first_rollout,
    step_rewards,
    whole_episodes,
)
from prefrl.protocols import ControlTask, RewardModel, StepRewardModel, Store, Task, Transition
from prefrl.seeding import draw_seed
from prefrl.types import Evaluation, Floats, Metrics, Segment, State, Steps

ALGORITHMS = {"PPO": PPO, "SAC": SAC}
PPO_STEPS = 2048
"""stable-baselines3's default `n_steps`."""
REPLAY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


class SB3Settings(Settings):
    """stable-baselines3's PPO or SAC on the learned reward."""

    kind: Literal["sb3"] = "sb3"
    algorithm: Literal["PPO", "SAC"] = "PPO"
    """Which one of stable-baselines3's."""
    environments: int = Field(8, ge=1)
    """How many are stepped side by side."""
    steps_per_round: int = Field(8192, ge=1)
    """Environment steps of one round's learning: a multiple of what the algorithm collects between two updates."""
    options: dict[str, JsonValue] = Field(default_factory=dict)
    """Arguments of the algorithm (learning_rate, gamma, batch_size, ...), as its own documentation names them."""
    policy: dict[str, JsonValue] = Field(default_factory=dict)
    """stable-baselines3's `policy_kwargs`, such as net_arch: [64, 64]."""
    evaluation_episodes: int = Field(20, ge=1)
    """Episodes of an evaluation, without exploration, in environments of their own."""

    def build(self, task: Task, rng: np.random.Generator) -> SB3:
        """Raises `ConfigError` for options that the algorithm does not have, and steps that it cannot take exactly."""
        found = control(task, self.kind)
        if self.algorithm == "SAC" and found.action_bounds is None:
            raise ConfigError("learner.algorithm=SAC needs continuous actions; use PPO")
        return SB3(self, found, rng)

    def formula(self) -> str:
        """The objective, as text."""
        return f"stable-baselines3 {self.algorithm} on the learned reward, options {self.options or 'as by default'}"


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

    Put it inside of whatever normalises observations: a reward model sees them raw. Swap `reward` after a fit; with
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


class SB3:
    """A `prefrl.protocols.Learner` of segments around a stable-baselines3 algorithm.

    Its random numbers are seeded anew in each round and the global generators put back afterwards, its environments
    are reset, and weights, optimisers, replay and counters are all of its state: a run that was saved and loaded
    between rounds goes on bit for bit (CPU).
    """

    def __init__(self, settings: SB3Settings, task: ControlTask, rng: np.random.Generator) -> None:
        self._settings, self._task = settings, task
        self._env = TaskEnv(task, settings.environments)
        self._learned = LearnedReward(self._env, None)
        with seeded(rng):
            self.model = _algorithm(settings, self._learned)
        _check_steps(settings, self.model)
        self._steps, self._rounds = Steps(), 0
        self._recent: Rollout | None = None

    @property
    def steps(self) -> Steps:
        return self._steps

    def sample(self, count: int, rng: np.random.Generator) -> list[Segment]:
        """Segments of the last round; before the first round, of the starting policy (query steps)."""
        rollout = self._recent
        if rollout is None:
            with seeded(rng):
                act, most = self._act(deterministic=False), self._settings.environments
                rollout = first_rollout(self._task, act, count, most, rng)
            self._steps = self._steps.add(query=rollout.ends.size)
        return cut(rollout, self._task.segment_steps, count, f"round {self._rounds}", rng)

    def improve(self, reward: RewardModel[Segment], store: Store[Segment], rng: np.random.Generator) -> Metrics:
        """`steps_per_round` environment steps of learning, from fresh episodes, after relabelling what is replayed."""
        self._learned.learned, before = step_rewards(reward), self._env.steps
        if isinstance(self.model, SAC):
            relabel(self.model.replay_buffer, step_rewards(reward))
        self._env.start(rng)
        self.model._last_obs = None  # makes learn() reset the environments
        with seeded(rng):
            self.model.action_space.seed(draw_seed(rng))
            self.model.learn(self._settings.steps_per_round, reset_num_timesteps=False, log_interval=None)
        self._steps = self._steps.add(learn=self._env.steps - before)
        self._recent, self._rounds = self._env.rollout(), self._rounds + 1
        self._env.start(rng)
        values = self.model.logger.name_to_value
        return {k.removeprefix("train/"): float(v) for k, v in values.items() if k.startswith("train/")}

    def evaluate(self, reward: RewardModel[Segment], rng: np.random.Generator) -> Evaluation[Segment]:
        """The policy's mode in fresh environments."""
        episodes = self._settings.evaluation_episodes
        rollout = whole_episodes(self._task, self._act(deterministic=True), episodes, rng)
        self._steps = self._steps.add(evaluate=rollout.ends.size)
        return evaluation(self._task, rollout, reward)

    def state(self) -> State:
        names, variables = self.model._get_torch_save_params()
        counters = {name: getattr(self.model, name) for name in ("num_timesteps", "_n_updates", "_episode_num")}
        return {
            "modules": {name: _attribute(self.model, name).state_dict() for name in names},
            "variables": {name: getattr(self.model, name).detach().clone() for name in variables},
            "counters": counters,
            "replay": _replay_state(self.model.replay_buffer) if isinstance(self.model, SAC) else None,
            "recent": None if self._recent is None else self._recent.state(),
            "steps": list(self._steps),
            "rounds": self._rounds,
        }

    def load(self, state: State) -> None:
        for name, values in state["modules"].items():
            _attribute(self.model, name).load_state_dict(values)
        for name, value in state["variables"].items():
            getattr(self.model, name).data.copy_(value)
        for name, value in state["counters"].items():
            setattr(self.model, name, value)
        if isinstance(self.model, SAC):
            _load_replay(self.model.replay_buffer, state["replay"])
        self._recent = None if state["recent"] is None else Rollout(**state["recent"])
        self._steps, self._rounds = Steps(*state["steps"]), state["rounds"]

    def _act(self, deterministic: bool) -> Any:
        def act(observations: Floats) -> tuple[Floats, Floats]:
            chosen, _ = self.model.predict(observations, deterministic=deterministic)
            actions = executed(self._env.action_space, chosen)
            return actions, actions

        return act


@contextmanager
def seeded(rng: np.random.Generator) -> Iterator[None]:
    """stable-baselines3 draws from the global generators: seed them from `rng`, and put them back at the end."""
    python, numpy_ = random.getstate(), np.random.get_state()
    try:
        with torch.random.fork_rng(devices=[]):
            seed = draw_seed(rng)
            random.seed(seed)
            np.random.seed(seed)
            torch.manual_seed(seed)
            yield
    finally:
        random.setstate(python)
        np.random.set_state(numpy_)


def _algorithm(settings: SB3Settings, env: VecEnv) -> Any:
    options = dict(settings.options)
    each = settings.steps_per_round // settings.environments
    if settings.algorithm == "PPO":
        options.setdefault("n_steps", min(PPO_STEPS, max(each, 1)))
    try:
        return ALGORITHMS[settings.algorithm](
            "MlpPolicy", env, policy_kwargs=dict(settings.policy) or None, device="cpu", verbose=0, **options
        )
    except TypeError as error:
        raise ConfigError(f"learner.options: stable-baselines3's {settings.algorithm} says: {error}") from error


def _check_steps(settings: SB3Settings, model: Any) -> None:
    """The algorithms overshoot a budget that is no multiple of what they collect at once."""
    at_once = model.n_steps if settings.algorithm == "PPO" else model.train_freq.frequency
    unit = int(at_once) * settings.environments
    if settings.steps_per_round % unit:
        raise ConfigError(
            f"learner.steps_per_round must be a multiple of {unit} ({settings.algorithm} collects {at_once} steps in "
            f"each of {settings.environments} environments at once), got {settings.steps_per_round}"
        )


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


def _attribute(model: Any, dotted: str) -> Any:
    for name in dotted.split("."):
        model = getattr(model, name)
    return model


def _replay_state(buffer: ReplayBuffer) -> State:
    size = buffer.size()
    return {name: getattr(buffer, name)[:size].copy() for name in REPLAY} | {"pos": buffer.pos, "full": buffer.full}


def _load_replay(buffer: ReplayBuffer, state: State) -> None:
    for name in REPLAY:
        values = state[name]
        if values.shape[0] > buffer.buffer_size or values.shape[1:] != getattr(buffer, name).shape[1:]:
            raise ValueError(f"replay: {name} has shape {values.shape}, which this buffer cannot hold: other settings")
        getattr(buffer, name)[: len(values)] = values
    buffer.pos, buffer.full = state["pos"], state["full"]


__all__: Sequence[str] = ("SB3", "LearnedReward", "SB3Settings", "TaskEnv", "executed", "relabel", "seeded")
