"""gymnasium's MuJoCo environments (v5): one preallocated MjData each, the rest in batched NumPy.

Equal to gymnasium's environments to the bit. Stepping many at once with `mujoco.rollout` would not be: called for one
control step at a time it loses the solver's warm start.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

import gymnasium
import mujoco
import numpy as np

from prefrl.envs.fast.bodies import BODIES, Snapshot
from prefrl.protocols import Transition
from prefrl.types import Bools, Floats


class Bodies:
    """n simulators of a body of `prefrl.envs.fast.bodies`, each started and advanced when it is asked to.

    `env` is the gymnasium environment whose model and first state are used.
    """

    def __init__(self, name: str, env: Any, count: int) -> None:
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
        self.states: Floats = np.zeros((count, places + env.model.nv))
        """(n, nq + nv), written in place."""
        self.now = Snapshot(self.states[:, :places], self.states[:, places:], np.zeros((count, width)))
        self._copies = [list(_pairs(self.now, i, [*self._memory[i], *sources[i]])) for i in range(count)]

    def start(self, i: int, rng: np.random.Generator) -> None:
        """Begin an episode of one of them."""
        data, (qpos, qvel) = self._data[i], self._memory[i]
        # Also clears the solver's warm start: what an episode does must not hang on the one before it.
        mujoco.mj_resetData(self._model, data)
        qpos[:], qvel[:] = self._body.start(*self._first, rng)
        mujoco.mj_forward(self._model, data)  # what is derived from positions and velocities must follow them
        self._read(i)

    def skip(self, rng: np.random.Generator) -> None:
        """Draw what the start of an episode draws, for one that is stepped elsewhere."""
        self._body.start(*self._first, rng)

    def advance(self, actions: Floats, which: Iterable[int]) -> tuple[Floats, Bools]:
        """One step of those in `which`: (n,) rewards and health. Those of the others mean nothing."""
        body, now = self._body, self.now
        before = body.place(now).copy()  # a copy: the snapshot is written in place
        for i in which:
            data = self._data[i]
            self._controls[i][:] = actions[i]
            mujoco.mj_step(self._model, data, nstep=self._frames)
            if body.contact_forces:
                mujoco.mj_rnePostConstraint(self._model, data)
            self._read(i)
        healthy = body.healthy(now)
        return body.reward(now, actions, (body.place(now) - before) / self._dt, healthy), healthy

    def observe(self) -> Floats:
        """(n, O) float64, a new array."""
        return self._body.observe(self.now)

    def _read(self, i: int) -> None:
        for target, source in self._copies[i]:
            target[:] = source


class Simulated:
    """n bodies of `prefrl.envs.fast.bodies`, stepped one after another; implements `prefrl.protocols.Environments`.

    `make` builds the gymnasium environment whose model and first state are used. With `fixed_horizon` an unhealthy
    body goes on, without its reward for being healthy: what gymnasium does with `terminate_when_unhealthy=False`.
    InvertedPendulum and InvertedDoublePendulum have no such option, and go on all the same: in the simulator, with
    the reward that gymnasium computes for each step. That is 1 while the single pole is up and 0 when it has fallen;
    the double one's bonus of 10 is for steps that end with its tip up, its penalties for all.

    With `mine` only those of the n are here, and start as they do among all. That needs a fixed horizon: first states
    are drawn one after another, and what others have drawn is only known where all episodes end at once.
    """

    def __init__(
        self,
        name: str,
        make: Callable[[], gymnasium.Env[Any, Any]],
        count: int,
        horizon: int,
        fixed_horizon: bool,
        mine: range | None = None,
    ) -> None:
        assert mine is None or fixed_horizon
        self._count, self._mine = count, range(count) if mine is None else mine
        self._bodies = Bodies(name, make().unwrapped, len(self._mine))
        self._elapsed = np.zeros(len(self._mine), np.int64)
        self._horizon = horizon
        self._terminate = not fixed_horizon
        self._rng = np.random.default_rng(0)

    def reset(self, rng: np.random.Generator) -> Floats:
        self._rng = rng
        self._start(range(self._count))
        return self._observe()

    def step(self, actions: Floats) -> Transition:
        rewards, healthy = self._bodies.advance(actions, range(len(self._elapsed)))
        self._elapsed += 1
        terminated = ~healthy & self._terminate
        truncated = (self._elapsed >= self._horizon) & ~terminated
        final = observations = self._observe()
        if (terminated | truncated).any():
            # Those that others step end when these do: there are others with a fixed horizon alone.
            self._start(np.flatnonzero(terminated | truncated).tolist() if self._terminate else range(self._count))
            observations = self._observe()
        return Transition(observations, rewards, terminated, truncated, final)

    def states(self) -> Floats:
        return self._bodies.states

    def legal(self) -> Bools | None:
        return None

    def _start(self, which: Iterable[int]) -> None:
        """Begin episodes, of all n."""
        for i in which:
            if i in self._mine:
                self._bodies.start(i - self._mine.start, self._rng)
                self._elapsed[i - self._mine.start] = 0
            else:
                self._bodies.skip(self._rng)

    def _observe(self) -> Floats:
        return self._bodies.observe().astype(np.float32)


def _pairs(now: Snapshot, i: int, sources: list[Floats]) -> Iterator[tuple[Floats, Floats]]:
    """Where each part of simulator i's memory goes in the snapshot: positions, velocities, then what is derived."""
    yield now.positions[i], sources[0]
    yield now.velocities[i], sources[1]
    begin = 0
    for source in sources[2:]:
        yield now.derived[i, begin : begin + len(source)], source
        begin += len(source)
