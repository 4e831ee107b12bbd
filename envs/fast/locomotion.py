"""gymnasium's HalfCheetah, Hopper and Walker2d (v5): one preallocated MjData each, the rest in batched NumPy.

Equal to gymnasium's environments to the bit. Stepping many at once with `mujoco.rollout` would not be: called for one
control step at a time it loses the solver's warm start.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium
import mujoco
import numpy as np

from prefrl.protocols import Transition
from prefrl.types import Bools, Floats


@dataclass(frozen=True)
class Body:
    """What tells the three apart: gymnasium's default rewards, health and first states."""

    control_cost: float
    reset_noise: float
    normal_velocities: bool = False
    """First velocities are drawn from a normal distribution, else uniformly."""
    velocity_clip: float = np.inf
    height: tuple[float, float] | None = None
    """Healthy heights of the torso; None where nothing is unhealthy."""
    angle: tuple[float, float] = (-np.inf, np.inf)
    reach: float = np.inf
    """Healthy size of all other positions and velocities."""


BODIES = {
    "HalfCheetah-v5": Body(control_cost=0.1, reset_noise=0.1, normal_velocities=True),
    "Hopper-v5": Body(1e-3, 5e-3, velocity_clip=10.0, height=(0.7, np.inf), angle=(-0.2, 0.2), reach=100.0),
    "Walker2d-v5": Body(1e-3, 5e-3, velocity_clip=10.0, height=(0.8, 2.0), angle=(-1.0, 1.0)),
}


class Locomotion:
    """n bodies stepped one after another; implements `prefrl.protocols.Environments`.

    `make` builds the gymnasium environment whose model and first state are used. With `fixed_horizon` an unhealthy
    body goes on, without its reward for being healthy.
    """

    def __init__(
        self, name: str, make: Callable[[], gymnasium.Env[Any, Any]], count: int, horizon: int, fixed_horizon: bool
    ) -> None:
        env: Any = make().unwrapped
        self._body = BODIES[name]
        self._model = env.model
        self._frames = env.frame_skip
        self._dt = env.dt
        self._first = env.init_qpos.copy(), env.init_qvel.copy()
        self._data = [mujoco.MjData(env.model) for _ in range(count)]
        # Views into each simulator's own memory, made once.
        self._controls = [data.ctrl for data in self._data]
        self._memory = [(data.qpos, data.qvel) for data in self._data]
        self._states = np.zeros((count, env.model.nq + env.model.nv))
        self._elapsed = np.zeros(count, np.int64)
        self._horizon = horizon
        self._terminate = not fixed_horizon
        self._rng = np.random.default_rng(0)

    def reset(self, rng: np.random.Generator) -> Floats:
        self._rng = rng
        for i in range(len(self._data)):
            self._start(i)
        return self._observe()

    def step(self, actions: Floats) -> Transition:
        before = self._states[:, 0].copy()  # a copy: _states is written in place
        for i, data in enumerate(self._data):
            self._controls[i][:] = actions[i]
            mujoco.mj_step(self._model, data, nstep=self._frames)
            self._read(i)
        healthy = self._healthy()
        rewards = self._rewards(before, actions, healthy)
        self._elapsed += 1
        terminated = ~healthy & self._terminate
        truncated = (self._elapsed >= self._horizon) & ~terminated
        final = observations = self._observe()
        ended = np.flatnonzero(terminated | truncated)
        for i in ended.tolist():
            self._start(i)
        if len(ended):
            observations = self._observe()
        return Transition(observations, rewards, terminated, truncated, final)

    def states(self) -> Floats:
        return self._states

    def legal(self) -> Bools | None:
        return None

    def _start(self, i: int) -> None:
        data, (qpos, qvel), noise = self._data[i], self._memory[i], self._body.reset_noise
        # Also clears the solver's warm start: what an episode does must not hang on the one before it.
        mujoco.mj_resetData(self._model, data)
        qpos[:] = self._first[0] + self._rng.uniform(-noise, noise, len(qpos))
        normal = self._body.normal_velocities
        drawn = noise * self._rng.standard_normal(len(qvel)) if normal else self._rng.uniform(-noise, noise, len(qvel))
        qvel[:] = self._first[1] + drawn
        mujoco.mj_forward(self._model, data)  # what is derived from positions and velocities must follow them
        self._elapsed[i] = 0
        self._read(i)

    def _read(self, i: int) -> None:
        qpos, qvel = self._memory[i]
        self._states[i, : len(qpos)] = qpos
        self._states[i, len(qpos) :] = qvel

    def _observe(self) -> Floats:
        """Positions but the first, and clipped velocities."""
        # A copy, since clipping is in place, and only what is observed is clipped.
        observations = self._states[:, 1:].copy()
        clip = self._body.velocity_clip
        velocities = observations[:, self._model.nq - 1 :]
        np.clip(velocities, -clip, clip, out=velocities)
        found: Floats = observations.astype(np.float32)
        return found

    def _healthy(self) -> Bools:
        body, states = self._body, self._states
        if body.height is None:
            return np.ones(len(states), bool)
        # Column 0 is how far a body has come, which no bound is on.
        height = states[:, 1]
        angle = states[:, 2]
        rest = np.abs(states[:, 2:])  # (n, positions and velocities - 2), the angle among them
        upright = (body.angle[0] < angle) & (angle < body.angle[1])
        within = (body.height[0] < height) & (height < body.height[1])
        healthy: Bools = upright & within & (rest < body.reach).all(1)
        return healthy

    def _rewards(self, before: Floats, actions: Floats, healthy: Bools) -> Floats:
        """Forward speed, minus the cost of control, plus 1 for health where there is such a thing."""
        speed = (self._states[:, 0] - before) / self._dt
        rewards: Floats = speed if self._body.height is None else speed + healthy * 1.0
        # The cost is in the actions' float32, as in gymnasium.
        costs: Floats = self._body.control_cost * np.square(actions).sum(1)
        return rewards - costs
