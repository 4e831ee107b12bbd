"""Control tasks: episodes of any gymnasium environment, with a fixed horizon unless told otherwise."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Discrete
from gymnasium.wrappers import FlattenObservation
from pydantic import Field

from prefrl.components import ConfigError, Settings, missing, suggest
from prefrl.envs.fast.bodies import BODIES
from prefrl.envs.fast.classic import Acrobot, CartPole, MountainCar, MountainCarContinuous, Pendulum
from prefrl.envs.fast.vectorised import Vectorised
from prefrl.envs.fast.wrapped import Wrapped, is_mujoco, make
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


class ControlSettings(Settings):
    """Episodes of a gymnasium environment."""

    kind: Literal["control"] = "control"
    env: str = "Pendulum-v1"
    """A registered gymnasium id. Pictures as observations, height by width by channels, are flattened."""
    horizon: int | None = Field(None, gt=0)
    """Steps of an episode; the environment's own limit when left out."""
    segment_seconds: float | None = Field(None, gt=0)
    """Length of a judged segment in simulated seconds (1.5 when neither length is given)."""
    segment_steps: int | None = Field(None, gt=0)
    """The same in control steps; give one of the two."""
    variable_horizon: bool = False
    """Let episodes end early. Their length then tells the policy how it was judged: read docs/control.md first."""
    frame_size: int = Field(240, ge=16, le=2048)
    """Height and width of drawn frames, in pixels."""
    fps: float | None = Field(None, gt=0)
    """Control steps per simulated second; only needed where the environment does not say."""

    def build(self) -> GymnasiumTask:
        """Raises `ConfigError` for an unknown id, spaces that cannot be learned and impossible lengths."""
        single, probe = self._make()
        horizon, fps = self._horizon(), self._fps(probe)
        observation, action = _observation_box(probe), _action_space(probe)
        if len(observation.shape) > 1:
            single = partial(_flat, single)
        probe.close()
        return GymnasiumTask(
            name=self.env,
            horizon=horizon,
            segment_steps=self._segment_steps(horizon, fps),
            observation_size=math.prod(observation.shape),
            action_size=int(action.n) if isinstance(action, Discrete) else action.shape[0],
            action_bounds=None if isinstance(action, Discrete) else _bounds(action),
            fps=fps or 30.0,
            frame_size=self.frame_size,
            make=partial(_environments, self.env, single, horizon, not self.variable_horizon),
        )

    def _make(self) -> tuple[Callable[[], gymnasium.Env[Any, Any]], gymnasium.Env[Any, Any]]:
        # Looked up here, not by gymnasium: an id "module:name" would make it import code that a config names.
        if self.env not in gymnasium.registry:
            raise ConfigError(f"task.env: unknown gymnasium environment {self.env!r}; {_nearest(self.env)}")
        options: dict[str, Any] = {"max_episode_steps": self._horizon(), "disable_env_checker": True}
        try:
            probe = make(self.env, **options)
            accepted = inspect.signature(type(probe.unwrapped).__init__).parameters
            if "terminate_when_unhealthy" in accepted and not self.variable_horizon:
                # An episode that ends early tells by its length how it was judged.
                options["terminate_when_unhealthy"] = False
                probe = make(self.env, **options)
        except ModuleNotFoundError as error:
            raise ConfigError(f"task.env={self.env}: {missing(error)}") from error
        except gymnasium.error.Error as error:
            raise ConfigError(f"task.env={self.env}: gymnasium cannot make it: {error}") from error
        return partial(make, self.env, **options), probe

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

    def _segment_steps(self, horizon: int, fps: float | None) -> int:
        if self.segment_steps and self.segment_seconds:
            raise ConfigError("task: give segment_steps or segment_seconds, not both")
        if not self.segment_steps and fps is None:
            raise ConfigError(f"task: {self.env} does not say how many steps make a second; give segment_steps or fps")
        steps = self.segment_steps or max(1, round((self.segment_seconds or SECONDS) * (fps or 0.0)))
        if steps > horizon:
            raise ConfigError(
                f"task: a segment of {steps} steps is longer than an episode of {horizon}; "
                "make segment_steps (or segment_seconds) smaller, or horizon larger"
            )
        return steps


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

    @property
    def kind(self) -> str:
        return "control"

    def environments(self, count: int) -> Environments:
        return self.make(count)

    def frames(self, segment: Segment) -> np.ndarray:
        from prefrl.envs.render import frames

        return frames(self.name, segment, self.frame_size)


def _environments(
    name: str, single: Callable[[], gymnasium.Env[Any, Any]], horizon: int, fixed_horizon: bool, count: int
) -> Environments:
    """The fastest stepper there is for an environment."""
    if name in WORLDS:
        return Vectorised(WORLDS[name](not fixed_horizon), count, horizon)
    if name in BODIES:
        from prefrl.envs.fast.simulated import Simulated

        return Simulated(name, single, count, horizon, fixed_horizon)
    return Wrapped(single, count, fixed_horizon)


def _nearest(name: str) -> str:
    known = [k for k in gymnasium.registry if "/" not in k]
    stems = {k.rsplit("-v", 1)[0].lower(): k for k in known}
    # "pendulum" is nearest to Pendulum-v1, whatever the letters of "-v1" count for.
    return f"did you mean {found!r}?" if (found := stems.get(name.rsplit("-v", 1)[0].lower())) else suggest(name, known)


def _observation_box(env: gymnasium.Env[Any, Any]) -> Box:
    """Numbers in a row, or a picture (height, width, channels), which is taken apart row by row."""
    space = env.observation_space
    row = isinstance(space, Box) and len(space.shape) == 1 and np.issubdtype(space.dtype, np.floating)
    picture = isinstance(space, Box) and len(space.shape) == 3 and space.dtype in (np.uint8, np.float32, np.float64)
    if not (row or picture):
        raise ConfigError(
            "task.env: observations must be a flat Box of floats, or a Box of pictures (height, width, channels), got "
            f"{space}; wrap and register it so"
        )
    return space  # type: ignore[return-value]


def _flat(make: Callable[[], gymnasium.Env[Any, Any]]) -> gymnasium.Env[Any, Any]:
    return FlattenObservation(make())


def _action_space(env: gymnasium.Env[Any, Any]) -> Box | Discrete:
    space = env.action_space
    flat = isinstance(space, Box) and len(space.shape) == 1 and np.issubdtype(space.dtype, np.floating)
    if not (flat or isinstance(space, Discrete)):
        raise ConfigError(f"task.env: actions must be a flat Box of floats or Discrete, got {space}")
    return space  # type: ignore[return-value]


def _bounds(space: Box) -> tuple[Floats, Floats]:
    return space.low.astype(np.float32), space.high.astype(np.float32)
