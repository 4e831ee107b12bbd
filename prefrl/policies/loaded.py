"""A finished policy of control, to act with in a script of one's own."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from prefrl.components import ConfigError
from prefrl.policies.acting import Actor, Memory, forgotten, played
from prefrl.policies.rollout import Act
from prefrl.protocols import ControlTask


@dataclass(frozen=True)
class Loaded:
    """Acts like a policy of stable-baselines3, so that what evaluates those evaluates this one."""

    actor: Actor
    observation_size: int
    action_size: int
    discrete: bool

    def act(self, rng: np.random.Generator | None) -> Act:
        """For rollouts: what is drawn from `rng`, or the policy's mode; in episodes that are yet to begin."""
        return played(self.actor, rng)

    def check(self, task: ControlTask, name: str) -> None:
        """Raises `ConfigError` for a task of other spaces; `name` says whose policy this is."""
        here = task.observation_size, task.action_size, task.action_bounds is None
        if (self.observation_size, self.action_size, self.discrete) != here:
            raise ConfigError(
                f"{name}: expected a policy for {task.name}, with {_told(*here)}; this one has "
                f"{_told(self.observation_size, self.action_size, self.discrete)}: take another policy, or the task "
                "that it was made for"
            )

    def predict(
        self,
        observation: npt.ArrayLike,
        state: Memory = None,
        episode_start: npt.ArrayLike | None = None,
        deterministic: bool = True,
        rng: np.random.Generator | None = None,
    ) -> tuple[npt.NDArray[Any], Memory]:
        """(O,) or (n, O) raw observations -> actions (A,) or (n, A), whole numbers where they are discrete.

        And what the policy remembers, to be passed on as the next call's `state`; None of one without a memory.
        `episode_start` (n,): for whom nothing before counts. `rng`: what is drawn from where the policy is not
        `deterministic`. Raises ValueError for observations of another size.
        """
        rows = np.atleast_2d(np.asarray(observation, np.float32))
        if rows.ndim != 2 or rows.shape[1] != self.observation_size:
            shape = np.shape(observation)
            raise ValueError(
                f"observations must be ({self.observation_size},) or (n, {self.observation_size}), got {shape}"
            )
        drawn = None if deterministic else rng or np.random.default_rng()
        if episode_start is not None:
            state = forgotten(state, np.atleast_1d(np.asarray(episode_start, bool)))
        actions, state = self.actor(rows, drawn, state)
        found = actions.argmax(1) if self.discrete else actions
        return (found[0] if np.ndim(observation) == 1 else found), state


def _told(seen: int, acts: int, discrete: bool) -> str:
    return f"observations of {seen} numbers and {acts} {'discrete actions' if discrete else 'numbers in an action'}"


__all__ = ["Actor", "Loaded"]
