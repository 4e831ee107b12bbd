"""A policy with a memory: recurrent networks, one for the actor and one for the critic, for worlds seen in part.

Variant: Cho et al. 2014 with the reset gate after the product, as in cuDNN; a layer with tanh stands between the state
and what is said of it. Actor and critic share nothing, and are computed in one batched pass. The update goes back
through `chunk` steps, from the state that the network itself has at a chunk's first step. The biases of the gate that
keeps the state are drawn so that units forget after 1 to `chunk` steps (Tallec and Ollivier 2018, section 3).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from pydantic import ConfigDict, Field
from torch import Tensor

from prefrl.components import Settings
from prefrl.policies.acting import Decide, Memory, Reading, copy_into, in_chunks, on_device
from prefrl.policies.heads import ActionSpace, InitialStd, choose, density, starting_std
from prefrl.policies.normaliser import Normaliser
from prefrl.policies.recurrence import recurrence, unit
from prefrl.policies.rollout import Rollout
from prefrl.protocols import ControlTask
from prefrl.seeding import generator, to_numpy
from prefrl.types import Bools, Floats, State

ACTOR, CRITIC, BOTH = slice(0, 1), slice(1, 2), slice(0, 2)
"""Which of the two networks, whose weights are stacked."""


class GRUPolicySettings(Settings):
    """Recurrent networks, an actor and a critic: for worlds in which the past says what cannot be seen."""

    model_config = ConfigDict(json_schema_extra={"required": ["kind"]})  # without one, settings are of an mlp
    kind: Literal["gru"] = "gru"
    width: int = Field(64, ge=1)
    """Units of the recurrent layer."""
    hidden: int = Field(64, ge=1)
    """Units of the layer behind it."""
    chunk: int = Field(32, ge=2)
    """Steps through which the update goes back; what has to be remembered should fit into them."""
    initial_std: InitialStd = 1.0

    def build(self, task: ControlTask, rng: np.random.Generator) -> GRUPolicy:
        return GRUPolicy(self, task, rng)


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
    """(B, L) bool: before these steps the state is set to zero."""
    states: Tensor
    """(B, 2, H): of both networks, before the first step."""
    mask: Tensor
    """(B, L) bool: the real steps."""

    def rows(self, at: Tensor) -> Chunks:
        legal = None if self.legal is None else self.legal[at]
        found = (self.observations[at], self.choices[at], legal, self.begins[at], self.states[at], self.mask[at])
        return Chunks(*found)

    def order(self) -> Tensor:
        return torch.arange(len(self.mask), device=self.mask.device)


class GRUPolicy:
    """A `prefrl.policies.acting.ControlPolicy` of `Chunks`. Acting is NumPy, learning automatic differentiation."""

    def __init__(self, settings: GRUPolicySettings, task: ControlTask, rng: np.random.Generator) -> None:
        self.chunk, self.space = settings.chunk, ActionSpace.of(task)
        self._width = settings.width
        named = _weights(settings, task, generator(rng)) | starting_std(self.space, settings.initial_std)
        self._p = torch.nn.ParameterDict(named.items())  # pairs: of a mapping it would not keep the order
        self.normaliser = Normaliser(task.observation_size)

    @property
    def device(self) -> torch.device:
        return next(iter(self.parameters())).device

    def to(self, device: torch.device) -> None:
        self._p.to(device)

    def parameters(self) -> Iterable[torch.nn.Parameter]:
        return self._p.values()

    def observe(self, observations: Floats) -> None:
        move = self.normaliser.observe(observations)
        if move is not None:
            for net in (0, 1):
                move.fold(self._p["input_weight"].data[net], self._p["input_bias"].data[net, 0])

    def decide(self) -> Decide:
        p, scaling, width = {name: to_numpy(x) for name, x in self._p.items()}, self.normaliser.now(), self._width
        std = np.exp(p["log_std"]) if "log_std" in p else None

        def decide(
            observations: Floats, rng: np.random.Generator | None, legal: Bools | None, memory: Memory, /
        ) -> tuple[Floats, Floats, Memory]:
            count = len(observations)
            before = np.zeros((count, 2 * width), np.float32) if memory is None else memory
            state = before.reshape(count, 2, width).swapaxes(0, 1)  # (2, n, H)
            gate = scaling(observations) @ p["input_weight"] + p["input_bias"]  # (2, n, 3 H)
            state, *_ = unit(gate, state, p["state_weight"], p["state_bias"])
            found = np.tanh(state[0] @ p["hidden_weight"][0] + p["hidden_bias"][0])
            outputs = found @ p["actor_weight"] + p["actor_bias"]
            choices, actions = choose(self.space, outputs, std, rng, legal)
            return choices, actions, state.swapaxes(0, 1).reshape(count, 2 * width)

        return decide

    @torch.no_grad()
    def read(self, rollout: Rollout, memory: Memory, asked: Bools) -> Reading[Chunks]:
        normalise, device, length = self.normaliser.now(), self.device, self.chunk
        count, steps = rollout.ends.shape
        observations = torch.from_numpy(normalise(rollout.observations)).to(device)
        begins = torch.from_numpy(rollout.begins).to(device)
        begins[:, 0] = False  # what is remembered at the first step is of its own episode already
        before = np.zeros((count, 2 * self._width), np.float32) if memory is None else memory
        start = torch.from_numpy(before).to(device).view(count, 2, self._width)
        states = self._states(observations, begins, start, BOTH)  # (2, T, n, H)
        values = self._values(states[1]).T
        # A step further, to the final observation, from the state in which the last action was chosen.
        after = states[1].transpose(0, 1)[torch.from_numpy(asked).to(device)]  # (k, H)
        final = torch.from_numpy(normalise(rollout.final_observations[asked])).to(device)[:, None]  # (k, 1, O)
        later = self._states(final, begins.new_zeros(len(final), 1), after[:, None], CRITIC)
        choices, legal = on_device(rollout, device)
        known = torch.cat([start[None], states.permute(1, 2, 0, 3)])  # (T + 1, n, 2, H): before each step
        at_starts = known[0:steps:length].transpose(0, 1).reshape(-1, 2, self._width)
        cut = [in_chunks(x, length) for x in (observations, choices, begins, torch.ones_like(begins))]
        allowed = None if legal is None else _some_legal(in_chunks(legal, length))
        return Reading(Chunks(cut[0], cut[1], allowed, cut[2], at_starts, cut[3]), values, self._values(later[0])[0])

    def log_prob(self, inputs: Chunks) -> tuple[Tensor, Tensor]:
        states = self._states(inputs.observations, inputs.begins, inputs.states[:, ACTOR], ACTOR)
        return self._density(states[0], inputs)

    def values(self, inputs: Chunks) -> Tensor:
        states = self._states(inputs.observations, inputs.begins, inputs.states[:, CRITIC], CRITIC)
        return self._values(states[0]).T

    def log_prob_and_values(self, inputs: Chunks) -> tuple[Tensor, Tensor, Tensor]:
        states = self._states(inputs.observations, inputs.begins, inputs.states, BOTH)
        return *self._density(states[0], inputs), self._values(states[1]).T

    def state(self) -> State:
        return {"parameters": {name: p.detach().clone() for name, p in self._p.items()}} | self.normaliser.state()

    def load(self, state: State) -> None:
        copy_into(self.named(), state["parameters"])
        self.normaliser.load(state)

    def named(self) -> dict[str, Tensor]:
        """Every weight by its name."""
        return dict(self._p.items())

    def _states(self, observations: Tensor, begins: Tensor, start: Tensor, nets: slice) -> Tensor:
        """(B, L, O) normalised, (B, L) and (B, E, H) of the E networks in `nets` -> (E, L, B, H) after each step."""
        p = {name: self._p[name][nets] for name in ("input_weight", "input_bias", "state_weight", "state_bias")}
        (rows, steps), count = begins.shape, len(p["input_bias"])
        # Time comes first; the inputs' share of all gates at once: only the state's has to go step by step.
        x = observations.transpose(0, 1).flatten(0, 1).expand(count, -1, -1)
        gates = torch.baddbmm(p["input_bias"], x, p["input_weight"])
        gates = gates.view(count, steps, rows, 3 * self._width).transpose(0, 1)
        states = recurrence(gates, start.transpose(0, 1), p["state_weight"], p["state_bias"], begins.T)
        return states.transpose(0, 1)

    def _said(self, states: Tensor, net: int) -> Tensor:
        """(L, B, H) -> (L, B, hidden)."""
        weight, bias = self._p["hidden_weight"][net], self._p["hidden_bias"][net]
        return torch.tanh(states @ weight + bias)

    def _values(self, states: Tensor) -> Tensor:
        """(L, B, H) of the critic -> (L, B)."""
        found: Tensor = self._said(states, 1) @ self._p["critic_weight"] + self._p["critic_bias"]
        return found.squeeze(-1)

    def _density(self, states: Tensor, inputs: Chunks) -> tuple[Tensor, Tensor]:
        """(L, B, H) of the actor -> (B, L) log-probabilities and entropies."""
        outputs = (self._said(states, 0) @ self._p["actor_weight"] + self._p["actor_bias"]).transpose(0, 1)
        logp, entropies = density(outputs, inputs.choices, self._p.get("log_std"), inputs.legal)
        return torch.where(inputs.mask, logp.squeeze(-1), 0.0), torch.where(inputs.mask, entropies.squeeze(-1), 0.0)


def _some_legal(legal: Tensor) -> Tensor:
    """(B, L, A): on padding all, or the entropies there would be those of nothing."""
    return legal | ~legal.any(-1, keepdim=True)


def _weights(settings: GRUPolicySettings, task: ControlTask, order: torch.Generator) -> dict[str, Tensor]:
    """Orthogonal, with gains of 1 in the recurrent layer, and as in an mlp behind it."""
    size, width, hidden = task.observation_size, settings.width, settings.hidden

    def drawn(*shape: int, gain: float = 1.0) -> Tensor:
        """(..., in, out)"""
        weights = torch.empty(shape)
        for one in weights.view(-1, *shape[-2:]):
            torch.nn.init.orthogonal_(one, gain, order)
        return weights

    named = {name: torch.cat([drawn(2, n, width) for _ in range(3)], 2) for name, n in _inputs(size, width).items()}
    keep = torch.log(1 + (settings.chunk - 2) * torch.rand(2, 1, width, generator=order))
    zeros = torch.zeros(2, 1, width)
    return named | {
        "input_bias": torch.zeros(2, 1, 3 * width),
        "state_bias": torch.cat([zeros, keep, zeros], 2),
        "hidden_weight": drawn(2, width, hidden, gain=2**0.5),
        "hidden_bias": torch.zeros(2, 1, hidden),
        "actor_weight": drawn(hidden, task.action_size, gain=0.01),
        "actor_bias": torch.zeros(task.action_size),
        "critic_weight": drawn(hidden, 1),
        "critic_bias": torch.zeros(1),
    }


def _inputs(size: int, width: int) -> dict[str, int]:
    return {"input_weight": size, "state_weight": width}


__all__ = ["Chunks", "GRUPolicy", "GRUPolicySettings"]
