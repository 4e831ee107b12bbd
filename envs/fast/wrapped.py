"""Any gymnasium environment, one Python object each: the path for all that has no fast stepper."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any, Literal, Protocol, TypeAlias, runtime_checkable

import gymnasium
import numpy as np

from prefrl.envs.fast.watched import EnvironmentFault, guarded
from prefrl.protocols import Transition
from prefrl.seeding import draw_seed
from prefrl.types import Bools, Floats

AfterEnd: TypeAlias = Literal["absorb", "restart", "end"]
"""What follows where an environment ends an episode before its horizon."""


class Wrapped:
    """n gymnasium environments stepped in a loop; implements `prefrl.protocols.Environments`.

    `build` makes one, its time limit included. An episode that the environment ends, also by a limit of its own, goes
    on to its horizon, or its length would tell the reward model and the policy how it was judged: where it ended, with
    a reward of 0 a step (`absorb`, as in seals), or from a fresh start, of which the learner is not told (`restart`).
    `end` lets it end.

    Raises `EnvironmentFault`, which names the environment and its step, where one raises, gives an observation of
    another shape or type than its first, or a reward that is not finite. A call that takes longer than `step_seconds`
    ends the process.

    With `mine` only those of the n are here. Each has a generator of its own, and fares as it does among all.
    """

    def __init__(
        self,
        build: Callable[[], gymnasium.Env[Any, Any]],
        count: int,
        horizon: int,
        after: AfterEnd,
        step_seconds: float | None = None,
        mine: range | None = None,
    ) -> None:
        self._all, self._mine = count, range(count) if mine is None else mine
        self._envs = [build() for _ in self._mine]
        self._seconds = step_seconds
        self._form: tuple[tuple[int, ...], np.dtype[Any]] | None = None
        self._horizon, self._after = horizon, after
        self._discrete = isinstance(self._envs[0].action_space, gymnasium.spaces.Discrete)
        self._last: Floats = np.zeros((len(self._mine), 0), np.float32)
        self._over = np.zeros(len(self._mine), bool)
        """Which episodes the environment has ended, and that go on in their last state."""
        self._elapsed = np.zeros(len(self._mine), np.int64)

    def reset(self, rng: np.random.Generator) -> Floats:
        self._over[:], self._elapsed[:] = False, 0
        seeds = [draw_seed(rng) for _ in range(self._all)]
        first = [self._reset(i, seeds[number]) for i, number in enumerate(self._mine)]
        self._last = np.stack(first).astype(np.float32)
        return self._last.copy()

    def step(self, actions: Floats) -> Transition:
        final, rewards = self._last.copy(), np.zeros(len(actions))
        terminated, truncated = np.zeros(len(actions), bool), np.zeros(len(actions), bool)
        for i in np.flatnonzero(~self._over).tolist():
            final[i], rewards[i], terminated[i], truncated[i] = self._step(i, actions[i])
            if self._after != "end" and self._elapsed[i] + 1 < self._horizon:
                # Time that is up too soon would shorten the episode as any other end of the environment's own would.
                terminated[i] |= truncated[i]
            if terminated[i] and self._after == "restart":
                final[i] = self._reset(i)  # without a seed: the generator that `reset` seeded goes on
        if not np.isfinite(rewards).all():
            i = int(np.flatnonzero(~np.isfinite(rewards))[0])
            raise EnvironmentFault(f"{self._where(i)}: its reward is {rewards[i]}, after action {actions[i]}")
        self._elapsed += 1
        if self._after == "absorb":
            self._over |= terminated
        if self._after != "end":
            terminated[:], truncated = False, self._elapsed >= self._horizon
        ended = terminated | truncated
        self._last = final.copy()  # a reset must not change what the step led to
        for i in np.flatnonzero(ended).tolist():
            self._last[i], self._over[i], self._elapsed[i] = self._reset(i), False, 0
        return Transition(self._last.copy(), rewards, terminated, truncated & ~terminated, final)

    def _reset(self, i: int, seed: int | None = None) -> Floats:
        with guarded(f"a reset of environment {self._mine[i]}", self._seconds):
            observation: Floats = self._envs[i].reset(seed=seed)[0]
        self._check_form(i, observation)
        return observation

    def _step(self, i: int, action: Floats) -> tuple[Floats, Any, bool, bool]:
        env = self._envs[i]
        chosen = self._action(env, action)
        with guarded(self._where(i), self._seconds):
            observation, reward, terminated, truncated, _ = env.step(chosen)
        self._check_form(i, observation)
        return observation, reward, terminated, truncated

    def _check_form(self, i: int, observation: Floats) -> None:
        found = np.shape(observation), np.asarray(observation).dtype
        self._form = self._form or found
        if found != self._form:
            raise EnvironmentFault(
                f"{self._where(i)}: its observation has shape {found[0]} and type {found[1]}, but the first one had "
                f"{self._form[0]} and {self._form[1]}"
            )

    def _where(self, i: int) -> str:
        return f"environment {self._mine[i]}, step {self._elapsed[i]} of its episode"

    def states(self) -> Floats | None:
        rows = [physics_state(env) for env in self._envs]
        return None if any(row is None for row in rows) else np.array(rows, np.float64)

    def legal(self) -> Bools | None:
        """gymnasium has no word for moves that are not legal."""
        return None

    def _action(self, env: gymnasium.Env[Any, Any], action: Floats) -> Any:
        if not self._discrete:
            return action.astype(env.action_space.dtype)
        return int(action.argmax()) + int(env.action_space.start)  # type: ignore[attr-defined]


def make(name: str, **options: Any) -> gymnasium.Env[Any, Any]:
    """gymnasium.make, but silent about what MuJoCo's compiler finds old-fashioned in gymnasium's own models.

    It would write to stderr and to a log file in the current folder. Raises ModuleNotFoundError without MuJoCo.
    """
    if "mujoco" not in str(gymnasium.registry[name].entry_point):
        return gymnasium.make(name, **options)
    import mujoco

    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        return gymnasium.make(name, **options)
    finally:
        mujoco.set_mju_user_warning(before)


def is_mujoco(env: gymnasium.Env[Any, Any]) -> bool:
    """Whether this is one of gymnasium's MuJoCo environments, or a subclass; never imports MuJoCo to find out."""
    if "gymnasium.envs.mujoco.mujoco_env" not in sys.modules:
        return False
    from gymnasium.envs.mujoco import MujocoEnv

    return isinstance(env.unwrapped, MujocoEnv)


@runtime_checkable
class Restorable(Protocol):
    """An environment that can be brought into a state it was in, to be drawn there."""

    def get_state(self) -> Floats:
        """(S,) numbers that say all that `render` shows."""

    def set_state(self, state: Floats, /) -> None:
        """Take such a state."""


def physics_state(env: gymnasium.Env[Any, Any]) -> Floats | None:
    """(S,) positions, velocities and activations of a MuJoCo environment, or the own state of one that gives it."""
    if not is_mujoco(env):
        own = env.unwrapped
        return np.asarray(own.get_state(), np.float64).ravel() if isinstance(own, Restorable) else None
    import mujoco

    unwrapped: Any = env.unwrapped
    state = np.empty(mujoco.mj_stateSize(unwrapped.model, mujoco.mjtState.mjSTATE_PHYSICS))
    mujoco.mj_getState(unwrapped.model, unwrapped.data, state, mujoco.mjtState.mjSTATE_PHYSICS)
    return state
