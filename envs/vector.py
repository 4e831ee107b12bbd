"""The fast environments as gymnasium's vector environments: `gymnasium.make_vec("prefrl/HalfCheetah-v5", num_envs=16)`.

Importing this module registers them, which is gymnasium's own way (`gymnasium.register_envs(prefrl.envs.vector)`);
nothing else of prefrl is needed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, Protocol

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from prefrl.components import suggest
from prefrl.envs.fast.bodies import BODIES
from prefrl.envs.fast.classic import Acrobot, CartPole, MountainCar, MountainCarContinuous, Pendulum
from prefrl.envs.fast.wrapped import make
from prefrl.protocols import Dynamics
from prefrl.types import Bools, Floats

CLASSIC: dict[str, Dynamics] = {
    "Pendulum-v1": Pendulum(),
    "CartPole-v0": CartPole(terminate=True),
    "CartPole-v1": CartPole(terminate=True),
    "Acrobot-v1": Acrobot(terminate=True),
    "MountainCar-v0": MountainCar(terminate=True),
    "MountainCarContinuous-v0": MountainCarContinuous(terminate=True),
}
NAMES = (*CLASSIC, *BODIES)
"""gymnasium's ids that have a fast stepper; here each begins with `prefrl/`."""


class _Stepper(Protocol):
    """n simulators, each started and advanced when it is asked to."""

    def start(self, i: int, rng: np.random.Generator) -> None: ...

    def advance(self, actions: np.ndarray, which: Sequence[int]) -> tuple[Floats, Bools]:
        """One step of those in `which`: (n,) rewards, and whether each goes on."""

    def observe(self) -> Floats: ...


class _Worlds:
    """n states of a world that is a value."""

    def __init__(self, dynamics: Dynamics, count: int, choices: int | None) -> None:
        self._dynamics, self._choices = dynamics, choices
        rng = np.random.default_rng(0)
        self._states, self._rng = dynamics.start(count, rng), rng

    def start(self, i: int, rng: np.random.Generator) -> None:
        self._states[i] = self._dynamics.start(1, rng)[0]

    def advance(self, actions: np.ndarray, which: Sequence[int]) -> tuple[Floats, Bools]:
        if self._choices is not None:
            actions = np.eye(self._choices, dtype=np.float32)[actions]
        states, rewards, terminated = self._dynamics.advance(self._states, actions, self._rng)
        self._states[which] = states[which]
        return rewards, ~terminated

    def observe(self) -> Floats:
        return self._dynamics.observe(self._states)


class FastVectorEnv(VectorEnv[Floats, np.ndarray, np.ndarray]):
    """n environments of one id, stepped as gymnasium's `SyncVectorEnv` steps them, only faster.

    Observations, terminations, truncations and first states are `SyncVectorEnv`'s to the bit for the same seeds,
    rewards too; Pendulum's rewards and Acrobot's first observations are to rounding. Episodes end where gymnasium ends
    them: a fixed horizon is the control task's. `terminate_when_unhealthy=False` lets Ant, Hopper and Walker2d go on.
    MuJoCo's are stepped on `threads`, which change nothing else.

    Infos hold `final_obs` (with `autoreset_mode="SameStep"`), as gymnasium's do, and nothing else: the parts of a
    reward and a body's place are not computed. Nothing is drawn. Raises `ValueError` for an option that it does not
    know, and for actions of another shape, or that are not finite or not among the choices.
    """

    def __init__(
        self,
        name: str,
        num_envs: int = 1,
        max_episode_steps: int | None = None,
        autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP,
        terminate_when_unhealthy: bool | None = None,
        threads: int = 1,
        **others: Any,
    ) -> None:
        others = {key: value for key, value in others.items() if (key, value) != ("render_mode", None)}
        if threads != 1 and name not in BODIES:
            others["threads"] = threads
        if terminate_when_unhealthy is not None and name not in ("Ant-v5", "Hopper-v5", "Walker2d-v5"):
            others["terminate_when_unhealthy"] = terminate_when_unhealthy
        _check_options(name, others, num_envs, threads)
        env: Any = make(name, disable_env_checker=True).unwrapped
        self.num_envs, self._mode = num_envs, AutoresetMode(autoreset_mode)
        self.metadata = {**env.metadata, "autoreset_mode": self._mode}
        self.single_observation_space, self.single_action_space = env.observation_space, env.action_space
        self.observation_space = batch_space(env.observation_space, num_envs)
        self.action_space = batch_space(env.action_space, num_envs)
        self._stepper = _stepper(name, env, num_envs, threads)
        self._limit = _limit(name, max_episode_steps)
        # Not by health: these go on whatever falls.
        self._ends = terminate_when_unhealthy is not False
        self._generators = [np.random.default_rng() for _ in range(num_envs)]
        self._elapsed = np.zeros(num_envs, np.int64)
        self._over = np.zeros(num_envs, bool)
        """Whose episode has ended, and is not begun again yet."""
        self._begun = False

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Floats, dict[str, Any]]:
        """Begin episodes: of all, or of those in `options["reset_mask"]`; environment i has the seed `seed` + i."""
        chosen = _reset_mask(options, self.num_envs)
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed
        if seeds is not None and len(seeds) != self.num_envs:
            raise ValueError(f"expected {self.num_envs} seeds, one for each environment, got {len(seeds)}")
        for i in np.flatnonzero(chosen).tolist():
            if seeds is not None and (own := seeds[i]) is not None:
                self._generators[i] = gymnasium.utils.seeding.np_random(own)[0]
            self._start(i)
        self._begun = True
        return self._stepper.observe(), {}

    def step(self, actions: np.ndarray) -> tuple[Floats, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One step of all; what has ended begins again as `autoreset_mode` says."""
        chosen = self._checked(actions)
        waiting = self._over.copy()
        if self._mode is AutoresetMode.DISABLED and waiting.any():
            raise ValueError(
                f"the episodes of environments {np.flatnonzero(waiting).tolist()} have ended: begin new ones with "
                'reset(options={"reset_mask": ...})'
            )
        rewards, goes_on = self._stepper.advance(chosen, np.flatnonzero(~waiting).tolist())
        self._elapsed += 1
        rewards = np.where(waiting, 0.0, rewards)
        terminated = ~goes_on & ~waiting & self._ends
        truncated = np.zeros(self.num_envs, bool) if self._limit is None else (self._elapsed >= self._limit) & ~waiting
        for i in np.flatnonzero(waiting).tolist():
            self._start(i)
        self._over = terminated | truncated
        if self._mode is AutoresetMode.SAME_STEP and self._over.any():
            return self._same_step(rewards, terminated, truncated)
        return self._stepper.observe(), rewards, terminated, truncated, {}

    def _same_step(
        self, rewards: Floats, terminated: Bools, truncated: Bools
    ) -> tuple[Floats, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        final, ended = self._stepper.observe(), terminated | truncated
        kept = np.full(self.num_envs, None, object)
        infos: dict[str, Any] = {"final_obs": kept, "_final_obs": ended.copy()}
        infos |= {"final_info": {}, "_final_info": ended.copy()}
        for i in np.flatnonzero(ended).tolist():
            kept[i] = final[i]
            self._start(i)
        return self._stepper.observe(), rewards, terminated, truncated, infos

    def _start(self, i: int) -> None:
        self._stepper.start(i, self._generators[i])
        self._elapsed[i], self._over[i] = 0, False

    def _checked(self, actions: np.ndarray) -> np.ndarray:
        """As the action space has them, a copy where that is another type."""
        if not self._begun:
            raise gymnasium.error.ResetNeeded("call reset before the first step")
        space, given = self.action_space, np.asarray(actions)
        if given.shape != space.shape:
            raise ValueError(f"expected actions of shape {space.shape}, got {given.shape}")
        if isinstance(self.single_action_space, gymnasium.spaces.Discrete):
            wrong = ~((given >= 0) & (given < self.single_action_space.n))
        else:
            wrong = ~np.isfinite(given)
        if wrong.any():
            i = int(np.argwhere(wrong)[0][0])
            raise ValueError(f"the action of environment {i} is {given[i]}; expected one of {self.single_action_space}")
        return given.astype(space.dtype, copy=False)


def _limit(name: str, asked: int | None) -> int | None:
    """Steps of an episode; as gymnasium has it, -1 is no limit and None that of the registry."""
    if asked is None:
        return gymnasium.registry[name].max_episode_steps
    if asked < 1 and asked != -1:
        raise ValueError(f"max_episode_steps: expected at least 1, or -1 for no limit, got {asked}")
    return None if asked == -1 else asked


def _stepper(name: str, env: Any, count: int, threads: int) -> _Stepper:
    if name in CLASSIC:
        space = env.action_space
        return _Worlds(CLASSIC[name], count, int(space.n) if isinstance(space, gymnasium.spaces.Discrete) else None)
    from prefrl.envs.fast.simulated import Bodies

    return Bodies(name, env, count, threads)


def _check_options(name: str, unknown: dict[str, Any], count: int, threads: int) -> None:
    if name not in NAMES:
        raise ValueError(f"{name!r} has no fast stepper; {suggest(name, NAMES)}")
    if count < 1:
        raise ValueError(f"num_envs must be at least 1, got {count}")
    if threads < 1:
        raise ValueError(f"threads must be at least 1, got {threads}")
    if unknown:
        raise ValueError(
            f"the fast stepper of {name} has no option {next(iter(unknown))!r} (it has max_episode_steps, "
            "autoreset_mode, for MuJoCo's threads and, for Ant, Hopper and Walker2d, terminate_when_unhealthy); "
            f'gymnasium.make_vec("{name}", ...) has its own'
        )


def _reset_mask(options: dict[str, Any] | None, count: int) -> Bools:
    given = dict(options or {})
    mask = given.pop("reset_mask", np.ones(count, bool))
    if given:
        raise ValueError(f"reset knows only the option reset_mask here, got {sorted(given)}")
    if not isinstance(mask, np.ndarray) or mask.shape != (count,) or mask.dtype != bool or not mask.any():
        raise ValueError(f"reset_mask must be {count} booleans, at least one of them true, got {mask!r}")
    return mask


def _creator(name: str) -> Callable[..., FastVectorEnv]:
    def create(**options: Any) -> FastVectorEnv:
        return FastVectorEnv(name, **options)

    return create


def _register() -> None:
    for name in NAMES:
        own = gymnasium.registry[name]
        if f"prefrl/{name}" not in gymnasium.registry:
            gymnasium.register(
                f"prefrl/{name}",
                entry_point=own.entry_point,
                reward_threshold=own.reward_threshold,
                max_episode_steps=own.max_episode_steps,
                vector_entry_point=_creator(name),
                kwargs=dict(own.kwargs),
            )


_register()

__all__ = ["NAMES", "FastVectorEnv"]
