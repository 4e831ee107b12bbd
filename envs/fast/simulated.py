"""gymnasium's MuJoCo environments (v5): one preallocated MjData each, the rest in batched NumPy.

Equal to gymnasium's environments to the bit. Stepping many at once with `mujoco.rollout` would not be: called for one
control step at a time it loses the solver's warm start.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import mujoco
import numpy as np

from prefrl.envs.fast.bodies import BODIES, Snapshot
from prefrl.protocols import Transition
from prefrl.types import Bools, Floats


class Simulated:
    """n bodies of `prefrl.envs.fast.bodies`, stepped one after another; implements `prefrl.protocols.Environments`.

    `make` builds the gymnasium environment whose model and first state are used. With `fixed_horizon` an unhealthy
    body goes on, without its reward for being healthy: what gymnasium does with `terminate_when_unhealthy=False`.
    InvertedPendulum and InvertedDoublePendulum have no such option, and go on all the same: in the simulator, with
    the reward that gymnasium computes for each step. That is 1 while the single pole is up and 0 when it has fallen;
    the double one's bonus of 10 is for steps that end with its tip up, its penalties for all.
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
        sources = [[view.reshape(-1) for view in self._body.derived(data)] for data in self._data]
        places, width = env.model.nq, sum(map(len, sources[0])) if count else 0
        self._states = np.zeros((count, places + env.model.nv))
        self._now = Snapshot(self._states[:, :places], self._states[:, places:], np.zeros((count, width)))
        self._copies = [list(_pairs(self._now, i, [*self._memory[i], *sources[i]])) for i in range(count)]
        self._elapsed = np.zeros(count, np.int64)
        self._horizon = horizon
        self._terminate = not fixed_horizon
        self._rng = np.random.default_rng(0)

    def reset(self, rng: np.random.Generator) -> Floats:
        self._rng = rng
        for i in range(len(self._data)):
            self._start(i)
        return self._body.observe(self._now)

    def step(self, actions: Floats) -> Transition:
        body, now = self._body, self._now
        before = body.place(now).copy()  # a copy: the snapshot is written in place
        for i, data in enumerate(self._data):
            self._controls[i][:] = actions[i]
            mujoco.mj_step(self._model, data, nstep=self._frames)
            if body.contact_forces:
                mujoco.mj_rnePostConstraint(self._model, data)
            self._read(i)
        healthy = body.healthy(now)
        rewards = body.reward(now, actions, (body.place(now) - before) / self._dt, healthy)
        self._elapsed += 1
        terminated = ~healthy & self._terminate
        truncated = (self._elapsed >= self._horizon) & ~terminated
        final = observations = body.observe(now)
        ended = np.flatnonzero(terminated | truncated)
        for i in ended.tolist():
            self._start(i)
        if len(ended):
            observations = body.observe(now)
        return Transition(observations, rewards, terminated, truncated, final)

    def states(self) -> Floats:
        return self._states

    def legal(self) -> Bools | None:
        return None

    def _start(self, i: int) -> None:
        data, (qpos, qvel) = self._data[i], self._memory[i]
        # Also clears the solver's warm start: what an episode does must not hang on the one before it.
        mujoco.mj_resetData(self._model, data)
        qpos[:], qvel[:] = self._body.start(*self._first, self._rng)
        mujoco.mj_forward(self._model, data)  # what is derived from positions and velocities must follow them
        self._elapsed[i] = 0
        self._read(i)

    def _read(self, i: int) -> None:
        for target, source in self._copies[i]:
            target[:] = source


def _pairs(now: Snapshot, i: int, sources: list[Floats]) -> Iterator[tuple[Floats, Floats]]:
    """Where each part of simulator i's memory goes in the snapshot: positions, velocities, then what is derived."""
    yield now.positions[i], sources[0]
    yield now.velocities[i], sources[1]
    begin = 0
    for source in sources[2:]:
        yield now.derived[i, begin : begin + len(source)], source
        begin += len(source)
