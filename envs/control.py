"""Control tasks: episodes of any gymnasium environment, with a fixed horizon unless told otherwise."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Annotated, Any, Literal

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from pydantic import Field

from prefrl.components import ConfigError, Settings, missing, suggest
from prefrl.envs.fast.bodies import BODIES
from prefrl.envs.fast.classic import Acrobot, CartPole, MountainCar, MountainCarContinuous, Pendulum
from prefrl.envs.fast.retold import Retell, retelling
from prefrl.envs.fast.vectorised import Vectorised
from prefrl.envs.fast.wrapped import AfterEnd, Wrapped, is_mujoco, make
from prefrl.envs.partial import Partial
from prefrl.envs.spaces import Make, OwnSpaces, adapted
from prefrl.protocols import Dynamics, Environments
from prefrl.types import Floats, Segment

SECONDS = 1.5
"""Default length of a segment: long enough to be judged, short enough to be judged at a glance."""
STEPS_PER_SECOND = {"Pendulum-v1": 20.0, "CartPole-v0": 50.0, "CartPole-v1": 50.0, "Acrobot-v1": 5.0}
"""Where `render_fps` is not the rate of the simulation, or is better not asked for."""
WORLDS: dict[str, Callable[[bool], Dynamics]] = {
    "Pendulum-v1": lambda terminate: Pendulum(),
    "CartPole-v0": CartPole,
    "CartPole-v1": CartPole,
    "Acrobot-v1": Acrobot,
    "MountainCar-v0": MountainCar,
    "MountainCarContinuous-v0": MountainCarContinuous,
}
"""Environments whose equations are here, by whether episodes may end early."""


ACTION_NAMES: dict[str, tuple[str, ...]] = {
    "Pendulum-v1": ("torque",),
    "CartPole-v0": ("push left", "push right"),
    "CartPole-v1": ("push left", "push right"),
    "Acrobot-v1": ("torque -1", "no torque", "torque +1"),
    "MountainCar-v0": ("accelerate left", "coast", "accelerate right"),
    "MountainCarContinuous-v0": ("acceleration",),
    "LunarLander-v3": ("coast", "left engine", "main engine", "right engine"),
    "Reacher-v5": ("shoulder", "elbow"),
    "Swimmer-v5": ("first joint", "second joint"),
    "InvertedPendulum-v5": ("force",),
    "InvertedDoublePendulum-v5": ("force",),
    "Hopper-v5": ("thigh", "leg", "foot"),
    "HalfCheetah-v5": ("back thigh", "back shin", "back foot", "front thigh", "front shin", "front foot"),
    "Walker2d-v5": ("right thigh", "right leg", "right foot", "left thigh", "left leg", "left foot"),
}
"""What can be done, in words: discrete actions, or the dimensions of others."""


class ControlSettings(Settings):
    """Episodes of a gymnasium environment."""

    kind: Literal["control"] = "control"
    env: str = "Pendulum-v1"
    """A registered gymnasium id. Observations of several parts, choices and pictures become a row of numbers."""
    options: dict[str, Any] = Field(default_factory=dict)
    """Keyword arguments of the environment, by name."""
    horizon: int | None = Field(None, gt=0)
    """Steps of an episode; the environment's own limit when left out."""
    segment_seconds: float | None = Field(None, gt=0)
    """Length of a judged segment in simulated seconds (1.5 when neither length is given)."""
    segment_steps: int | None = Field(None, gt=0)
    """The same in control steps; give one of the two."""
    variable_horizon: bool = False
    """Let episodes end early. Their length then tells the policy how it was judged: read docs/control.md first."""
    after_end: Literal["absorb", "restart"] = "absorb"
    """Where an environment ends an episode and the horizon is fixed, it goes on in its last state, with a reward of 0,
    or from a fresh start. MuJoCo's bodies and CartPole just go on as they fell."""
    hide: tuple[Annotated[int, Field(ge=0)], ...] = ()
    """Which numbers of an observation the policy and the reward model do not see."""
    flicker: float = Field(0.0, ge=0, lt=1)
    """How probable it is that an observation is all zeros."""
    stack: int = Field(1, ge=1)
    """How many of the last observations are seen at once."""
    frame_size: int = Field(240, ge=16, le=2048)
    """Height and width of drawn frames, in pixels."""
    step_seconds: float | None = Field(None, gt=0)
    """End the process, with status 124, when a step or a reset of one environment takes longer; null waits for ever.
    The environments with steppers of our own are not watched."""
    threads: int = Field(1, ge=1)
    """On how many threads MuJoCo's bodies are stepped, those with a stepper of our own; nothing else changes by it."""
    fps: float | None = Field(None, gt=0)
    """Control steps per simulated second; only needed where the environment does not say."""

    def lasting(self) -> ControlSettings:
        return self.model_copy(update={"step_seconds": None, "threads": 1})

    def identity(self) -> ControlSettings:
        return self.lasting()

    def build(self) -> GymnasiumTask:
        """Raises `ConfigError` for an unknown id, spaces that cannot be learned and impossible lengths."""
        if self.variable_horizon and self.after_end != "absorb":
            raise ConfigError(
                f"task.after_end={self.after_end}: with task.variable_horizon=true episodes end, and nothing comes "
                "after; set one of the two"
            )
        single, probe = self._make()
        horizon, fps = self._horizon(), self._fps(probe)
        if self.options:
            self._try(probe)
        plain = adapted(single, probe)
        env = plain()
        # What is adapted, or has options, is not what the fast steppers step.
        name = self.env if plain is single and not self.options else ""
        action, size = env.action_space, math.prod(env.observation_space.shape or ())
        after: AfterEnd = "end" if self.variable_horizon else self.after_end
        environments = self._stepper(name, plain, horizon, after)
        known = name in WORLDS and after != "restart"
        retell = retelling(WORLDS[name](after == "end")) if known else None
        if self.hide or self.flicker or self.stack > 1:
            retell = None
            environments = partial(_partial, environments, size, self.hide, self.flicker, self.stack)
        # Blindness is drawn for all at once.
        parted = not self.flicker and _can_be_parted(name, after)
        for one in (probe, env):
            one.close()
        segment, notes = self._segment_steps(horizon, fps)
        return GymnasiumTask(
            name=self.env,
            horizon=horizon,
            segment_steps=segment,
            observation_size=self._seen(size),
            action_size=int(action.n) if isinstance(action, Discrete) else math.prod(action.shape or ()),
            action_bounds=_bounds(action) if isinstance(action, Box) else None,
            fps=fps or 30.0,
            frame_size=self.frame_size,
            make=environments,
            part=environments if parted else None,
            retell=retell,
            notes=notes,
            options=self.options,
            outside=OwnSpaces(probe.observation_space, probe.action_space, self.hide, self.stack),
            variable_horizon=self.variable_horizon,
        )

    def _stepper(self, name: str, single: Make, horizon: int, after: AfterEnd) -> Callable[..., Environments]:
        """What makes n environments, or those in `mine` of n, by the fastest stepper there is."""
        if name in BODIES and after != "restart":  # which the fast ones do not know within an episode
            from prefrl.envs.fast.simulated import Simulated

            options: dict[str, Any] = {"fixed_horizon": after != "end", "threads": self.threads}
            return partial(Simulated, name, single, horizon=horizon, **options)
        if self.threads > 1:
            raise ConfigError(
                f"task.threads={self.threads}: only {', '.join(BODIES)} are stepped on several threads, without "
                f"task.options and task.after_end=restart; leave task.threads=1 for this {self.env}"
            )
        if name in WORLDS and after != "restart":
            return partial(Vectorised, WORLDS[name](after == "end"), horizon=horizon)
        return partial(Wrapped, single, horizon=horizon, after=after, step_seconds=self.step_seconds)

    def _make(self) -> tuple[Make, gymnasium.Env[Any, Any]]:
        # Looked up here, not by gymnasium: an id "module:name" would make it import code that a config names.
        if self.env not in gymnasium.registry:
            raise ConfigError(
                f"task.env: unknown gymnasium environment {self.env!r}; {_nearest(self.env)} (one of your own is "
                "known once its module is named in the command: prefrl --plugin my_env.py ...)"
            )
        options: dict[str, Any] = {"disable_env_checker": True}
        try:
            probe = make(self.env, **options)
        except ModuleNotFoundError as error:
            raise ConfigError(f"task.env={self.env}: {missing(error)}") from error
        except ImportError as error:  # an old one whose simulator is gone says so like this
            raise ConfigError(f"task.env={self.env}: gymnasium cannot make it: {error}") from error
        except gymnasium.error.Error as error:
            raise ConfigError(f"task.env={self.env}: gymnasium cannot make it: {error}") from error
        options |= self._own_options(_keywords(type(probe.unwrapped))) | {"max_episode_steps": self._horizon()}
        single = partial(make, self.env, **options)
        probe.close()
        try:
            return single, single()
        except Exception as error:  # whatever an environment makes of a value that it does not know
            raise ConfigError(f"task.options={self.options}: {self.env} says: {error}") from error

    def _try(self, probe: gymnasium.Env[Any, Any]) -> None:
        """One step. Raises `ConfigError` where the options' values are at odds with what the environment computes."""
        try:
            probe.reset(seed=0)
            probe.step(probe.action_space.sample())
        except Exception as error:  # whatever an environment makes of a value that it cannot compute with
            raise ConfigError(f"task.options={self.options}: {self.env} cannot step with them: {error}") from error

    def _own_options(self, accepted: list[str]) -> dict[str, Any]:
        """The environment's own keyword arguments. Raises `ConfigError` for one that it does not have."""
        for name in self.options:
            if name == "render_mode" and self.options[name] is not None:
                raise ConfigError("task.options: leave render_mode out; clips are drawn where a person asks for them")
            if name not in accepted:
                raise ConfigError(f"task.options: {self.env} has no option {name!r}; {suggest(name, accepted)}")
        # An episode that ends early tells by its length how it was judged.
        fixed = "terminate_when_unhealthy" in accepted and not self.variable_horizon
        return ({"terminate_when_unhealthy": False} if fixed else {}) | self.options

    def _seen(self, size: int) -> int:
        """How many numbers a policy sees of observations of that size."""
        hidden = set(self.hide)
        if any(i >= size for i in hidden) or len(hidden) == size:
            raise ConfigError(
                f"task.hide={list(self.hide)}: {self.env} has observations of {size} numbers, 0 to {size - 1}, "
                "at least one of which has to be seen"
            )
        return (size - len(hidden)) * self.stack

    def _horizon(self) -> int:
        horizon = self.horizon or gymnasium.registry[self.env].max_episode_steps
        if horizon is None:
            raise ConfigError(f"task.horizon: {self.env} has no time limit of its own; give the steps of an episode")
        return horizon

    def _fps(self, env: gymnasium.Env[Any, Any]) -> float | None:
        if self.fps or self.env in STEPS_PER_SECOND:
            return self.fps or STEPS_PER_SECOND[self.env]
        if is_mujoco(env):
            return 1.0 / float(env.unwrapped.dt)  # type: ignore[attr-defined]
        rate = env.metadata.get("render_fps")
        return float(rate) if rate else None

    def _segment_steps(self, horizon: int, fps: float | None) -> tuple[int, tuple[str, ...]]:
        """How long segments are, and what to say of that."""
        if self.segment_steps and self.segment_seconds:
            raise ConfigError("task: give segment_steps or segment_seconds, not both")
        if not self.segment_steps and fps is None:
            raise ConfigError(f"task: {self.env} does not say how many steps make a second; give segment_steps or fps")
        steps = self.segment_steps or max(1, round((self.segment_seconds or SECONDS) * (fps or 0.0)))
        if steps > horizon and not (self.segment_steps or self.segment_seconds):
            steps = max(1, horizon // 2)
            return steps, (f"segments have {steps} steps: an episode of {horizon} is shorter than {SECONDS:g} seconds",)
        if steps > horizon:
            raise ConfigError(
                f"task: a segment of {steps} steps is longer than an episode of {horizon}; "
                "make segment_steps (or segment_seconds) smaller, or horizon larger"
            )
        return steps, ()


@dataclass(frozen=True, eq=False)
class GymnasiumTask:
    """A gymnasium environment as a `prefrl.protocols.ControlTask`."""

    name: str
    horizon: int
    segment_steps: int
    observation_size: int
    action_size: int
    action_bounds: tuple[Floats, Floats] | None
    fps: float
    frame_size: int
    make: Callable[[int], Environments]
    part: Callable[..., Environments] | None = None
    """As `make`, but for those in `mine`."""
    retell: Retell | None = None
    notes: tuple[str, ...] = ()
    options: Mapping[str, Any] = field(default_factory=dict)
    """The environment's keyword arguments, for drawing."""
    outside: OwnSpaces | None = None
    """What the environment itself shows and takes."""
    variable_horizon: bool = False
    """Whether episodes may end early."""

    @property
    def kind(self) -> str:
        return "control"

    @property
    def steps_per_second(self) -> float:
        return self.fps

    @property
    def action_names(self) -> Sequence[str]:
        known = ACTION_NAMES.get(self.name, ())
        return known if len(known) == self.action_size else ()

    def environments(self, count: int) -> Environments:
        return self.make(count)

    def some_environments(self, count: int, which: range) -> Environments | None:
        return None if self.part is None else self.part(count, mine=which)

    def frames(self, segment: Segment) -> np.ndarray:
        from prefrl.envs.render import frames

        return frames(self.name, segment, self.frame_size, self.options)


def _can_be_parted(name: str, after: AfterEnd) -> bool:
    """Whether some of the environments fare as they do among all, without the others.

    Those in NumPy could be made to: but all of them take about as long as half of them.
    """
    if name in WORLDS:
        return after == "restart"
    return name not in BODIES or after != "end"  # first states are drawn as episodes end, of all bodies by turns


def _partial(
    make: Callable[..., Environments],
    size: int,
    hide: tuple[int, ...],
    flicker: float,
    stack: int,
    count: int,
    **mine: range,
) -> Environments:
    return Partial(make(count, **mine), size, hide, flicker, stack)


def _keywords(env: type) -> list[str]:
    """The names that a class of environments takes, those that it hands on to its bases among them."""
    known: dict[str, None] = {}
    for base in env.__mro__:
        if "__init__" in vars(base):
            parameters = inspect.signature(vars(base)["__init__"]).parameters.values()
            known |= {p.name: None for p in parameters if p.kind in (p.POSITIONAL_OR_KEYWORD, p.KEYWORD_ONLY)}
            if not any(p.kind == p.VAR_KEYWORD for p in parameters):
                break
    return [name for name in known if name != "self"]


def _nearest(name: str) -> str:
    known = [k for k in gymnasium.registry if "/" not in k]
    stems = {k.rsplit("-v", 1)[0].lower(): k for k in known}
    # "pendulum" is nearest to Pendulum-v1, whatever the letters of "-v1" count for.
    return f"did you mean {found!r}?" if (found := stems.get(name.rsplit("-v", 1)[0].lower())) else suggest(name, known)


def _bounds(space: Box) -> tuple[Floats, Floats]:
    return space.low.astype(np.float32), space.high.astype(np.float32)
