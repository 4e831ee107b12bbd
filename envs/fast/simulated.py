"""gymnasium's MuJoCo environments (v5): `mujoco.batch` steps the simulators, on as many threads as wanted; the rest is
batched NumPy.

Equal to gymnasium's environments to the bit, whatever the number of threads. Stepping many at once with
`mujoco.rollout` would not be: called for one control step at a time it loses the solver's warm start.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import gymnasium
import mujoco
import numpy as np
from mujoco.batch import Batch

from prefrl.envs.fast.bodies import BODIES, Snapshot
from prefrl.protocols import Transition
from prefrl.types import Bools, Floats


class Bodies:
    """n simulators of a body of `prefrl.envs.fast.bodies`, each started and advanced when it is asked to.

    `env` is the gymnasium environment whose model and first state are used. The threads, that of the caller among
    them, last as long as this does.
    """

    def __init__(self, name: str, env: Any, count: int, threads: int = 1) -> None:
        self._body = BODIES[name]
        self._frames, self._dt = env.frame_skip, env.dt
        self._first = env.init_qpos.copy(), env.init_qvel.copy()
        contacts = self._body.contact_forces
        self._batch = Batch(env.model, count, min(threads, count), persistent=contacts)
        self._maker = os.getpid()
        # A row is a time, positions, velocities and what else a step hangs on, the solver's warm start among it.
        self._fresh = self._batch.state[0].copy()
        places, end = env.model.nq, env.model.nq + env.model.nv
        self.states: Floats = self._batch.state[:, 1 : 1 + end]
        """(n, nq + nv), written in place."""
        self._controls = self._batch.bind("ctrl")
        self._sources = self._body.derived(self._batch)
        if contacts:
            self._data = mujoco.MjData(env.model)
            self._forces = np.zeros((count, self._data.cfrc_ext.size))
            self._sources = [*self._sources, self._forces]
        width = sum(source.shape[1] for source in self._sources)
        self.now = Snapshot(self.states[:, :places], self.states[:, places:], np.zeros((count, width)))

    def start(self, i: int, rng: np.random.Generator) -> None:
        """Begin an episode of one of them."""
        # Also clears the solver's warm start: what an episode does must not hang on the one before it.
        self._batch.state[i] = self._fresh
        self.now.positions[i], self.now.velocities[i] = self._body.start(*self._first, rng)
        self._batch.forward([i])  # what is derived from positions and velocities must follow them
        if self._body.contact_forces:
            self._forces[i] = 0.0
        self._read()

    def skip(self, rng: np.random.Generator) -> None:
        """Draw what the start of an episode draws, for one that is stepped elsewhere."""
        self._body.start(*self._first, rng)

    def advance(self, actions: Floats, which: Sequence[int]) -> tuple[Floats, Bools]:
        """One step of those in `which`: (n,) rewards and health. Those of the others mean nothing."""
        if self._batch.nthread > 1 and os.getpid() != self._maker:
            raise RuntimeError(
                "these environments are stepped by threads, which a forked process does not have: make them in the "
                "process that steps them, or with threads=1"
            )
        body, now = self._body, self.now
        before = body.place(now).copy()  # a copy: the snapshot is written in place
        self._controls[:] = actions
        self._batch.step(None if len(which) == len(actions) else which, nstep=self._frames)
        if body.contact_forces:
            self._add_forces(which)
        self._read()
        healthy = body.healthy(now)
        return body.reward(now, actions, (body.place(now) - before) / self._dt, healthy), healthy

    def observe(self) -> Floats:
        """(n, O) float64, a new array."""
        return self._body.observe(self.now)

    def _add_forces(self, which: Sequence[int]) -> None:
        for i in which:
            # A copy of all that a simulator holds: a row has no contacts.
            self._batch.get_data(i, self._data)
            mujoco.mj_rnePostConstraint(self._batch.model, self._data)
            self._forces[i] = self._data.cfrc_ext.reshape(-1)

    def _read(self) -> None:
        if self._sources:
            np.concatenate(self._sources, 1, out=self.now.derived)


class Simulated:
    """n bodies of `prefrl.envs.fast.bodies`; implements `prefrl.protocols.Environments`.

    `make` builds the gymnasium environment whose model and first state are used. With `fixed_horizon` an unhealthy
    body goes on, without its reward for being healthy: what gymnasium does with `terminate_when_unhealthy=False`.
    InvertedPendulum and InvertedDoublePendulum have no such option, and go on all the same: in the simulator, with
    the reward that gymnasium computes for each step. That is 1 while the single pole is up and 0 when it has fallen;
    the double one's bonus of 10 is for steps that end with its tip up, its penalties for all.

    With `mine` only those of the n are here, and start as they do among all. That needs a fixed horizon: first states
    are drawn one after another, and what others have drawn is only known where all episodes end at once.

    With `threads` more than 1 so many step them, to the same bits, in the process that made them.
    """

    def __init__(
        self,
        name: str,
        make: Callable[[], gymnasium.Env[Any, Any]],
        count: int,
        horizon: int,
        fixed_horizon: bool,
        mine: range | None = None,
        threads: int = 1,
    ) -> None:
        assert mine is None or fixed_horizon
        self._count, self._mine = count, range(count) if mine is None else mine
        self._bodies = Bodies(name, make().unwrapped, len(self._mine), threads)
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
