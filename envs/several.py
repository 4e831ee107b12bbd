"""Several control tasks as one: a policy and a reward model that see which one they are in.

Variant: multi-task learning with the task's number as one-hot after the observation, as in Meta-World's MT tasks (Yu et
al. 2019). Observations are padded with zeros to the longest. Left out: scales of gold that differ between tasks, which
comparisons do not see, since they stay within a task, but the mean of the golds does.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from gymnasium.spaces import Box, Discrete
from pydantic import Field, field_validator

from prefrl.components import ConfigError, Settings
from prefrl.envs.control import ControlSettings, GymnasiumTask
from prefrl.envs.spaces import OwnSpaces
from prefrl.protocols import Environments, Transition
from prefrl.types import Bools, Floats, Integers, Segment


def _two() -> dict[str, ControlSettings]:
    return {"mars": ControlSettings(options={"g": 3.71}), "earth": ControlSettings(options={"g": 9.81})}


class SeveralSettings(Settings):
    """Several control tasks as one: a one-hot of the task follows each observation, and labels stay within a task."""

    kind: Literal["several"] = "several"
    tasks: dict[str, ControlSettings] = Field(default_factory=_two, min_length=2)
    """By a name of your own, each with the settings of task.kind=control. Actions, horizons and steps of a segment have
    to be the same; shorter observations are padded with zeros."""

    @field_validator("tasks")
    @classmethod
    def _plain_names(cls, tasks: dict[str, ControlSettings]) -> dict[str, ControlSettings]:
        for name in tasks:
            if not re.fullmatch(r"[\w.-]{1,40}", name):
                raise ValueError(f"the name {name!r} of a task: expected letters, digits, _, - and ., at most 40")
        return tasks

    def lasting(self) -> SeveralSettings:
        return self.model_copy(update={"tasks": {name: one.lasting() for name, one in self.tasks.items()}})

    def identity(self) -> SeveralSettings:
        return self.lasting()

    def build(self) -> SeveralTask:
        """Raises `ConfigError` where two tasks cannot be combined, or one cannot be built."""
        built = {name: _built(name, one) for name, one in self.tasks.items()}
        first, *others = built.items()
        for other in others:
            _check_alike(first, other)
        return SeveralTask(tuple(built), tuple(built.values()), tuple(map(_state_size, built.values())))


def _built(name: str, settings: ControlSettings) -> GymnasiumTask:
    try:
        return settings.build()
    except ConfigError as error:
        raise ConfigError(f"task.tasks.{name}: {error}") from error


def _check_alike(first: tuple[str, GymnasiumTask], other: tuple[str, GymnasiumTask]) -> None:
    """Raise `ConfigError` for what one policy cannot do in both, or what cannot be compared."""
    (name, one), (other_name, another) = first, other
    facts = {
        "actions": (_actions(one), _actions(another), "choose environments whose actions are the same"),
        "horizon": (one.horizon, another.horizon, "set horizon for each"),
        "segment_steps": (one.segment_steps, another.segment_steps, "set segment_steps for each"),
    }
    for what, (here, there, remedy) in facts.items():
        if here != there:
            raise ConfigError(
                f"task.tasks: {what} of {name} and {other_name} differ, {here} and {there}, and one policy is to learn "
                f"both: {remedy}"
            )


def _actions(task: GymnasiumTask) -> str:
    if task.action_bounds is None:
        own = None if task.outside is None else task.outside.actions
        plain = own is None or (isinstance(own, Discrete) and own.start == 0)
        return f"{task.action_size} choices" + ("" if plain else f" of {own}")
    low, high = (side.tolist() for side in task.action_bounds)
    return f"{task.action_size} numbers from {low} to {high}"


def _state_size(task: GymnasiumTask) -> int | None:
    envs = task.environments(1)
    envs.reset(np.random.default_rng(0))
    states = envs.states()
    return None if states is None else states.shape[1]


@dataclass(frozen=True, eq=False)
class SeveralTask:
    """A `prefrl.protocols.ControlTask` that is `prefrl.protocols.Mixed` and `prefrl.protocols.OfEnvironment`."""

    names: tuple[str, ...]
    tasks: tuple[GymnasiumTask, ...]
    state_sizes: tuple[int | None, ...]
    """Numbers of a simulator's state; None where it has none."""
    kind: str = "control"

    @property
    def name(self) -> str:
        return f"several: {', '.join(self.names)}"

    @property
    def horizon(self) -> int:
        return self.tasks[0].horizon

    @property
    def segment_steps(self) -> int:
        return self.tasks[0].segment_steps

    @property
    def observation_size(self) -> int:
        return max(one.observation_size for one in self.tasks) + len(self.tasks)

    @property
    def action_size(self) -> int:
        return self.tasks[0].action_size

    @property
    def action_bounds(self) -> tuple[Floats, Floats] | None:
        return self.tasks[0].action_bounds

    @property
    def fps(self) -> float:
        """The first task's: a clip of another one may play at another speed than it has."""
        return self.tasks[0].fps

    @property
    def notes(self) -> Sequence[str]:
        return [f"{name}: {note}" for name, one in zip(self.names, self.tasks, strict=True) for note in one.notes]

    @property
    def outside(self) -> OwnSpaces | None:
        """A row of numbers goes in, with the task's at its end; out comes what each of the environments takes."""
        own = self.tasks[0].outside
        return own and OwnSpaces(Box(-np.inf, np.inf, (self.observation_size,)), own.actions)

    @property
    def variable_horizon(self) -> bool:
        return any(one.variable_horizon for one in self.tasks)

    def environments(self, count: int) -> Environments:
        return Mixture(self, count)

    def which(self, observations: Floats) -> Integers:
        found: Integers = observations[..., -len(self.tasks) :].argmax(-1)
        return found

    def frames(self, segment: Segment) -> np.ndarray:
        at = int(self.which(segment.observations[0]))
        task, size = self.tasks[at], self.state_sizes[at]
        states = None if segment.states is None else segment.states[:, :size]
        seen = segment.observations[:, : task.observation_size]
        return task.frames(replace(segment, observations=seen, states=states))


class Mixture:
    """`prefrl.protocols.Environments` of several tasks by turns: environment i is of task i, counted round."""

    def __init__(self, task: SeveralTask, count: int) -> None:
        self._task, self._count = task, count
        self._parts: list[tuple[int, Integers, Environments]] = []

    def reset(self, rng: np.random.Generator) -> Floats:
        """Fewer environments than tasks are of some, which are drawn."""
        several = len(self._task.tasks)
        if not self._parts or self._count < several:
            first = int(rng.integers(several)) if self._count < several else 0
            whose = (first + np.arange(self._count)) % several
            rows = ((at, np.flatnonzero(whose == at)) for at in range(several))
            self._parts = [(at, own, self._task.tasks[at].environments(len(own))) for at, own in rows if len(own)]
        return self._joined([self._seen(at, envs.reset(rng)) for at, _, envs in self._parts])

    def step(self, actions: Floats) -> Transition:
        steps = [(at, envs.step(actions[own])) for at, own, envs in self._parts]
        return Transition(
            observations=self._joined([self._seen(at, one.observations) for at, one in steps]),
            rewards=self._joined([one.rewards for _, one in steps]),
            terminated=self._joined([one.terminated for _, one in steps]),
            truncated=self._joined([one.truncated for _, one in steps]),
            final_observations=self._joined([self._seen(at, one.final_observations) for at, one in steps]),
        )

    def states(self) -> Floats | None:
        """Padded with zeros to the longest; None where a simulator has none."""
        sizes = [size for size in self._task.state_sizes if size is not None]
        found = [envs.states() for _, _, envs in self._parts]
        known = [one for one in found if one is not None]
        if len(sizes) < len(self._task.tasks) or len(known) < len(found):
            return None
        return self._joined([_padded(one, max(sizes)) for one in known])

    def legal(self) -> Bools | None:
        found = [envs.legal() for _, _, envs in self._parts]
        if all(one is None for one in found):
            return None
        size = self._task.action_size
        every = [np.ones((len(own), size), bool) for _, own, _ in self._parts]
        return self._joined([all_ if one is None else one for all_, one in zip(every, found, strict=True)])

    def _seen(self, at: int, observations: Floats) -> Floats:
        """(m, O): padded, and with the task's number as one-hot."""
        several = len(self._task.tasks)
        seen = _padded(observations, self._task.observation_size).astype(np.float32)
        seen[:, at - several] = 1.0
        return seen

    def _joined(self, parts: Sequence[np.ndarray]) -> np.ndarray:
        """The rows of all parts, each in its place."""
        whole = np.zeros((self._count, *parts[0].shape[1:]), parts[0].dtype)
        for (_, own, _), part in zip(self._parts, parts, strict=True):
            whole[own] = part
        return whole


def _padded(rows: Floats, size: int) -> Floats:
    found: Floats = np.pad(rows, ((0, 0), (0, size - rows.shape[1])))
    return found
