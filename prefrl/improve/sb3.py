"""stable-baselines3's algorithms on the learned reward, in the loop or in a script of your own.

In a script: `env = LearnedReward(any_vec_env, reward_model)`, and after each fit of the reward model
`relabel(model.replay_buffer, reward_model)` where the algorithm keeps a replay buffer. True rewards are never used.
"""

from __future__ import annotations

import random
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
import torch
from pydantic import Field, JsonValue
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.vec_env import VecEnv

from prefrl.components import ConfigError, Settings, missing
from prefrl.improve.player import Player
from prefrl.improve.vec_env import LearnedReward, TaskEnv, executed, relabel
from prefrl.policies.acting import Memory
from prefrl.policies.loaded import Actor
from prefrl.policies.rollout import Act, step_rewards
from prefrl.protocols import ControlTask, RewardModel, Store, Task, control
from prefrl.seeding import Device, device_of, draw_seed
from prefrl.types import Bools, Evaluation, Floats, Metrics, Segment, State, Steps

Name: TypeAlias = Literal["PPO", "A2C", "TRPO", "SAC", "TD3", "DDPG", "TQC", "CrossQ", "DQN"]


class Algorithm(NamedTuple):
    """What an algorithm can do, and its defaults."""

    package: str
    at_once: int
    """Steps in each environment between two updates: `n_steps` where it learns from rollouts, else `train_freq`."""
    replays: bool = True
    """Whether it learns from a replay buffer, which is relabelled after each fit of the reward."""
    actions: Literal["any", "box", "discrete"] = "box"
    batch: int = 0
    """The default `batch_size` of one that learns from rollouts."""


ALGORITHMS: dict[Name, Algorithm] = {
    "PPO": Algorithm("stable_baselines3", 2048, replays=False, actions="any", batch=64),
    "A2C": Algorithm("stable_baselines3", 5, replays=False, actions="any"),
    "TRPO": Algorithm("sb3_contrib", 2048, replays=False, actions="any", batch=128),
    "SAC": Algorithm("stable_baselines3", 1),
    "TD3": Algorithm("stable_baselines3", 1),
    "DDPG": Algorithm("stable_baselines3", 1),
    "TQC": Algorithm("sb3_contrib", 1),
    "CrossQ": Algorithm("sb3_contrib", 1),
    "DQN": Algorithm("stable_baselines3", 4, actions="discrete"),
}
OF_TASK = {"any": "any actions", "box": "continuous actions", "discrete": "discrete actions"}
BATCH = 64
"""Steps that a trial run takes in all."""
DISCOUNT = 0.99
"""The default `gamma` of its algorithms."""
COUNTERS = ("num_timesteps", "_n_updates", "_episode_num", "_n_calls")
REPLAY = ("observations", "next_observations", "actions", "rewards", "dones", "timeouts")


class SB3Settings(Settings):
    """An algorithm of stable-baselines3 or sb3-contrib on the learned reward."""

    kind: Literal["sb3"] = "sb3"
    algorithm: Name = "PPO"
    """Which one; DQN for discrete actions, SAC, TD3, DDPG, TQC and CrossQ for continuous ones, the others for both."""
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
    device: Device = "auto"
    """Where the policy and the reward model compute: `auto` is the GPU where there is one."""
    threads: int | None = Field(1, ge=1)
    """With how many threads torch and BLAS compute: more make small networks slower; null leaves it to them."""

    def shrunk(self) -> SB3Settings:
        """One rollout of a batch in each environment; with a replay buffer about as many, learning from the first."""
        if self.steps_per_round % (self.at_once * self.environments):
            return self  # building it says what is wrong
        options: dict[str, Any] = dict(self.options)
        known = ALGORITHMS[self.algorithm]
        if not known.replays:
            options["n_steps"] = each = min(self.at_once, options.get("batch_size", known.batch) or self.at_once)
        else:
            options["learning_starts"] = 0  # else a trial run would end before the first gradient step
            each = min(self.steps_per_round // self.environments, self.at_once * max(1, BATCH // self.at_once))
        steps = each * self.environments
        return self.model_copy(update={"options": options, "steps_per_round": steps, "evaluation_episodes": 1})

    def with_evaluation_of(self, other: SB3Settings) -> SB3Settings:
        return self.model_copy(update={"evaluation_episodes": other.evaluation_episodes})

    def work(self) -> float:
        return float(self.steps_per_round)

    @property
    def discount(self) -> float:
        """stable-baselines3's `gamma`."""
        options: dict[str, Any] = self.options
        return float(options.get("gamma", DISCOUNT))

    @property
    def at_once(self) -> int:
        """Steps that the algorithm collects in each environment between two updates."""
        options: dict[str, Any] = self.options
        known = ALGORITHMS[self.algorithm]
        if known.replays:
            return int(options.get("train_freq", known.at_once))
        return int(options.get("n_steps", min(known.at_once, max(self.steps_per_round // self.environments, 1))))

    def build(self, task: Task, rng: np.random.Generator) -> SB3:
        """Raises `ConfigError` for options that the algorithm does not have, and steps that it cannot take exactly."""
        found = control(task, f"learner kind {self.kind!r} acts in control tasks")
        wanted, here = ALGORITHMS[self.algorithm].actions, "discrete" if found.action_bounds is None else "box"
        if wanted not in ("any", here):
            fitting = [name for name, known in ALGORITHMS.items() if known.actions in ("any", here)]
            raise ConfigError(
                f"learner.algorithm={self.algorithm} needs {OF_TASK[wanted]}, and {found.name} has {OF_TASK[here]}; "
                f"use one of {', '.join(fitting)}"
            )
        return SB3(self, found, rng)

    def formula(self) -> str:
        """The objective, as text."""
        return f"stable-baselines3 {self.algorithm} on the learned reward, options {self.options or 'as by default'}"


class SB3:
    """A `prefrl.protocols.Learner` of segments around a stable-baselines3 algorithm.

    Its random numbers are seeded anew in each round and the global generators put back afterwards, its environments
    are reset, and weights, optimisers, replay and counters are all of its state: a run that was saved and loaded
    between rounds goes on bit for bit (CPU).
    """

    def __init__(self, settings: SB3Settings, task: ControlTask, rng: np.random.Generator) -> None:
        self._settings, self._replays = settings, ALGORITHMS[settings.algorithm].replays
        self._player = Player(task, settings.environments)
        self._env = TaskEnv(task, settings.environments)
        self._learned = LearnedReward(self._env, None)
        with seeded(rng):
            self.model = _algorithm(settings, self._learned)
        _check_steps(settings)

    @property
    def steps(self) -> Steps:
        return self._player.steps

    def sample(self, count: int, rng: np.random.Generator) -> list[Segment]:
        """Segments of the last round; before the first round, of the starting policy (query steps)."""
        # Only the first round acts here; later ones cut what was done already.
        with nullcontext() if self._player.rounds else seeded(rng):
            return self._player.sample(count, self._act(deterministic=False), rng)

    def improve(self, reward: RewardModel[Segment], store: Store[Segment], rng: np.random.Generator) -> Metrics:
        """`steps_per_round` environment steps of learning, from fresh episodes, after relabelling what is replayed."""
        self._learned.learned = step_rewards(reward)
        # Before learning: the buffer holds what the reward model said before its last fit.
        if self._replays:
            relabel(self.model.replay_buffer, step_rewards(reward))
        self._env.start(rng)
        self.model._last_obs = None  # makes learn() reset the environments
        with seeded(rng):
            self.model.action_space.seed(draw_seed(rng))  # a space has a generator of its own
            self.model.learn(self._settings.steps_per_round, reset_num_timesteps=False, log_interval=None)
        # Taken before the second start, which forgets it and so frees the memory.
        self._player.learned_from(self._env.rollout())
        self._env.start(rng)
        values = self.model.logger.name_to_value
        return {k.removeprefix("train/"): float(v) for k, v in values.items() if k.startswith("train/")}

    def evaluate(self, reward: RewardModel[Segment], rng: np.random.Generator) -> Evaluation[Segment]:
        """The policy's mode in fresh environments."""
        act = self._act(deterministic=True)
        return self._player.evaluate(self._settings.evaluation_episodes, act, reward, rng)

    def actor(self) -> Actor:
        def act(observations: Floats, rng: np.random.Generator | None, memory: Memory) -> tuple[Floats, Memory]:
            fresh = np.zeros(len(observations), bool)
            return self._act(deterministic=rng is None)(observations, None, fresh)[1], memory

        return act

    def save(self, path: Path) -> None:
        """As stable-baselines3 saves it: `SAC.load` and its like read it."""
        self.model.save(path)

    def state(self) -> State:
        names, variables = self.model._get_torch_save_params()
        counters = {name: getattr(self.model, name) for name in COUNTERS if hasattr(self.model, name)}
        return {
            "modules": {name: _attribute(self.model, name).state_dict() for name in names},
            "variables": {name: getattr(self.model, name).detach().clone() for name in variables},
            "counters": counters,
            "replay": _replay_state(self.model.replay_buffer) if self._replays else None,
        } | self._player.state()

    def load(self, state: State) -> None:
        for name, values in state["modules"].items():
            _attribute(self.model, name).load_state_dict(values)
        for name, value in state["variables"].items():
            getattr(self.model, name).data.copy_(value)
        for name, value in state["counters"].items():
            setattr(self.model, name, value)
        if self._replays:
            _load_replay(self.model.replay_buffer, state["replay"])
        self._player.load(state)

    def _act(self, deterministic: bool) -> Act:
        def act(observations: Floats, legal: Bools | None, begins: Bools) -> tuple[Floats, Floats]:
            chosen, _ = self.model.predict(observations, deterministic=deterministic)
            actions = executed(self._env.action_space, chosen)
            return actions, actions

        return act


@contextmanager
def seeded(rng: np.random.Generator) -> Iterator[None]:
    """stable-baselines3 draws from the global generators: seed them from `rng`, and put them back at the end."""
    python, numpy_ = random.getstate(), np.random.get_state()
    try:
        # CPU only: by default the state of every GPU would be saved as well.
        with torch.random.fork_rng(devices=range(torch.cuda.device_count())):
            seed = draw_seed(rng)
            random.seed(seed)
            np.random.seed(seed)
            torch.manual_seed(seed)
            yield
    finally:
        random.setstate(python)
        np.random.set_state(numpy_)


def algorithm_class(name: Name) -> type[BaseAlgorithm]:
    """Raises `ConfigError` where its package is not installed."""
    try:
        found: type[BaseAlgorithm] = getattr(import_module(ALGORITHMS[name].package), name)
    except ModuleNotFoundError as error:
        raise ConfigError(f"learner.algorithm={name}: {missing(error)}") from error
    return found


def _algorithm(settings: SB3Settings, env: VecEnv) -> Any:
    options = dict(settings.options)
    if not ALGORITHMS[settings.algorithm].replays:
        options.setdefault("n_steps", settings.at_once)
    try:
        device = device_of(settings.device)
        return algorithm_class(settings.algorithm)(
            "MlpPolicy", env, policy_kwargs=dict(settings.policy) or None, device=device, verbose=0, **options
        )
    except TypeError as error:  # an option that its constructor does not have
        raise ConfigError(f"learner.options: stable-baselines3's {settings.algorithm} says: {error}") from error


def _check_steps(settings: SB3Settings) -> None:
    """The algorithms overshoot a budget that is no multiple of what they collect at once."""
    at_once = settings.at_once
    unit = at_once * settings.environments
    if settings.steps_per_round % unit:
        raise ConfigError(
            f"learner.steps_per_round must be a multiple of {unit} ({settings.algorithm} collects {at_once} steps in "
            f"each of {settings.environments} environments at once), got {settings.steps_per_round}"
        )


def _attribute(model: Any, dotted: str) -> Any:
    for name in dotted.split("."):
        model = getattr(model, name)
    return model


def _replay_state(buffer: ReplayBuffer) -> State:
    size = buffer.size()
    # What is filled, not what is allocated: a buffer may have room for a million steps.
    return {name: getattr(buffer, name)[:size].copy() for name in REPLAY} | {"pos": buffer.pos, "full": buffer.full}


def _load_replay(buffer: ReplayBuffer, state: State) -> None:
    for name in REPLAY:
        values = state[name]
        if values.shape[0] > buffer.buffer_size or values.shape[1:] != getattr(buffer, name).shape[1:]:
            raise ValueError(f"replay: {name} has shape {values.shape}, which this buffer cannot hold: other settings")
        getattr(buffer, name)[: len(values)] = values
    buffer.pos, buffer.full = state["pos"], state["full"]


__all__: Sequence[str] = ("SB3", "LearnedReward", "SB3Settings", "TaskEnv", "executed", "relabel", "seeded")
