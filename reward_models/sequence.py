"""Rewards that look back: a GRU, and a causal transformer over steps. A step is judged by what led to it.

Variants: the GRU of Cho et al. 2014 with the reset gate after the product; and the Preference Transformer (Kim et al.
2023, section 4) with one token a step and preference attention that looks back only, so that each step has a reward of
its own. Left out: attention to later steps, and dropout.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from torch.nn.functional import gelu, layer_norm, scaled_dot_product_attention

from prefrl.components import ConfigError, Settings
from prefrl.protocols import Task, control
from prefrl.reward_models.ensemble import Ensemble
from prefrl.reward_models.steps import CACHED, StepReward, described, input_width, uniform
from prefrl.seeding import generator


class GRUSettings(Settings):
    """An ensemble of recurrent networks over the steps of a segment (Cho et al. 2014)."""

    kind: Literal["gru"] = "gru"
    members: int = Field(3, ge=1)
    """E: how many networks, each from its own random start."""
    width: int = Field(32, ge=1)
    """Units of the recurrent layer."""
    features: str = "inputs"
    """What it sees of a step: observation and action (`inputs`); the observation alone (`observations`), where how
    somebody acts gives away who it is; or hand-made features, by name in the entry-point group `prefrl.features`."""
    memory: int | None = Field(None, ge=1)
    """How many steps a reward looks at, its own included; the length of the task's segments when left out."""
    gain: float = Field(10.0, gt=0)
    """A segment's raw score is this times the mean of its networks' outputs, when it has the task's usual length."""
    combine: Ensemble = Ensemble()
    """How the members become the one reward that learners optimise."""

    def build(self, task: Task, rng: np.random.Generator) -> StepReward:
        found = control(task, f"reward kind {self.kind!r} scores control segments")
        describe = described(self.features)
        network = GRU(self, input_width(found, describe), self.memory or found.segment_steps, rng)
        return StepReward(network, found, self.gain, self.combine, describe=describe)


class GRU:
    """A `Network`: E gated recurrent units, and a linear output of each step's state."""

    def __init__(self, settings: GRUSettings, inputs: int, memory: int, rng: np.random.Generator) -> None:
        order = generator(rng)
        self.members = settings.members
        self.memory = memory
        self.most = CACHED // settings.members
        width = settings.width
        shapes = {
            "input_weight": (inputs, 3 * width),
            "input_bias": (1, 3 * width),
            "state_weight": (width, 3 * width),
            "state_bias": (1, 3 * width),
            "output_weight": (width, 1),
            "output_bias": (1, 1),
        }
        self._p = {n: uniform((settings.members, *s), width, order) for n, s in shapes.items()}

    def named(self) -> Mapping[str, Tensor]:
        return self._p

    @property
    def first(self) -> tuple[Tensor, Tensor]:
        return self._p["input_weight"], self._p["input_bias"]

    def outputs(self, inputs: Tensor) -> Tensor:
        p, (rows, steps) = self._p, inputs.shape[-3:-1]
        # (E, T B, I): time comes first, so that unbind(1) below gives one step after another.
        x = inputs.transpose(-3, -2).flatten(-3, -2).expand(self.members, -1, -1)
        # The inputs' share of all gates at once; only the state's share has to go step by step.
        gates = torch.baddbmm(p["input_bias"], x, p["input_weight"]).view(self.members, steps, rows, -1).unbind(1)
        state = inputs.new_zeros(self.members, rows, p["state_weight"].shape[1])  # (E, B, H)
        states: list[Tensor] = []
        for gate in gates:
            state = self._step(gate, state)
            states.append(state)
        outputs = torch.baddbmm(p["output_bias"], torch.cat(states, 1), p["output_weight"])
        return outputs.view(self.members, steps, rows).transpose(1, 2)  # (E, T B, 1) -> (E, B, T)

    def _step(self, gate: Tensor, state: Tensor) -> Tensor:
        """(E, B, 3 H) of the inputs and (E, B, H) -> the next state."""
        width = state.shape[2]
        own = torch.baddbmm(self._p["state_bias"], state, self._p["state_weight"])
        reset, update = (gate[..., : 2 * width] + own[..., : 2 * width]).sigmoid().chunk(2, -1)
        # The reset gate is applied after the product, as in cuDNN and torch; Cho et al. apply it before.
        new = torch.tanh(gate[..., 2 * width :] + reset * own[..., 2 * width :])
        return torch.lerp(new, state, update)  # (1 - update) new + update state


class PreferenceTransformerSettings(Settings):
    """An ensemble of causal transformers over the steps of a segment, with preference attention on top."""

    kind: Literal["preference_transformer"] = "preference_transformer"
    members: int = Field(3, ge=1)
    """E: how many networks, each from its own random start."""
    width: int = Field(32, ge=1)
    """Units of a layer; a multiple of `heads`."""
    heads: int = Field(2, ge=1)
    """Attention heads of a layer."""
    layers: int = Field(1, ge=1)
    """Layers of attention and feed-forward units."""
    preference_attention: bool = True
    """Let a step's reward be an attention-weighted mean of what the steps up to it are worth, not its own worth."""
    features: str = "inputs"
    """What it sees of a step: observation and action (`inputs`); the observation alone (`observations`), where how
    somebody acts gives away who it is; or hand-made features, by name in the entry-point group `prefrl.features`."""
    memory: int | None = Field(None, ge=1)
    """How many steps a reward looks at, its own included; the length of the task's segments when left out."""
    gain: float = Field(10.0, gt=0)
    """A segment's raw score is this times the mean of its networks' outputs, when it has the task's usual length."""
    combine: Ensemble = Ensemble()
    """How the members become the one reward that learners optimise."""

    def build(self, task: Task, rng: np.random.Generator) -> StepReward:
        found = control(task, f"reward kind {self.kind!r} scores control segments")
        if self.width % self.heads:
            raise ConfigError(f"reward.width must be a multiple of reward.heads, got {self.width} and {self.heads}")
        describe = described(self.features)
        network = PreferenceTransformer(self, input_width(found, describe), self.memory or found.segment_steps, rng)
        return StepReward(network, found, self.gain, self.combine, describe=describe)


class PreferenceTransformer:
    """A `Network`: E pre-norm causal transformers with learned positions, after Kim et al. 2023, section 4.

    A step is one token, of its observation and action together; the paper makes two of it. Its preference attention
    weighs each step's worth by what all steps of a segment, later ones too, attend to, so no step has a reward of its
    own. Here a step attends to itself and earlier ones: with z_t = sum over j <= t of
    softmax_j(q_t k_j) r_j, z_t is the reward of step t, and their sum is the score, a weighted sum of the r_j as in
    the paper. The paper's policies get r_t; here they get z_t, which is what was fitted.
    """

    def __init__(
        self, settings: PreferenceTransformerSettings, inputs: int, memory: int, rng: np.random.Generator
    ) -> None:
        order = generator(rng)
        self.members = settings.members
        self.memory = memory
        self.most = CACHED // settings.members
        self._heads = settings.heads
        self._layers = settings.layers
        self._weighted = settings.preference_attention
        width = settings.width
        self._p: dict[str, Tensor] = {"place": uniform((settings.members, memory, width), width, order)}
        self._linear("input", inputs, width, order)
        for i in range(settings.layers):
            for name, o, n in (("qkv", width, 3 * width), ("mix", width, width), ("up", width, 4 * width)):
                self._linear(f"layer_{i}_{name}", o, n, order)
            self._linear(f"layer_{i}_down", 4 * width, width, order)
        self._linear("output", width, 1, order)
        if self._weighted:
            self._linear("attend", width, 2 * width, order)

    def named(self) -> Mapping[str, Tensor]:
        return self._p

    @property
    def first(self) -> tuple[Tensor, Tensor]:
        return self._p["input_weight"], self._p["input_bias"]

    def outputs(self, inputs: Tensor) -> Tensor:
        steps = inputs.shape[-2]
        x = self._apply("input", inputs.expand(self.members, *inputs.shape[-3:]))  # (E, B, T, I) -> (E, B, T, width)
        x = x + self._p["place"][:, None, :steps]  # (E, 1, T, width): every row starts at the first place
        for i in range(self._layers):
            q, k, v = self._apply(f"layer_{i}_qkv", _normed(x)).chunk(3, -1)
            x = x + self._apply(f"layer_{i}_mix", self._attention(q, k, v))
            x = x + self._apply(f"layer_{i}_down", gelu(self._apply(f"layer_{i}_up", _normed(x))))
        x = _normed(x)
        worth = self._apply("output", x)
        if not self._weighted:
            return worth[..., 0]
        q, k = self._apply("attend", x).chunk(2, -1)
        # The worths (E, B, T, 1) take the place of values: what comes out is their weighted mean, on their own scale.
        return scaled_dot_product_attention(q, k, worth, is_causal=True)[..., 0]

    def _linear(self, name: str, fan_in: int, fan_out: int, order: torch.Generator) -> None:
        """Each layer norm's own gain and shift would be part of the linear layer behind it, and are left to it."""
        self._p[f"{name}_weight"] = uniform((self.members, fan_in, fan_out), fan_in, order)
        self._p[f"{name}_bias"] = torch.nn.Parameter(torch.zeros(self.members, 1, fan_out))

    def _apply(self, name: str, x: Tensor) -> Tensor:
        """(E, B, T, fan in) -> (E, B, T, fan out)."""
        flat = torch.baddbmm(self._p[f"{name}_bias"], x.flatten(1, 2), self._p[f"{name}_weight"])
        return flat.view(*x.shape[:3], -1)

    def _attention(self, q: Tensor, k: Tensor, v: Tensor) -> Tensor:
        q, k, v = (x.reshape(*x.shape[:3], self._heads, -1).transpose(2, 3) for x in (q, k, v))  # (E, B, heads, T, D)
        return scaled_dot_product_attention(q, k, v, is_causal=True).transpose(2, 3).flatten(3)


def _normed(x: Tensor) -> Tensor:
    return layer_norm(x, x.shape[-1:])
