"""A policy with a memory, whatever the two networks are that remember: how it acts, and reads chunks of a rollout.

Actor and critic share nothing, and are computed in one pass. The update sees chunks of `chunk` steps, each from what
the network itself remembers at the chunk's first step.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Protocol, TypeAlias

import numpy as np
import torch
from torch import Tensor

from prefrl.policies.acting import Decide, Memory, Reading, copy_into, in_chunks, on_device
from prefrl.policies.heads import ActionSpace, HeadSettings, Noise, choose, density, mode_density
from prefrl.policies.normaliser import Normaliser, Scaling
from prefrl.policies.rollout import Rollout
from prefrl.protocols import ControlTask, Mapped
from prefrl.seeding import to_numpy
from prefrl.types import Bools, Floats, Segment, State

ACTOR, CRITIC, BOTH = slice(0, 1), slice(1, 2), slice(0, 2)
"""Which of the two networks, whose weights are stacked."""
Step: TypeAlias = Callable[[Floats, Floats], tuple[Floats, Floats]]
"""Raw observations (n, O) and memory (n, M) -> the actor's features (n, F) and the memory after this step."""


class Networks(Protocol):
    """An actor and a critic without their heads, which see a step together with what they remember.

    `known` is their memory as they compute with it, (B, ...) of B episodes or pieces of such.
    """

    @property
    def remembers(self) -> int:
        """M: how many numbers are carried from step to step."""

    def known(self, memory: Floats, scaling: Scaling) -> Tensor:
        """(n, M) -> (n, ...), on their device."""

    def features(self, observations: Tensor, begins: Tensor, known: Tensor, nets: slice) -> list[Tensor]:
        """(L, B, F) of each network in `nets`.

        `observations` (B, L, O) normalised; `begins` (B, L) bool: nothing before these steps counts; `known` before the
        first step.
        """

    def follow(self, observations: Tensor, begins: Tensor, known: Tensor) -> tuple[list[Tensor], Tensor]:
        """The same of both, and what is known (B, L + 1, ...) before each step and after the last."""

    def acting(self, scaling: Scaling) -> Step: ...


@dataclass(frozen=True, eq=False)
class Chunks:
    """B pieces of episodes, at most L steps each."""

    observations: Tensor
    """(B, L, O) normalised."""
    choices: Tensor
    """(B, L, A)."""
    legal: Tensor | None
    """(B, L, A) bool: which discrete actions there were; None where there were all."""
    begins: Tensor
    """(B, L) bool: nothing before these steps counts."""
    known: Tensor
    """(B, ...): what is remembered before the first step."""
    mask: Tensor
    """(B, L) bool: the real steps."""

    def rows(self, at: Tensor) -> Chunks:
        legal = None if self.legal is None else self.legal[at]
        found = (self.observations[at], self.choices[at], legal, self.begins[at], self.known[at], self.mask[at])
        return Chunks(*found)

    def order(self) -> Tensor:
        return torch.arange(len(self.mask), device=self.mask.device)


class RememberingPolicy:
    """A `prefrl.policies.acting.ControlPolicy` of `Chunks`. Learning is automatic differentiation."""

    exact = True

    def __init__(
        self, networks: Networks, p: torch.nn.ParameterDict, task: ControlTask, chunk: int, settings: HeadSettings
    ) -> None:
        """`p`: the weights of the networks, whose first layers are input_weight (2, O, out) and input_bias (2, 1, out),
        and of the heads on their features."""
        self.chunk, self.space, self.settings = chunk, ActionSpace.of(task, settings), settings
        self._networks, self._p, self._learns_std = networks, p, True
        self._legal = task.legal if isinstance(task, Mapped) else None
        self.normaliser = Normaliser(task.observation_size, calm=True)

    @property
    def device(self) -> torch.device:
        return next(iter(self.parameters())).device

    def to(self, device: torch.device) -> None:
        self._p.to(device)

    def parameters(self) -> Iterable[torch.nn.Parameter]:
        return self._p.values()

    def freeze(self) -> None:
        """See observations from now on as they are seen now."""
        self.normaliser.frozen = True

    def with_std_kept(self) -> RememberingPolicy:
        """A view of the same weights that does not learn the standard deviation."""
        view = copy(self)
        view._learns_std = False
        return view

    def observe(self, observations: Floats) -> None:
        move = self.normaliser.observe(observations)
        if move is not None:
            for net in (0, 1):
                move.fold(self._p["input_weight"].data[net], self._p["input_bias"].data[net, 0])

    def decide(self) -> Decide:
        step, size = self._networks.acting(self.normaliser.now()), self._networks.remembers
        weight, bias = to_numpy(self._p["actor_weight"]), to_numpy(self._p["actor_bias"])
        noise = Noise(to_numpy(self._p["log_std"]), self.settings.sde_steps) if "log_std" in self._p else None

        def decide(
            observations: Floats, rng: np.random.Generator | None, legal: Bools | None, memory: Memory, /
        ) -> tuple[Floats, Floats, Memory]:
            before = np.zeros((len(observations), size), np.float32) if memory is None else memory
            features, memory = step(observations, before)
            return *choose(self.space, features @ weight + bias, features, noise, rng, legal), memory

        return decide

    @torch.no_grad()
    def read(self, rollout: Rollout, memory: Memory, asked: Bools) -> Reading[Chunks]:
        normalise, device, length = self.normaliser.now(), self.device, self.chunk
        count, steps = rollout.ends.shape
        observations = torch.from_numpy(normalise(rollout.observations)).to(device)
        begins = torch.from_numpy(rollout.begins).to(device)
        begins[:, 0] = False  # what is remembered at the first step is of its own episode already
        before = np.zeros((count, self._networks.remembers), np.float32) if memory is None else memory
        features, known = self._networks.follow(observations, begins, self._networks.known(before, normalise))
        # A step further, to the final observation, from what was known when the last action was chosen.
        after = known[:, 1:][torch.from_numpy(asked).to(device)]
        final = torch.from_numpy(normalise(rollout.final_observations[asked])).to(device)[:, None]  # (k, 1, O)
        (later,) = self._networks.features(final, begins.new_zeros(len(final), 1), after, CRITIC)
        choices, legal = on_device(rollout, device)
        cut = [in_chunks(x, length) for x in (observations, choices, begins, torch.ones_like(begins))]
        allowed = None if legal is None else _some_legal(in_chunks(legal, length))
        at_starts = known[:, 0:steps:length].flatten(0, 1)
        chunks = Chunks(cut[0], cut[1], allowed, cut[2], at_starts, cut[3])
        return Reading(chunks, self._values(features[1]).T, self._values(later)[0])

    @property
    def ceiling(self) -> float:
        return 0.0 if self._learns_std else mode_density(self._p.get("log_std"))

    def examples(self, segments: Sequence[Segment]) -> Chunks:
        """Pieces of `chunk` steps, those of a segment one after another. It begins without a memory, wherever in its
        episode it was cut from."""
        normalise, device, cut = self.normaliser.now(), self.device, list[list[Tensor]]()
        for one in segments:
            first = np.arange(len(one)) == 0
            arrays = [normalise(one.observations), self.space.choices(one.actions), first, np.ones_like(first)]
            arrays += [] if self._legal is None else [self._legal(one.observations)]
            cut.append([in_chunks(torch.from_numpy(x).to(device)[None], self.chunk) for x in arrays])
        seen, choices, begins, mask, *legal = (torch.cat(pieces) for pieces in zip(*cut, strict=True))
        known = self._networks.known(np.zeros((len(mask), self._networks.remembers), np.float32), normalise)
        return Chunks(seen, choices, _some_legal(legal[0]) if legal else None, begins, known, mask)

    @torch.no_grad()
    def redrawn(self, examples: Chunks, rng: np.random.Generator) -> Chunks:
        """The same, with what the network remembers now where a piece goes on with what the one before it began."""
        known, goes_on = examples.known.clone(), torch.cat([~examples.begins[1:, 0], examples.begins.new_zeros(1)])
        at = examples.begins[:, 0].nonzero()[:, 0]
        while len(at := at[goes_on[at]]):
            some = examples.rows(at)
            _, after = self._networks.follow(some.observations, some.begins, known[at])
            at = at + 1
            known[at] = after[:, -1]
        return replace(examples, known=known)

    def log_prob(self, inputs: Chunks) -> tuple[Tensor, Tensor]:
        (features,) = self._features(inputs, ACTOR)
        return self._density(features, inputs)

    def values(self, inputs: Chunks) -> Tensor:
        (features,) = self._features(inputs, CRITIC)
        return self._values(features).T

    def log_prob_and_values(self, inputs: Chunks) -> tuple[Tensor, Tensor, Tensor]:
        of_actor, of_critic = self._features(inputs, BOTH)
        return *self._density(of_actor, inputs), self._values(of_critic).T

    def state(self) -> State:
        return {"parameters": {name: p.detach().clone() for name, p in self._p.items()}} | self.normaliser.state()

    def load(self, state: State) -> None:
        copy_into(self.named(), state["parameters"])
        self.normaliser.load(state)

    def named(self) -> dict[str, Tensor]:
        """Every weight by its name."""
        return dict(self._p.items())

    def _features(self, inputs: Chunks, nets: slice) -> list[Tensor]:
        return self._networks.features(inputs.observations, inputs.begins, inputs.known, nets)

    def _values(self, features: Tensor) -> Tensor:
        """(L, B, F) of the critic -> (L, B)."""
        found: Tensor = features @ self._p["critic_weight"] + self._p["critic_bias"]
        return found.squeeze(-1)

    def _density(self, features: Tensor, inputs: Chunks) -> tuple[Tensor, Tensor]:
        """(L, B, F) of the actor -> (B, L) log-probabilities and entropies."""
        outputs = (features @ self._p["actor_weight"] + self._p["actor_bias"]).transpose(0, 1)
        seen = features.transpose(0, 1)
        log_std = self._p.get("log_std")
        if log_std is not None and not self._learns_std:
            log_std = log_std.detach()
        logp, entropies = density(outputs, inputs.choices, log_std, inputs.legal, seen)
        return torch.where(inputs.mask, logp.squeeze(-1), 0.0), torch.where(inputs.mask, entropies.squeeze(-1), 0.0)


def _some_legal(legal: Tensor) -> Tensor:
    """(B, L, A): on padding all, or the entropies there would be those of nothing."""
    return legal | ~legal.any(-1, keepdim=True)


def orthogonal(order: torch.Generator, *shape: int, gain: float = 1.0) -> Tensor:
    """Weights (..., in, out) of layers that are orthogonal each (Saxe et al. 2014)."""
    weights = torch.empty(shape)
    for one in weights.view(-1, *shape[-2:]):
        torch.nn.init.orthogonal_(one, gain, order)
    return weights


def heads(order: torch.Generator, width: int, actions: int) -> dict[str, Tensor]:
    """The layers on features of that width: the actor's starts with about the same distribution in every state."""
    return {
        "actor_weight": orthogonal(order, width, actions, gain=0.01),
        "actor_bias": torch.zeros(actions),
        "critic_weight": orthogonal(order, width, 1),
        "critic_bias": torch.zeros(1),
    }


__all__ = ["ACTOR", "BOTH", "CRITIC", "Chunks", "Networks", "RememberingPolicy", "Step", "heads", "orthogonal"]
