"""Any gymnasium environment, one Python object each: the path for all that has no fast stepper."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np

from prefrl.protocols import Transition
from prefrl.seeding import draw_seed
from prefrl.types import Bools, Floats


class Wrapped:
    """n gymnasium environments stepped in a loop; implements `prefrl.protocols.Environments`.

    `build` makes one, its time limit included. With `fixed_horizon` a termination raises a ValueError: an episode
    that ends early tells the reward model and the policy how it was judged (PITFALLS, control 1).
    """

    def __init__(self, build: Callable[[], gymnasium.Env[Any, Any]], count: int, fixed_horizon: bool) -> None:
        self._envs = [build() for _ in range(count)]
        self._fixed_horizon = fixed_horizon
        self._discrete = isinstance(self._envs[0].action_space, gymnasium.spaces.Discrete)

    def reset(self, rng: np.random.Generator) -> Floats:
        return np.stack([env.reset(seed=draw_seed(rng))[0] for env in self._envs]).astype(np.float32)

    def step(self, actions: Floats) -> Transition:
        chosen = [self._action(env, a) for env, a in zip(self._envs, actions, strict=True)]
        steps = [env.step(a) for env, a in zip(self._envs, chosen, strict=True)]
        final = np.stack([s[0] for s in steps]).astype(np.float32)
        terminated = np.array([bool(s[2]) for s in steps])
        truncated = np.array([bool(s[3]) for s in steps]) & ~terminated
        if self._fixed_horizon and terminated.any():
            raise ValueError(_early_end(self._envs[0]))
        observations = final.copy()  # a reset must not change what the step led to
        for i in np.flatnonzero(terminated | truncated):
            observations[i] = self._envs[i].reset()[0]  # without a seed: the generator that `reset` seeded goes on
        return Transition(observations, np.array([float(s[1]) for s in steps]), terminated, truncated, final)

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


def physics_state(env: gymnasium.Env[Any, Any]) -> Floats | None:
    """(S,) positions, velocities and activations of a MuJoCo environment; None for others."""
    if not is_mujoco(env):
        return None
    import mujoco

    unwrapped: Any = env.unwrapped
    state = np.empty(mujoco.mj_stateSize(unwrapped.model, mujoco.mjtState.mjSTATE_PHYSICS))
    mujoco.mj_getState(unwrapped.model, unwrapped.data, state, mujoco.mjtState.mjSTATE_PHYSICS)
    return state


def _early_end(env: gymnasium.Env[Any, Any]) -> str:
    name = env.spec.id if env.spec else str(env)
    return (
        f"{name} ended an episode before its horizon. Preferences fix a reward only up to a shift, so episodes of "
        "unequal length leak or invert what was learned; choose an environment without terminations, or set "
        "task.variable_horizon=true if you accept that"
    )
