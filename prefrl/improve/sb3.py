"""stable-baselines3's algorithms on the learned reward, in the loop or in a script of your own.

In a script: `env = LearnedReward(any_vec_env, reward_model)`, and after each fit of the reward model
`relabel(model.replay_buffer, reward_model)` where the algorithm keeps a replay buffer. True rewards are never used.
`explore_steps` before the first question and SAC make it PEBBLE (Lee, Smith and Abbeel 2021; `explore.py` says what
differs).
"""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from copy import deepcopy
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeAlias

import numpy as np
import torch
from pydantic import Field, JsonValue
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.vec_env import VecEnv

from prefrl.components import ConfigError, Settings, missing, suggest
from prefrl.improve.explore import explore
from prefrl.improve.player import Player
from prefrl.improve.replay import cut, load_replay, relabel, replay_state
from prefrl.improve.sb3_start import take_over
from prefrl.improve.vec_env import LearnedReward, TaskEnv, executed
from prefrl.policies.acting import Actor, Memory, played
from prefrl.policies.loaded import check_leaves
from prefrl.policies.networks import predicted
from prefrl.policies.rollout import Act, Rollout, step_rewards
from prefrl.protocols import ControlTask, RewardModel, Store, Task, simulated
from prefrl.seeding import Device, device_of, draw_seed
from prefrl.types import Bools, Evaluation, Floats, Metrics, Segment, State, Steps

Name: TypeAlias = Literal[
    "PPO", "A2C", "TRPO", "RecurrentPPO", "SAC", "TD3", "DDPG", "TQC", "CrossQ", "DQN", "DoubleDQN", "QRDQN"
]


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
    draws: bool = True
    """Whether its policy draws actions. Where it does not, first questions are about random actions."""
    policy: str = "MlpPolicy"
    """Which of its policies."""

    @property
    def explores(self) -> bool:
        """Whether it has what `explore` needs: an actor that explores, a critic to put back, and a replay buffer."""
        return self.replays and self.actions == "box"


ALGORITHMS: dict[Name, Algorithm] = {
    "PPO": Algorithm("stable_baselines3", 2048, replays=False, actions="any", batch=64),
    "A2C": Algorithm("stable_baselines3", 5, replays=False, actions="any"),
    "TRPO": Algorithm("sb3_contrib", 2048, replays=False, actions="any", batch=128),
    "RecurrentPPO": Algorithm("sb3_contrib", 128, replays=False, actions="any", batch=128, policy="MlpLstmPolicy"),
    "SAC": Algorithm("stable_baselines3", 1),
    "TD3": Algorithm("stable_baselines3", 1, draws=False),
    "DDPG": Algorithm("stable_baselines3", 1, draws=False),
    "TQC": Algorithm("sb3_contrib", 1),
    "CrossQ": Algorithm("sb3_contrib", 1),
    "DQN": Algorithm("stable_baselines3", 4, actions="discrete", draws=False),
    "DoubleDQN": Algorithm("prefrl.improve.double_dqn", 4, actions="discrete", draws=False),
    "QRDQN": Algorithm("sb3_contrib", 4, actions="discrete", draws=False),
}
OF_TASK = {"any": "any actions", "box": "continuous actions", "discrete": "discrete actions"}
BATCH = 64
"""Steps that a trial run takes in all."""
DISCOUNT = 0.99
"""The default `gamma` of its algorithms."""
LARGEST = 1e10
"""No weight that does anything is as large: what learning left there is numbers no more."""
COUNTERS = ("num_timesteps", "_n_updates", "_episode_num", "_n_calls", "exploration_rate")


class SB3Settings(Settings):
    """An algorithm of stable-baselines3 or sb3-contrib on the learned reward."""

    kind: Literal["sb3"] = "sb3"
    algorithm: Name = "PPO"
    """Which one; DQN, DoubleDQN and QRDQN for discrete actions, SAC, TD3, DDPG, TQC and CrossQ for continuous ones, the
    others for both. RecurrentPPO remembers."""
    environments: int = Field(8, ge=1)
    """How many are stepped side by side."""
    steps_per_round: int = Field(8192, ge=1)
    """Environment steps of one round's learning: a multiple of what the algorithm collects between two updates."""
    explore_steps: int = Field(0, ge=0)
    """Environment steps before the first question, in which an algorithm with an actor and a replay buffer looks for
    states unlike those it has seen (PEBBLE); the first questions are about what it did then."""
    rollback: float | None = Field(None, ge=0)
    """What share of all that was gained, by the newest reward, a round may lose before the policy goes back to the best
    one (0.1, say); null keeps whatever comes, and no best policy beside the last one."""
    options: dict[str, JsonValue] = Field(default_factory=dict)
    """Arguments of the algorithm (learning_rate, gamma, batch_size, ...), as its own documentation names them."""
    policy: dict[str, JsonValue] = Field(default_factory=dict)
    """stable-baselines3's `policy_kwargs`, such as net_arch: [64, 64] and activation_fn: relu (a class of torch.nn, in
    whatever case). The class of policies is the algorithm's for rows of numbers, MlpPolicy or MlpLstmPolicy."""
    start: Path | None = None
    """A zip of the same algorithm, or a run with it, whose networks this one starts from; from the working directory
    where it is relative. It needs the same widths and spaces; optimisers and what is replayed begin anew."""
    evaluation_episodes: int = Field(20, ge=1)
    """Episodes of an evaluation, without exploration, in environments of their own."""
    device: Device = "auto"
    """Where the policy and the reward model compute: `auto` is the GPU where there is one."""
    threads: int | None = Field(1, ge=1)
    """With how many threads torch and BLAS compute: more make small networks slower; null leaves it to them."""

    def shrunk(self) -> SB3Settings:
        """One rollout of a batch in each environment; with a replay buffer about as many, learning from the first."""
        if self.steps_per_round % self.unit or self.explore_steps % self.unit:
            return self  # building it says what is wrong
        options: dict[str, Any] = dict(self.options)
        known = ALGORITHMS[self.algorithm]
        if not known.replays:
            options["n_steps"] = each = min(self.at_once, options.get("batch_size", known.batch) or self.at_once)
        else:
            options["learning_starts"] = 0  # else a trial run would end before the first gradient step
            each = min(self.steps_per_round // self.environments, self.at_once * max(1, BATCH // self.at_once))
        steps = each * self.environments
        update = {"options": options, "steps_per_round": steps, "evaluation_episodes": 1, "explore_steps": 0}
        return self.model_copy(update=update)

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

    @property
    def unit(self) -> int:
        """Steps that the algorithm collects at once, in all environments."""
        return self.at_once * self.environments

    def build(self, task: Task, rng: np.random.Generator) -> SB3:
        """Raises `ConfigError` for options that the algorithm does not have, and steps that it cannot take exactly."""
        found = simulated(task, f"learner kind {self.kind!r} acts in control tasks")
        wanted, here = ALGORITHMS[self.algorithm].actions, "discrete" if found.action_bounds is None else "box"
        if wanted not in ("any", here):
            fitting = [name for name, known in ALGORITHMS.items() if known.actions in ("any", here)]
            raise ConfigError(
                f"learner.algorithm={self.algorithm} needs {OF_TASK[wanted]}, and {found.name} has {OF_TASK[here]}; "
                f"use one of {', '.join(fitting)}"
            )
        if self.explore_steps and not ALGORITHMS[self.algorithm].explores:
            fitting = [name for name, known in ALGORITHMS.items() if known.explores]
            raise ConfigError(
                f"learner.explore_steps={self.explore_steps} needs an actor and a replay buffer: "
                f"{', '.join(fitting)}; {self.algorithm} has not both, leave it at 0"
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
        self._settings, self._known = settings, ALGORITHMS[settings.algorithm]
        self._task, self._player = task, Player(task, settings.environments)
        self._env = TaskEnv(task, settings.environments)
        self._learned = LearnedReward(self._env, None)
        self._end = 0.0
        with seeded(rng):
            self._model = _algorithm(settings, self._learned)
        _check_steps(settings)
        # Read when it is first needed: a run that goes on has networks of its own, and what it began with may be gone.
        self._start = settings.start

    @property
    def model(self) -> Any:
        """stable-baselines3's, with the networks that it starts from."""
        if self._start is not None:
            take_over(self._model, self._start, self._task)
            self._start = None
        return self._model

    @property
    def steps(self) -> Steps:
        return self._player.steps

    def sample(self, count: int, rng: np.random.Generator) -> list[Segment]:
        """Segments of the last round; before the first round, of exploring, or of the starting policy (query steps)."""
        if self._settings.explore_steps and not self._player.moved:
            with self._learning(rng):
                explore(self.model, self._learned, self._settings.explore_steps, self._settings.unit)
            self._player.explored(self._taken(rng))
        # Only the first round acts here; later ones cut what was done already.
        with nullcontext() if self._player.rounds else seeded(rng):
            shown = self._known.draws or self._settings.start is not None
            act = self._act(deterministic=False) if shown else self._random(rng)
            return self._player.sample(count, act, rng)

    def improve(self, reward: RewardModel[Segment], store: Store[Segment], rng: np.random.Generator) -> Metrics:
        """`steps_per_round` environment steps of learning, from fresh episodes, after relabelling what is replayed."""
        self._learned.learned = step_rewards(reward)
        # Before learning: the buffer holds what the reward model said before its last fit.
        if self._known.replays:
            relabel(self.model.replay_buffer, step_rewards(reward))
        steps = self._settings.steps_per_round
        with self._learning(rng):
            self.model.learn(steps, self._paced(steps), reset_num_timesteps=False, log_interval=None)
        self._player.learned_from(self._taken(rng))
        values = self.model.logger.name_to_value
        return {k.removeprefix("train/"): float(v) for k, v in values.items() if k.startswith("train/")}

    def evaluate(self, reward: RewardModel[Segment], rng: np.random.Generator) -> Evaluation[Segment]:
        """The policy's mode in fresh environments."""
        act = self._act(deterministic=True)
        return self._player.evaluate(self._settings.evaluation_episodes, act, reward, rng)

    def settle(self, reward: RewardModel[Segment]) -> Evaluation[Segment] | None:
        """Go back to the best policy, by the newest reward, where the last round lost clearly (`Best.settle`).

        Networks and optimisers go back; what is replayed stays, and so does the learning rate, which is the options'.
        """
        if self._settings.rollback is None:
            return None
        undone = self._player.settle(deepcopy(self._networks()), reward, self._settings.rollback)
        if undone is not None:
            self.go_back()
        return undone

    def go_back(self) -> int | None:
        best = self._player.best
        if best.weights is None:
            return None
        self._load_networks(deepcopy(best.weights))  # a copy: optimisers go on writing into what they are given
        return best.round

    def pace(self, begin: float, end: float) -> None:
        self._end = end

    def actor(self) -> Actor:
        def act(observations: Floats, rng: np.random.Generator | None, memory: Memory) -> tuple[Floats, Memory]:
            return self._chosen(observations, memory, deterministic=rng is None)

        return act

    def save(self, path: Path) -> None:
        """As stable-baselines3 saves it: `SAC.load` and its like read it. Raises as `check_leaves` does."""
        check_leaves(self._task)
        self.model.save(path)

    def state(self) -> State:
        counters = {name: getattr(self.model, name) for name in COUNTERS if hasattr(self.model, name)}
        replay = replay_state(self.model.replay_buffer) if self._known.replays else None
        return self._networks() | {"counters": counters, "replay": replay} | self._player.state()

    def load(self, state: State) -> None:
        self._start = None
        self._load_networks(state)
        for name, value in state["counters"].items():
            setattr(self.model, name, value)
        if self._known.replays:
            load_replay(self.model.replay_buffer, state["replay"])
        self._player.load(state)

    def _networks(self) -> State:
        """Networks, optimisers and what else is learned."""
        names, variables = self.model._get_torch_save_params()
        return {
            "modules": {name: _attribute(self.model, name).state_dict() for name in names},
            "variables": {name: getattr(self.model, name).detach().clone() for name in variables},
        }

    def _load_networks(self, state: State) -> None:
        for name, values in state["modules"].items():
            _attribute(self.model, name).load_state_dict(values)
        for name, value in state["variables"].items():
            getattr(self.model, name).data.copy_(value)

    @contextmanager
    def _learning(self, rng: np.random.Generator) -> Iterator[None]:
        """What the algorithm learns in starts with fresh episodes, and is drawn from `rng`."""
        self._env.start(rng)
        self.model._last_obs = None  # makes learn() reset the environments
        if "tensorboard_log" not in self._settings.options:
            self.model.set_logger(Logger(None, []))  # its own would leave a folder in the system's /tmp each time
        try:
            with seeded(rng):
                self.model.action_space.seed(draw_seed(rng))  # a space has a generator of its own
                yield
        except ValueError as error:  # torch's, of a distribution that is none
            self._check_weights(error)
            raise
        self._check_weights()
        if self._known.replays:
            cut(self.model.replay_buffer)

    def _check_weights(self, cause: Exception | None = None) -> None:
        """Raise FloatingPointError where what was learned is no policy any more."""
        for name, weights in self.model.policy.named_parameters():
            if not (weights.abs() < LARGEST).all():  # NaN is not below anything
                algorithm, steps = type(self.model).__name__, self.model.num_timesteps
                raise FloatingPointError(
                    f"{algorithm}: after {steps} steps a weight of the policy ({name}) is not finite, or beyond "
                    f"{LARGEST:g}: lower learner.options.learning_rate"
                ) from cause

    def _taken(self, rng: np.random.Generator) -> Rollout:
        """What was done in it."""
        # Taken before the second start, which forgets it and so frees the memory.
        rollout = self._env.rollout()
        self._env.start(rng)
        return rollout

    def _paced(self, steps: int) -> Callable[[object, object], bool]:
        """A callback that spreads schedules (the exploration of DQN) over the run, where each call of learn() would
        begin them anew."""
        total = round((self.model.num_timesteps + steps) / self._end) if self._end else None

        def spread(*_: object) -> bool:
            if total is not None:
                self.model._total_timesteps = total
            return True

        return spread

    def _random(self, rng: np.random.Generator) -> Act:
        space = self.model.action_space

        def act(observations: Floats, legal: Bools | None, begins: Bools) -> tuple[Floats, Floats]:
            if self._env.discrete:
                chosen: np.ndarray = rng.integers(space.n, size=len(observations))
            else:
                chosen = rng.uniform(space.low, space.high, (len(observations), *space.shape))
            actions = executed(space, chosen)
            return actions, actions

        return act

    def _act(self, deterministic: bool) -> Act:
        """In episodes that are yet to begin."""
        return played(lambda observations, _, memory: self._chosen(observations, memory, deterministic), None)

    def _chosen(self, observations: Floats, memory: Memory, deterministic: bool) -> tuple[Floats, Memory]:
        """(n, O) and (n, M) -> (n, A) actions to execute, and what is remembered now, if anything."""
        chosen, memory = predicted(self.model, self.model.policy, observations, memory, deterministic)
        return executed(self._env.action_space, chosen), memory


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
    made, device = algorithm_class(settings.algorithm), device_of(settings.device)
    network, kwargs = ALGORITHMS[settings.algorithm].policy, _network(settings.policy) or None
    try:
        return made(network, env, policy_kwargs=kwargs, device=device, verbose=0, **options)
    except (TypeError, ValueError, AssertionError) as error:  # what its constructor does not have, or cannot use
        named = ("Policy", *settings.policy)  # whose constructor that was, or which argument
        where = "policy" if any(name in str(error) for name in named) else "options"
        said = error or "nothing; one of these has a value that it cannot use"
        raise ConfigError(
            f"learner.{where}={getattr(settings, where)}: stable-baselines3's {settings.algorithm} says: {said}"
        ) from error


def _network(policy: dict[str, JsonValue]) -> dict[str, Any]:
    """`policy_kwargs`, with a class of torch.nn for the name of one."""
    found: dict[str, Any] = dict(policy)
    if isinstance(name := found.get("activation_fn"), str):
        classes = {each.lower(): each for each in torch.nn.modules.activation.__all__}
        if name.lower() not in classes:
            raise ConfigError(f"learner.policy.activation_fn: {name!r} is none of torch.nn's; {suggest(name, classes)}")
        found["activation_fn"] = getattr(torch.nn, classes[name.lower()])
    return found


def _check_steps(settings: SB3Settings) -> None:
    """The algorithms overshoot a budget that is no multiple of what they collect at once."""
    for name, steps in (("steps_per_round", settings.steps_per_round), ("explore_steps", settings.explore_steps)):
        if steps % settings.unit:
            raise ConfigError(
                f"learner.{name} must be a multiple of {settings.unit} ({settings.algorithm} collects "
                f"{settings.at_once} steps in each of {settings.environments} environments at once), got {steps}"
            )


def _attribute(model: Any, dotted: str) -> Any:
    for name in dotted.split("."):
        model = getattr(model, name)
    return model


__all__: Sequence[str] = ("SB3", "LearnedReward", "SB3Settings", "TaskEnv", "executed", "relabel", "seeded")
