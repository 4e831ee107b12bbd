"""One decoding step of a transformer, written out: a preallocated cache, fused projections, batched matrix products.

For small models on a CPU most of transformers' time per token is not arithmetic; this does the same arithmetic only.
It knows the shapes of Llama, Mistral, Qwen, Phi, GPT-2 and GPT-NeoX, in float32.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, TypeAlias

import torch
from torch import Tensor
from torch.nn.functional import layer_norm, linear
from transformers import (
    Cache,
    GPT2LMHeadModel,
    GPTNeoXForCausalLM,
    LlamaForCausalLM,
    MistralForCausalLM,
    PhiForCausalLM,
    PreTrainedModel,
    Qwen2ForCausalLM,
    Qwen3ForCausalLM,
)

from prefrl.policies.pretrained import window_of

Module: TypeAlias = Any
"""A part of a model of transformers, whose parts have no types."""


@dataclass(frozen=True)
class Affine:
    """x -> W x + b."""

    weight: Tensor
    """(out, in)."""
    bias: Tensor | None = None

    def __call__(self, x: Tensor, beside: Tensor | None = None) -> Tensor:
        """`beside`: what the result is added to, where there is no bias to add."""
        if beside is None:
            return linear(x, self.weight, self.bias)
        return torch.addmm(beside if self.bias is None else beside + self.bias, x, self.weight.T)


@dataclass(frozen=True)
class Layer:
    """A layer's weights, fused, with those of the norms before them multiplied in."""

    qkv: Affine
    """Queries, scaled for attention, then keys, then values."""
    out: Affine
    up: Affine
    """Gate and values where the perceptron is gated."""
    down: Affine
    head_norms: tuple[Tensor, Tensor] | None = None
    """Weights of norms over each query, scaled, and each key."""


@dataclass(frozen=True)
class Plan:
    """What a model computes for one token."""

    heads: int
    groups: int
    """Heads of keys and values."""
    eps: float
    act: Callable[[Tensor], Tensor]
    layers: tuple[Layer, ...]
    embedding: Tensor
    norm: Module
    """Before the head, which is too large to be multiplied with its weight."""
    head: Affine
    rms: bool = False
    """Norms divide by the root mean square; else they centre as well."""
    gated: bool = False
    parallel: bool = False
    """Attention and perceptron read the same input, and are added to it together."""
    places: Tensor | None = None
    """(T, d) learned positions, or None where positions turn queries and keys."""
    rotary: Module = None


@torch.no_grad()
def plan(model: PreTrainedModel, length: int) -> Plan | None:
    """How a model decodes within `length` tokens; None where that is not written out here."""
    make = PLANS.get(type(model))  # a subclass may compute something else
    if make is None or model.dtype != torch.float32:
        return None
    config: Module = model.config
    rope = getattr(config, "rope_parameters", None) or {"rope_type": "default"}
    window = window_of(model)
    if rope.get("rope_type", "default") != "default" or (window is not None and length > window):
        return None
    return make(model)


class FastDecoder:
    """Tokens one by one, from the prompts' keys and values on. Reads the model's weights when it is made."""

    joins = True

    def __init__(self, plan: Plan, cache: Cache, mask: Tensor, samples: int, room: int) -> None:
        """`cache` and `mask` (P, T): of left-padded prompts, each to be continued `samples` times by `room` steps."""
        self._plan = plan
        self._cache = [_roomy(layer, samples, room) for layer in cache.layers]
        self._room = room
        self._at = mask.shape[1]  # the column that is written next, the same for all rows
        self._positions = mask.sum(1).repeat_interleave(samples)  # (B,): each row's own, padding not counted
        self._bias = _bias(mask, plan.groups, samples, room, plan.embedding.dtype)
        if plan.rotary is not None:
            # (1, T + room, R): computed for every position at once; of the embedding only device and dtype are read.
            cos, sin = plan.rotary(plan.embedding, torch.arange(self._at + room, device=mask.device)[None])
            self._cos, self._sin = cos[0], sin[0]
            self._sin[:, : self._sin.shape[1] // 2] *= -1  # of the half that is turned towards minus the other

    def step(self, tokens: Tensor) -> Tensor:
        plan = self._plan
        x = plan.embedding[tokens]  # (B, d)
        if plan.places is not None:
            x = x + plan.places[self._positions]
        turns = (
            None if plan.rotary is None else (self._cos[self._positions][:, None], self._sin[self._positions][:, None])
        )
        for layer, (keys, values) in zip(plan.layers, self._cache, strict=True):
            normed = self._normed(x)
            q, k, v = self._project(layer, layer.qkv(normed), turns)
            keys[:, self._at], values[:, self._at] = k, v  # in place, into room that was made for it
            x = layer.out(self._attend(q, keys, values), x)
            x = self._perceptron(layer, normed if plan.parallel else self._normed(x), x)
        self._at += 1
        self._positions = self._positions + 1
        return plan.head(plan.norm(x))

    def keep(self, rows: Tensor) -> None:
        self._positions = self._positions[rows]
        # The cache has a row for each group of heads, those of one sequence side by side.
        groups = self._plan.groups
        flat = (rows[:, None] * groups + torch.arange(groups, device=rows.device)).flatten()
        self._cache = [(keys[flat], values[flat]) for keys, values in self._cache]
        self._bias = self._bias[flat]

    def join(self, other: FastDecoder) -> None:
        positions = torch.cat([self._positions, other._positions])
        longest, room = int(positions.max()), max(self._room, other._room)

        def behind(mine: Tensor, others: Tensor) -> Tensor:
            """(., T, D) columns that are written, the last `longest` of both, and room."""
            out = mine.new_zeros(len(mine) + len(others), longest + room, mine.shape[2])
            written = [right(x[:, :end], longest, 1) for x, end in ((mine, self._at), (others, other._at))]
            torch.cat(written, out=out[:, :longest])
            return out

        layers = zip(self._cache, other._cache, strict=True)
        self._cache = [(behind(k, new_k), behind(v, new_v)) for (k, v), (new_k, new_v) in layers]
        # Rows end at the same column, and each has as many real ones as tokens.
        padding = torch.arange(longest + room, device=positions.device) < longest - positions[:, None]
        bias = torch.zeros(padding.shape, dtype=self._bias.dtype, device=positions.device)
        bias = bias.masked_fill_(padding, float("-inf"))
        self._bias = bias.repeat_interleave(self._plan.groups, 0)[:, None]
        self._at, self._positions, self._room = longest, positions, room
        if self._plan.rotary is not None and len(other._cos) > len(self._cos):
            self._cos, self._sin = other._cos, other._sin

    def _normed(self, x: Tensor) -> Tensor:
        """Without weight and bias, which are part of the matrix that follows."""
        if self._plan.rms:
            return _root_normed(x, self._plan.eps)
        return layer_norm(x, x.shape[-1:], eps=self._plan.eps)

    def _perceptron(self, layer: Layer, normed: Tensor, x: Tensor) -> Tensor:
        """x and what the perceptron makes of `normed`."""
        if not self._plan.gated:
            return layer.down(self._plan.act(layer.up(normed)), x)
        gate, up = layer.up(normed).chunk(2, -1)
        return layer.down(self._plan.act(gate) * up, x)

    def _project(self, layer: Layer, qkv: Tensor, turns: tuple[Tensor, Tensor] | None) -> tuple[Tensor, Tensor, Tensor]:
        """(B, .) -> queries (B x G, heads of a group, D), keys and values (B x G, D); rotary where it belongs."""
        plan = self._plan
        # (B, heads + 2 G, D): queries, keys, values. The first two turn, and are turned together.
        turning, v = qkv.view(len(qkv), plan.heads + 2 * plan.groups, -1).tensor_split([-plan.groups], 1)
        if layer.head_norms is not None:
            q, k = _root_normed(turning, plan.eps).tensor_split([plan.heads], 1)
            turning = torch.cat([q * layer.head_norms[0], k * layer.head_norms[1]], 1)
        if turns is not None:
            turning = _turned(turning, *turns)
        q, k = turning.tensor_split([plan.heads], 1)
        size = q.shape[-1]
        return q.reshape(len(q) * plan.groups, -1, size), k.reshape(-1, size), v.reshape(-1, size)

    def _attend(self, q: Tensor, keys: Tensor, values: Tensor) -> Tensor:
        end = self._at + 1
        # (B x G, heads of a group, D) and (B x G, end, D) -> (B x G, heads of a group, end). Nothing in the cache comes
        # later than the query, so padding is all there is to mask.
        scores = torch.baddbmm(self._bias[:, :, :end], q, keys[:, :end].transpose(1, 2))
        return torch.bmm(scores.softmax(-1), values[:, :end]).view(len(q) // self._plan.groups, -1)  # (B, heads x D)


def _root_normed(x: Tensor, eps: float) -> Tensor:
    # Half the time of torch's rms_norm, which goes through x several times on a CPU.
    root = torch.linalg.vector_norm(x, dim=-1, keepdim=True)
    return x * torch.addcmul(root.new_full((), eps), root, root, value=1 / x.shape[-1]).rsqrt_()


def _turned(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Rotary positions (Su et al. 2021) on the first R of D dimensions, whose halves turn together; `sin` is negative
    for the first half."""
    width = cos.shape[-1]
    turning, rest = x[..., :width], x[..., width:]
    half = width // 2
    turned = torch.addcmul(turning * cos, torch.cat([turning[..., half:], turning[..., :half]], -1), sin)
    return torch.cat([turned, rest], -1) if rest.shape[-1] else turned


def _roomy(layer: Module, samples: int, room: int) -> tuple[Tensor, Tensor]:
    """A layer's (P, G, T, D) keys and values -> (P x K x G, T + room, D), each prompt's repeated for its samples."""
    found = []
    for x in (layer.keys, layer.values):
        prompts, groups, width, size = x.shape
        out = x.new_zeros(prompts, samples, groups, width + room, size)
        out[:, :, :, :width] = x[:, None]  # (P, 1, G, T, D), broadcast over samples
        found.append(out.view(-1, width + room, size))
    return found[0], found[1]


def right(x: Tensor, width: int, dim: int) -> Tensor:
    """Its last `width` columns along a dimension, padded with 0 on the left where there are fewer."""
    have = x.shape[dim]
    if have >= width:
        return x.narrow(dim, have - width, width)
    missing = x.new_zeros(*x.shape[:dim], width - have, *x.shape[dim + 1 :])
    return torch.cat([missing, x], dim)


def _bias(mask: Tensor, groups: int, samples: int, room: int, dtype: torch.dtype) -> Tensor:
    """(P x K x G, 1, T + room): minus infinity on the prompts' padding, else 0."""
    bias = torch.zeros(len(mask), mask.shape[1] + room, dtype=dtype, device=mask.device)
    bias[:, : mask.shape[1]].masked_fill_(mask == 0, float("-inf"))
    return bias.repeat_interleave(samples * groups, 0)[:, None]


# --- the shapes ----------------------------------------------------------------------------------------------------


def affine(layer: Module) -> Affine:
    """A linear layer, the products of its adapters added. GPT-2's keep their matrix the other way round."""
    base: Module = dict(layer.named_children()).get("base_layer", layer)  # peft's layer around a linear one has it
    weight = base.weight
    if base is not layer and not layer.disable_adapters:
        weight = weight + sum(layer.get_delta_weight(name) for name in layer.active_adapters)
    return Affine(weight if isinstance(base, torch.nn.Linear) else weight.T, base.bias)


def fused(*parts: Affine, after: Module = None) -> Affine:
    """Several maps of one input, one below the other.

    `after` a norm they take what it gives before its own weight n and bias c: W (n x + c) + b = (W n) x + (W c + b).
    """
    sizes, width = [len(part.weight) for part in parts], parts[0].weight.shape[1]
    # In memory as (in, out): a product with few rows is a sixth faster so.
    matrix = parts[0].weight.new_empty(width, sum(sizes))
    for part, columns in zip(parts, matrix.split(sizes, 1), strict=True):  # type: ignore[no-untyped-call]
        torch.mul(part.weight.T, 1.0 if after is None else after.weight[:, None], out=columns)
    shift = None if after is None else getattr(after, "bias", None)  # an RMS norm has none
    return Affine(matrix.T, _fused_bias(parts, shift))


def _fused_bias(parts: Sequence[Affine], shift: Tensor | None) -> Tensor | None:
    if shift is None and all(part.bias is None for part in parts):
        return None
    biases = [part.weight.new_zeros(len(part.weight)) if part.bias is None else part.bias for part in parts]
    return torch.cat([b if shift is None else part.weight @ shift + b for part, b in zip(parts, biases, strict=True)])


def scaled(part: Affine, by: float) -> Affine:
    return Affine(part.weight * by, None if part.bias is None else part.bias * by)


def _llama(model: Module) -> Plan:
    """Llama, Mistral, Qwen 2 and Qwen 3, which differ in biases and in norms over the heads."""
    config, inner = model.config, model.model
    return Plan(
        heads=config.num_attention_heads,
        groups=config.num_key_value_heads,
        eps=config.rms_norm_eps,
        rms=True,
        gated=True,
        act=inner.layers[0].mlp.act_fn,
        layers=tuple(_llama_layer(layer) for layer in inner.layers),
        embedding=inner.embed_tokens.weight,
        norm=inner.norm,
        head=affine(model.lm_head),
        rotary=inner.rotary_emb,
    )


def _llama_layer(layer: Module) -> Layer:
    attention, mlp = layer.self_attn, layer.mlp
    norms = (attention.q_norm.weight * attention.scaling, attention.k_norm.weight) if _norms_heads(attention) else None
    q = affine(attention.q_proj)
    q = q if norms else scaled(q, attention.scaling)  # a norm would undo it
    qkv = fused(q, affine(attention.k_proj), affine(attention.v_proj), after=layer.input_layernorm)
    up = fused(affine(mlp.gate_proj), affine(mlp.up_proj), after=layer.post_attention_layernorm)
    return Layer(qkv, fused(affine(attention.o_proj)), up, fused(affine(mlp.down_proj)), norms)


def _norms_heads(attention: torch.nn.Module) -> bool:
    return "q_norm" in dict(attention.named_children())


def _phi(model: Module) -> Plan | None:
    config, inner = model.config, model.model
    if config.qk_layernorm:
        return None
    return Plan(
        heads=config.num_attention_heads,
        groups=config.num_key_value_heads,
        eps=config.layer_norm_eps,
        parallel=True,
        act=inner.layers[0].mlp.activation_fn,
        layers=tuple(_phi_layer(layer) for layer in inner.layers),
        embedding=inner.embed_tokens.weight,
        norm=inner.final_layernorm,
        head=affine(model.lm_head),
        rotary=inner.rotary_emb,
    )


def _phi_layer(layer: Module) -> Layer:
    attention, norm = layer.self_attn, layer.input_layernorm
    q, k, v = (affine(attention.get_submodule(name)) for name in ("q_proj", "k_proj", "v_proj"))
    qkv, up = fused(scaled(q, attention.scaling), k, v, after=norm), fused(affine(layer.mlp.fc1), after=norm)
    return Layer(qkv, fused(affine(attention.dense)), up, fused(affine(layer.mlp.fc2)))


def _gpt_neox(model: Module) -> Plan:
    config, inner = model.config, model.gpt_neox
    return Plan(
        heads=config.num_attention_heads,
        groups=config.num_attention_heads,
        eps=config.layer_norm_eps,
        parallel=config.use_parallel_residual,
        act=inner.layers[0].mlp.act,
        layers=tuple(_gpt_neox_layer(layer, config.num_attention_heads) for layer in inner.layers),
        embedding=inner.embed_in.weight,
        norm=inner.final_layer_norm,
        head=affine(model.get_output_embeddings()),
        rotary=inner.rotary_emb,
    )


def _gpt_neox_layer(layer: Module, heads: int) -> Layer:
    attention, whole = layer.attention, affine(layer.attention.query_key_value)
    # (heads x 3 x D, d): each head's query, key and value stand together -> all queries, all keys, all values.
    weight = whole.weight.view(heads, 3, -1, whole.weight.shape[1]).transpose(0, 1).flatten(0, 2)
    bias = None if whole.bias is None else whole.bias.view(heads, 3, -1).transpose(0, 1).flatten()
    qkv = fused(_scaled_queries(Affine(weight, bias), attention.scaling), after=layer.input_layernorm)
    up = fused(affine(layer.mlp.dense_h_to_4h), after=layer.post_attention_layernorm)
    return Layer(qkv, fused(affine(attention.dense)), up, fused(affine(layer.mlp.dense_4h_to_h)))


def _gpt2(model: Module) -> Plan | None:
    config, inner = model.config, model.transformer
    if config.scale_attn_by_inverse_layer_idx or config.add_cross_attention:
        return None
    return Plan(
        heads=config.num_attention_heads,
        groups=config.num_attention_heads,
        eps=config.layer_norm_epsilon,
        act=inner.h[0].mlp.act,
        layers=tuple(_gpt2_layer(layer) for layer in inner.h),
        embedding=inner.wte.weight,
        norm=inner.ln_f,
        head=affine(model.lm_head),
        places=inner.wpe.weight,
    )


def _gpt2_layer(layer: Module) -> Layer:
    qkv = fused(_scaled_queries(affine(layer.attn.c_attn), layer.attn.scaling), after=layer.ln_1)
    up = fused(affine(layer.mlp.c_fc), after=layer.ln_2)
    return Layer(qkv, fused(affine(layer.attn.c_proj)), up, fused(affine(layer.mlp.c_proj)))


def _scaled_queries(qkv: Affine, by: float) -> Affine:
    """Queries, keys and values of one size, the first of them scaled."""
    third = len(qkv.weight) // 3
    factor = torch.ones(len(qkv.weight), device=qkv.weight.device)
    factor[:third] = by
    return Affine(qkv.weight * factor[:, None], None if qkv.bias is None else qkv.bias * factor)


PLANS: dict[type[PreTrainedModel], Callable[[Module], Plan | None]] = {
    LlamaForCausalLM: _llama,
    MistralForCausalLM: _llama,
    Qwen2ForCausalLM: _llama,
    Qwen3ForCausalLM: _llama,
    PhiForCausalLM: _phi,
    GPT2LMHeadModel: _gpt2,
    GPTNeoXForCausalLM: _gpt_neox,
}
