"""A policy with a memory: recurrent networks, one for the actor and one for the critic, for worlds seen in part.

Variant: Cho et al. 2014 with the reset gate after the product, as in cuDNN; a layer with tanh stands between the state
and what is said of it. The update goes back through `chunk` steps. The biases of the gate that keeps the state are
drawn so that units forget after 1 to `chunk` steps (Tallec and Ollivier 2018, section 3).
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import torch
from pydantic import ConfigDict, Field
from torch import Tensor

from prefrl.policies.heads import ActionSpace, HeadSettings, starting_std
from prefrl.policies.normaliser import Scaling
from prefrl.policies.recurrence import recurrence, unit
from prefrl.policies.remembering import BOTH, RememberingPolicy, Step, heads, orthogonal
from prefrl.protocols import ControlTask
from prefrl.seeding import generator, to_numpy
from prefrl.types import Floats


class GRUPolicySettings(HeadSettings):
    """Recurrent networks, an actor and a critic: for worlds in which the past says what cannot be seen."""

    model_config = ConfigDict(json_schema_extra={"required": ["kind"]})  # without one, settings are of an mlp
    kind: Literal["gru"] = "gru"
    width: int = Field(64, ge=1)
    """Units of the recurrent layer."""
    hidden: int = Field(64, ge=1)
    """Units of the layer behind it."""
    chunk: int = Field(32, ge=2)
    """Steps through which the update goes back; what has to be remembered should fit into them."""

    def build(self, task: ControlTask, rng: np.random.Generator) -> RememberingPolicy:
        named = _weights(self, task, generator(rng))
        named |= starting_std(ActionSpace.of(task, self), self, len(named["actor_weight"]))
        p = torch.nn.ParameterDict(named.items())  # pairs: of a mapping it would not keep the order
        return RememberingPolicy(GRU(p, self.width), p, task, self.chunk, self)


class GRU:
    """The `prefrl.policies.remembering.Networks`; what is known is the state (B, 2, H) of both. Acting is NumPy."""

    def __init__(self, p: torch.nn.ParameterDict, width: int) -> None:
        self._p, self._width = p, width

    @property
    def remembers(self) -> int:
        return 2 * self._width

    def known(self, memory: Floats, scaling: Scaling) -> Tensor:
        return torch.from_numpy(memory).to(self._p["state_weight"].device).view(-1, 2, self._width)

    def features(self, observations: Tensor, begins: Tensor, known: Tensor, nets: slice) -> list[Tensor]:
        return self._said(self._states(observations, begins, known[:, nets], nets), nets)

    def follow(self, observations: Tensor, begins: Tensor, known: Tensor) -> tuple[list[Tensor], Tensor]:
        states = self._states(observations, begins, known, BOTH)  # (2, T, n, H)
        every = torch.cat([known[None], states.permute(1, 2, 0, 3)])  # (T + 1, n, 2, H): before each step
        return self._said(states, BOTH), every.transpose(0, 1)

    def acting(self, scaling: Scaling) -> Step:
        p, width = {name: to_numpy(x) for name, x in self._p.items()}, self._width

        def step(observations: Floats, memory: Floats) -> tuple[Floats, Floats]:
            count = len(observations)
            state = memory.reshape(count, 2, width).swapaxes(0, 1)  # (2, n, H)
            gate = scaling(observations) @ p["input_weight"] + p["input_bias"]  # (2, n, 3 H)
            state, *_ = unit(gate, state, p["state_weight"], p["state_bias"])
            found = np.tanh(state[0] @ p["hidden_weight"][0] + p["hidden_bias"][0])
            return found, state.swapaxes(0, 1).reshape(count, 2 * width)

        return step

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

    def _said(self, states: Tensor, nets: slice) -> list[Tensor]:
        """(E, L, B, H) -> (L, B, hidden) of each network."""
        weights, biases = self._p["hidden_weight"][nets], self._p["hidden_bias"][nets]
        return [torch.tanh(x @ weight + bias) for x, weight, bias in zip(states, weights, biases, strict=True)]


def _weights(settings: GRUPolicySettings, task: ControlTask, order: torch.Generator) -> dict[str, Tensor]:
    """Orthogonal, with gains of 1 in the recurrent layer, and as in an mlp behind it."""
    size, width, hidden = task.observation_size, settings.width, settings.hidden
    named = {
        name: torch.cat([orthogonal(order, 2, count, width) for _ in range(3)], 2)
        for name, count in (("input_weight", size), ("state_weight", width))
    }
    keep = torch.log(1 + (settings.chunk - 2) * torch.rand(2, 1, width, generator=order))
    zeros = torch.zeros(2, 1, width)
    return named | {
        "input_bias": torch.zeros(2, 1, 3 * width),
        "state_bias": torch.cat([zeros, keep, zeros], 2),
        "hidden_weight": orthogonal(order, 2, width, hidden, gain=2**0.5),
        "hidden_bias": torch.zeros(2, 1, hidden),
        **heads(order, hidden, task.action_size),
    }


__all__ = ["GRU", "GRUPolicySettings"]
