"""What a learner of control asks of a policy, whatever its kind: to act, to remember, and to read a rollout again.

A policy with a memory reads chunks of `chunk` steps in the update, each from what it remembered at the chunk's first
step (as R2D2's stored state, Kapturowski et al. 2019, section 3, but of the newest rollout and computed by the network
that is trained); one without reads single steps.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Generic, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from prefrl.policies.normaliser import Normaliser
from prefrl.policies.rollout import Rollout
from prefrl.protocols import ControlTask, I, Mapped, Policy
from prefrl.seeding import to_numpy
from prefrl.types import Bools, Floats, Segment, State

Memory: TypeAlias = Floats | None
"""(n, M) of n episodes, zeros where one begins; None for a policy that has none, and before the first step."""


class Decide(Protocol):
    """A policy as it was when this was made; it is not to be kept while the policy learns."""

    def __call__(
        self, observations: Floats, rng: np.random.Generator | None, legal: Bools | None, memory: Memory, /
    ) -> tuple[Floats, Floats, Memory]:
        """(n, O) -> choices (n, A), actions to execute (n, A) and what is remembered; the mode where `rng` is None."""


@dataclass(frozen=True, eq=False)
class Reading(Generic[I]):
    """A rollout of n environments and T steps, as a policy reads it again."""

    inputs: I
    """For the update; its sequences are `in_chunks` of the steps."""
    values: Tensor
    """(n, T) what the critic expects at each step."""
    final: Tensor
    """(k,) what it expects of the final observations that it was asked about."""
    decides: Bools | None = None
    """(n, T): at which steps something was chosen, each a row of the inputs; None where at every one."""


class ControlPolicy(Policy[I], Protocol[I]):
    """A policy that acts in environments, and its critic."""

    @property
    def chunk(self) -> int:
        """How many steps there are in a sequence of the update; 1 for policies that remember nothing."""

    @property
    def exact(self) -> bool:
        """Whether log-probabilities are such; else they are only good for ratios, and say nothing of a KL."""

    @property
    def device(self) -> torch.device: ...

    def to(self, device: torch.device) -> None:
        """Move the weights to a device."""

    def observe(self, observations: Floats) -> None:
        """Add raw observations (..., O) to the normaliser's statistics, without changing what the policy does."""

    def decide(self) -> Decide: ...

    def read(self, rollout: Rollout, memory: Memory, asked: Bools) -> Reading[I]:
        """`memory` (n, M): at the rollout's first step; `asked` (n, T): which final observations are to be valued."""

    def state(self) -> State: ...

    def load(self, state: State) -> None:
        """Raises ValueError where shapes differ."""


class Kinded(Protocol):
    """Settings of a kind of policy."""

    @property
    def kind(self) -> str: ...


class Clonable(ControlPolicy[I], Protocol[I]):
    """A policy that can be fitted on what was shown."""

    @property
    def settings(self) -> Kinded: ...

    @property
    def normaliser(self) -> Normaliser: ...

    @property
    def ceiling(self) -> float:
        """The highest log-probability there can be, where that stays what it is; 0 where it does not."""

    def examples(self, segments: Sequence[Segment]) -> I:
        """What was done in some segments: in order, each cut into sequences of `chunk` steps."""

    def redrawn(self, examples: I, rng: np.random.Generator) -> I:
        """The same with new draws, or what is remembered now, for policies whose log-probabilities hang on such."""


Actor: TypeAlias = Callable[[Floats, np.random.Generator | None, Memory], tuple[Floats, Memory]]
"""(n, O) observations and what is remembered of each episode -> (n, A) actions to execute, and what is remembered now:
the policy's mode, or drawn where there is a generator."""


def forgetful(act: Callable[[Floats], Floats]) -> Actor:
    """Who does (n, A) where it sees (n, O), whatever came before, and draws nothing."""
    return lambda observations, rng, memory: (act(observations), memory)


class Acting:
    """An `Act` of a policy, with what it remembers of the episodes that it is in."""

    def __init__(self, decide: Decide, rng: np.random.Generator | None, memory: Memory = None) -> None:
        """The policy's choices, drawn from `rng`, or its mode."""
        self._decide, self._rng, self.memory = decide, rng, memory

    def __call__(self, observations: Floats, legal: Bools | None, begins: Bools) -> tuple[Floats, Floats]:
        self.memory = forgotten(self.memory, begins)
        choices, actions, self.memory = self._decide(observations, self._rng, legal, self.memory)
        return choices, actions


def played(actor: Actor, rng: np.random.Generator | None) -> Acting:
    """An actor in episodes that are yet to begin; its actions are its choices."""

    def decide(
        observations: Floats, rng: np.random.Generator | None, legal: Bools | None, memory: Memory, /
    ) -> tuple[Floats, Floats, Memory]:
        actions, memory = actor(observations, rng, memory)
        return actions, actions, memory

    return Acting(decide, rng)


def allowed(task: ControlTask, observations: Floats) -> Bools | None:
    """(n, A): which actions there are, where a task's observations (n, O) say so; for those who act without it."""
    return task.legal(observations) if isinstance(task, Mapped) else None


def forgotten(memory: Memory, begins: Bools) -> Memory:
    """The same, without what belongs to other episodes than those that begin (n,)."""
    return memory if memory is None else np.where(begins[:, None], np.float32(0), memory)


def in_chunks(steps: Tensor, length: int) -> Tensor:
    """(n, T, ...) -> (n x chunks, length, ...): rows cut from their start, the last chunk of each padded with zeros."""
    rows, count = steps.shape[:2]
    chunks = -(-count // length)
    if chunks * length > count:
        padding = steps.new_zeros(rows, chunks * length - count, *steps.shape[2:])
        steps = torch.cat([steps, padding], 1)
    return steps.reshape(rows * chunks, length, *steps.shape[2:])


@dataclass(frozen=True, eq=False)
class Decisions:
    """B decisions, each a sequence of one step to the update."""

    observations: Tensor
    """(B, O) normalised."""
    choices: Tensor
    """(B, A)."""
    legal: Tensor | None = None
    """(B, A) bool: which discrete actions there were; None where there were all."""

    @classmethod
    def of(cls, rollout: Rollout, observations: Tensor) -> Decisions:
        """Those of a rollout, in the order of `in_chunks`; its observations (n, T, O) as the network reads them."""
        choices, legal = on_device(rollout, observations.device)
        # (n, T, .) -> (B, .)
        return cls(observations.flatten(0, 1), choices.flatten(0, 1), None if legal is None else legal.flatten(0, 1))

    @property
    def mask(self) -> Tensor:
        """(B, 1): all real."""
        return self.choices.new_ones(len(self.choices), 1, dtype=torch.bool)

    def rows(self, at: Tensor) -> Decisions:
        return Decisions(self.observations[at], self.choices[at], None if self.legal is None else self.legal[at])

    def order(self) -> Tensor:
        return torch.arange(len(self.choices), device=self.choices.device)

    def columns(self) -> dict[str, npt.NDArray[Any]]:
        """The same in NumPy."""
        found = {"observations": to_numpy(self.observations), "choices": to_numpy(self.choices)}
        return found if self.legal is None else found | {"legal": to_numpy(self.legal)}


def on_device(rollout: Rollout, device: torch.device) -> tuple[Tensor, Tensor | None]:
    """(n, T, A) choices, and which discrete ones there were."""
    legal = None if rollout.legal is None else torch.from_numpy(rollout.legal).to(device)
    return torch.from_numpy(rollout.choices).to(device), legal


@torch.no_grad()
def copy_into(parameters: dict[str, Tensor], saved: dict[str, Tensor]) -> None:
    """In place: an optimiser holds this very memory. Raises ValueError where shapes differ."""
    for name, parameter in parameters.items():
        found, expected = tuple(saved[name].shape) if name in saved else None, tuple(parameter.shape)
        if found != expected:
            raise ValueError(f"policy: {name} has shape {found}, expected {expected}: other settings or task")
        parameter.copy_(saved[name])


__all__ = [
    "Acting",
    "Clonable",
    "ControlPolicy",
    "Decide",
    "Decisions",
    "Memory",
    "Reading",
    "allowed",
    "copy_into",
    "forgetful",
    "forgotten",
    "in_chunks",
    "on_device",
]
