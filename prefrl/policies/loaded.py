"""A finished policy of control, to act with in a script of one's own."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from prefrl.components import ConfigError
from prefrl.policies.acting import Actor, Memory, forgotten, played
from prefrl.policies.rollout import Act
from prefrl.protocols import ControlTask, OfEnvironment, Outside, Task
from prefrl.types import Floats

Bounds: TypeAlias = tuple[Floats, Floats]
"""(low (A,), high (A,)) of actions."""


@dataclass(frozen=True, eq=False)
class Loaded:
    """Acts like a policy of stable-baselines3, so that what evaluates those evaluates this one."""

    actor: Actor
    observation_size: int
    action_size: int
    bounds: Bounds | None
    """None where actions are discrete."""
    outside: Outside | None = None
    """What the environment itself shows and takes; None where that is what the policy sees and does."""
    shape: tuple[int, ...] = ()
    """Of the environment's observations, for a policy that was made for other ones than rows of numbers; `actor` sees
    them as rows all the same."""

    @property
    def discrete(self) -> bool:
        return self.bounds is None

    def act(self, rng: np.random.Generator | None) -> Act:
        """For rollouts: what is drawn from `rng`, or the policy's mode; in episodes that are yet to begin."""
        return played(self.actor, rng)

    def check(self, task: ControlTask, name: str) -> None:
        """Raises `ConfigError` for a task of other spaces; `name` says whose policy this is."""
        sizes, here = (self.observation_size, self.action_size), (task.observation_size, task.action_size)
        if sizes != here or not same_bounds(self.bounds, task.action_bounds):
            raise ConfigError(
                f"{name}: expected a policy for {task.name}, with {_told(*here, task.action_bounds)}; this one has "
                f"{_told(*sizes, self.bounds)}: take another policy, or the task that it was made for"
            )
        found = outside(task)
        if self.shape and found is not None and found.shape != self.shape:
            raise ConfigError(
                f"{name}: expected a policy for {task.name}, whose observations have the shape {found.shape}; this one "
                f"was made for {self.shape}: take another policy, or wrap the environment so that it shows these"
            )

    def predict(
        self,
        observation: Any,
        state: Memory = None,
        episode_start: npt.ArrayLike | None = None,
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
    ) -> tuple[npt.NDArray[Any], Memory]:
        """Observations as the environment gives them, one or n -> actions as it takes them, one or n.

        (O,) or (n, O) raw observations give (A,) or (n, A) numbers, or whole numbers where actions are discrete; an
        environment with other spaces gives and takes what it has, n of them as a vectorised environment stacks them.
        And what the policy remembers, to be passed on as the next call's `state`; None of one without a memory.
        `episode_start` (n,): for whom nothing before counts. `rng`: what is drawn from where the policy is not
        `deterministic`. Raises ValueError for other observations.
        """
        rows, one = self._rows(observation)
        if rows.ndim != 2 or rows.shape[1] != self.observation_size:
            size, shape = self.observation_size, np.shape(observation)
            seen = f" ({self.outside.shown})" if self.outside is not None and self.outside.shown else ""
            raise ValueError(f"observations must be ({size},) or (n, {size}){seen}, got {shape}")
        drawn = None if deterministic else rng or np.random.default_rng()
        if episode_start is not None:
            state = forgotten(state, np.atleast_1d(np.asarray(episode_start, bool)))
        actions, state = self.actor(rows, drawn, state)
        if self.outside is not None:
            found = self.outside.taken(actions)
        else:
            found = actions.argmax(1) if self.discrete else actions
        return (found[0] if one else found), state

    def _rows(self, observation: Any) -> tuple[Floats, bool]:
        """(n, O), and whether it was one."""
        if self.outside is not None:
            return self.outside.rows(observation)
        shape = np.shape(observation)
        if self.shape and shape[-len(self.shape) :] == self.shape:
            rows = np.asarray(observation, np.float32).reshape(-1, math.prod(self.shape))
            return rows, shape == self.shape
        return plain_rows(observation)


def same_bounds(a: Bounds | None, b: Bounds | None) -> bool:
    """Of actions; None for discrete ones."""
    if a is None or b is None:
        return a is b
    return all(np.shape(x) == np.shape(y) and np.allclose(x, y, rtol=1e-6) for x, y in zip(a, b, strict=True))


def bounds_told(bounds: Bounds | None) -> str:
    return "discrete actions" if bounds is None else f"actions from {bounds[0].tolist()} to {bounds[1].tolist()}"


def plain_rows(observations: Any) -> tuple[Floats, bool]:
    """(O,) or (n, O) numbers -> (n, O), and whether it was one."""
    return np.atleast_2d(np.asarray(observations, np.float32)), np.ndim(observations) == 1


def outside(task: Task) -> Outside | None:
    """What a task's environment itself shows and takes, where that may be something else."""
    return task.outside if isinstance(task, OfEnvironment) else None


def check_leaves(task: ControlTask) -> None:
    """Raises `ConfigError` for a task whose policy would do, without its task, what the environment does not take.

    For files that hold nothing but the policy: `Loaded` translates.
    """
    found = outside(task)
    if found is not None and found.changed:
        raise ConfigError(
            f"a policy of {task.name} cannot leave in a file of another tool, which would not know what to do there: "
            f"{'; '.join(found.changed)}. Act with it through prefrl.load_policy, which translates"
        )


def _told(seen: int, acts: int, bounds: Bounds | None) -> str:
    return f"observations of {seen} numbers and {acts} {bounds_told(bounds)}"


__all__ = ["Actor", "Bounds", "Loaded", "bounds_told", "check_leaves", "outside", "plain_rows", "same_bounds"]
