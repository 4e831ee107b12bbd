"""A policy with a memory: causal transformers, one for the actor and one for the critic, over the last observations.

Variant: Vaswani et al. 2017 with norms before the sublayers, so that a step passes by them unchanged (TrXL-I of
Parisotto et al. 2019, section 3.1; their gates are left out), norms without weights of their own, and a learned bias
for each head and distance in place of positions (Raffel et al. 2020, section 2.1). What is remembered are the
observations themselves, so a gradient goes back as far as attention does, also beyond a chunk's first step.
"""

from __future__ import annotations

import math
from typing import Literal

import numpy as np
import torch
from pydantic import ConfigDict, Field, model_validator
from torch import Tensor

from prefrl.policies.heads import ActionSpace, HeadSettings, starting_std
from prefrl.policies.normaliser import Scaling
from prefrl.policies.remembering import ACTOR, BOTH, RememberingPolicy, Step, heads, orthogonal
from prefrl.protocols import ControlTask
from prefrl.seeding import generator, to_numpy
from prefrl.types import Floats


class TransformerPolicySettings(HeadSettings):
    """Causal transformers, an actor and a critic: for worlds in which the past says what cannot be seen."""

    model_config = ConfigDict(json_schema_extra={"required": ["kind"]})  # without one, settings are of an mlp
    kind: Literal["transformer"] = "transformer"
    context: int = Field(32, ge=2)
    """Steps that a layer looks at, the present one among them; each layer more reaches as much further back."""
    layers: int = Field(1, ge=1)
    """Of attention, each with a hidden layer behind it."""
    width: int = Field(64, ge=1)
    """Numbers that stand for a step; a multiple of `heads`."""
    heads: int = Field(4, ge=1)
    """Of the attention."""
    hidden: int = Field(128, ge=1)
    """Units of the hidden layer behind the attention."""
    chunk: int = Field(32, ge=2)
    """Steps in a sequence of the update."""

    @model_validator(mode="after")
    def _whole_heads(self) -> TransformerPolicySettings:
        if self.width % self.heads:
            raise ValueError(f"width must be a multiple of heads, got {self.width} and {self.heads}")
        return self

    def build(self, task: ControlTask, rng: np.random.Generator) -> RememberingPolicy:
        named = _weights(self, task, generator(rng))
        named |= starting_std(ActionSpace.of(task, self), self, len(named["actor_weight"]))
        p = torch.nn.ParameterDict(named.items())  # pairs: of a mapping it would not keep the order
        return RememberingPolicy(Transformer(p, self, task.observation_size), p, task, self.chunk, self)


class Transformer:
    """The `prefrl.policies.remembering.Networks`; what is known are the last tokens (B, K, O + 1).

    A token is an observation and the number of its episode, -1 where there was no step. Each layer answers for fewer
    steps than it reads, by those that only look back: so steps say the same whatever else is computed with them.
    """

    def __init__(self, p: torch.nn.ParameterDict, settings: TransformerPolicySettings, size: int) -> None:
        self._p, self._settings, self._size = p, settings, size
        self._back = settings.context - 1

    @property
    def remembers(self) -> int:
        return self._settings.layers * self._back * (self._size + 1)

    def known(self, memory: Floats, scaling: Scaling) -> Tensor:
        tokens = memory.reshape(len(memory), -1, self._size + 1)
        # Zeros are no step, of the episode -1; the others are of episode 0.
        known = np.concatenate([scaling(tokens[..., :-1]), tokens[..., -1:] - 1], 2)
        return torch.from_numpy(known).to(self._p["input_weight"].device)

    def features(self, observations: Tensor, begins: Tensor, known: Tensor, nets: slice) -> list[Tensor]:
        return self._computed(_tokens(observations, begins, known), nets)

    def follow(self, observations: Tensor, begins: Tensor, known: Tensor) -> tuple[list[Tensor], Tensor]:
        tokens = _tokens(observations, begins, known)
        return self._computed(tokens, BOTH), tokens.unfold(1, known.shape[1], 1).transpose(2, 3)

    def acting(self, scaling: Scaling) -> Step:
        @torch.no_grad()
        def step(observations: Floats, memory: Floats) -> tuple[Floats, Floats]:
            known = self.known(memory, scaling)
            seen = torch.from_numpy(scaling(observations)).to(known)[:, None]  # (n, 1, O)
            (found,) = self.features(seen, torch.zeros_like(seen[..., 0], dtype=torch.bool), known, ACTOR)
            token = np.concatenate([observations, np.ones((len(observations), 1), np.float32)], 1)
            return to_numpy(found[0]), np.concatenate([memory[:, token.shape[1] :], token], 1)

        return step

    def _computed(self, tokens: Tensor, nets: slice) -> list[Tensor]:
        """(B, K + L, O + 1) -> (L, B, width) of each network."""
        x = self._linear("input", tokens[..., :-1].expand(self._p["input_weight"][nets].shape[0], -1, -1, -1), nets)
        episodes = tokens[..., -1]
        for layer in range(self._settings.layers):
            x = x[:, :, self._back :] + self._attended(_normed(x), episodes, layer, nets)
            inner = torch.relu(self._linear(f"hidden_{layer}", _normed(x), nets))
            x = x + self._linear(f"back_{layer}", inner, nets)
            episodes = episodes[:, self._back :]
        return list(_normed(x).transpose(1, 2))

    def _attended(self, x: Tensor, episodes: Tensor, layer: int, nets: slice) -> Tensor:
        """(E, B, S, width) and (B, S) -> (E, B, S - `_back`, width)."""
        back, count = self._back, self._settings.heads
        # (E, B, heads, S, width of a head)
        query, key, value = (
            self._linear(f"{name}_{layer}", of, nets).view(*of.shape[:3], count, of.shape[3] // count).transpose(2, 3)
            for name, of in (("query", x[:, :, back:]), ("key", x), ("value", x))
        )
        steps = torch.arange(key.shape[3], device=x.device)
        apart = steps[back:, None] - steps  # (S - back, S): how long ago
        seen = (episodes[:, back:, None] == episodes[:, None]) & (apart >= 0) & (apart <= back)
        near = self._p[f"near_{layer}"][nets][:, :, apart.clamp(0, back)]  # (E, heads, S - back, S)
        scores = query @ key.transpose(3, 4) / math.sqrt(key.shape[-1]) + near[:, None]
        weights = scores.masked_fill(~seen[:, None], -math.inf).softmax(-1)  # a step always sees itself
        return self._linear(f"out_{layer}", (weights @ value).transpose(2, 3).flatten(3), nets)

    def _linear(self, name: str, x: Tensor, nets: slice) -> Tensor:
        """(E, B, S, in) -> (E, B, S, out)."""
        weight, bias = self._p[f"{name}_weight"][nets], self._p[f"{name}_bias"][nets]
        return torch.baddbmm(bias, x.flatten(1, 2), weight).view(*x.shape[:3], weight.shape[2])


def _tokens(observations: Tensor, begins: Tensor, known: Tensor) -> Tensor:
    """(B, L, O), (B, L) and (B, K, O + 1) -> (B, K + L, O + 1)."""
    episodes = known[:, -1:, -1].clamp(min=0) + begins.cumsum(1)
    return torch.cat([known, torch.cat([observations, episodes[..., None]], 2)], 1)


def _normed(x: Tensor) -> Tensor:
    return torch.nn.functional.layer_norm(x, x.shape[-1:])


def _weights(settings: TransformerPolicySettings, task: ControlTask, order: torch.Generator) -> dict[str, Tensor]:
    """Orthogonal; what is added to a step starts small, so that at first a policy does what its observation says."""
    named: dict[str, Tensor] = {}

    def layer(name: str, fan_in: int, fan_out: int, gain: float = 1.0) -> None:
        named[f"{name}_weight"] = orthogonal(order, 2, fan_in, fan_out, gain=gain)
        named[f"{name}_bias"] = torch.zeros(2, 1, fan_out)

    width = settings.width
    layer("input", task.observation_size, width)
    for i in range(settings.layers):
        for name in ("query", "key", "value"):
            layer(f"{name}_{i}", width, width)
        layer(f"out_{i}", width, width, 0.5)
        layer(f"hidden_{i}", width, settings.hidden, 2**0.5)
        layer(f"back_{i}", settings.hidden, width, 0.5)
        named[f"near_{i}"] = torch.zeros(2, settings.heads, settings.context)
    return named | heads(order, width, task.action_size)


__all__ = ["Transformer", "TransformerPolicySettings"]
