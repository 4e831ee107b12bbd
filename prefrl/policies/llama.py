"""One decoding step of a Llama, written out: a preallocated cache, fused projections, batched matrix products.

For small models on a CPU most of transformers' time per token is not arithmetic; this does the same arithmetic only.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import linear, silu
from transformers import Cache, LlamaForCausalLM, PreTrainedModel


class LlamaDecoder:
    """Tokens one by one, from the prompts' keys and values on. Reads the model's weights when it is made."""

    @staticmethod
    def fits(model: PreTrainedModel) -> bool:
        """Is this a plain Llama in float32, whose step is written out here?"""
        if type(model) is not LlamaForCausalLM or model.dtype != torch.float32:  # a subclass may compute something else
            return False
        config = model.config
        plain = config.hidden_act == "silu" and not config.attention_bias and not config.mlp_bias
        return bool(plain and (config.rope_parameters or {}).get("rope_type") == "default")

    def __init__(self, model: Any, cache: Cache, mask: Tensor, samples: int, room: int) -> None:
        """`cache` and `mask` (P, T): of left-padded prompts, each to be continued `samples` times by `room` steps."""
        config, inner = model.config, model.model
        self._heads, self._groups, self._eps = (
            config.num_attention_heads,
            config.num_key_value_heads,
            config.rms_norm_eps,
        )
        self._layers = [_Layer(layer) for layer in inner.layers]
        # The head takes the last norm's weight along, as each layer's matrices take that of the norm before them.
        self._embedding, self._head = inner.embed_tokens.weight, model.lm_head.weight * inner.norm.weight
        self._cache = [_roomy(layer, samples, room) for layer in cache.layers]
        self._at = mask.shape[1]  # the column that is written next, the same for all rows
        self._positions = mask.sum(1).repeat_interleave(samples)  # (B,): each row's own, padding not counted
        self._bias = _bias(mask, self._groups, samples, room, self._embedding.dtype)
        # (1, T + room, D): computed for every position at once; of the embedding only device and dtype are read.
        cos, sin = inner.rotary_emb(self._embedding, torch.arange(self._at + room, device=mask.device)[None])
        self._cos, self._sin = cos[0], sin[0]

    def step(self, tokens: Tensor) -> Tensor:
        x = self._embedding[tokens]  # (B, d)
        cos, sin = self._cos[self._positions][:, None], self._sin[self._positions][:, None]  # (B, 1, D)
        for layer, (keys, values) in zip(self._layers, self._cache, strict=True):
            q, k, v = self._project(linear(_normed(x, self._eps), layer.qkv), cos, sin)
            keys[:, self._at], values[:, self._at] = k, v  # in place, into room that was made for it
            x = x + linear(self._attend(q, keys, values), layer.out)
            gate, up = linear(_normed(x, self._eps), layer.gate_up).chunk(2, -1)
            x = x + linear(silu(gate) * up, layer.down)
        self._at += 1
        self._positions = self._positions + 1
        return linear(_normed(x, self._eps), self._head)

    def keep(self, rows: Tensor) -> None:
        self._positions = self._positions[rows]
        # The cache has a row for each group of heads, those of one sequence side by side.
        flat = (rows[:, None] * self._groups + torch.arange(self._groups, device=rows.device)).flatten()
        self._cache = [(keys[flat], values[flat]) for keys, values in self._cache]
        self._bias = self._bias[flat]

    def _project(self, qkv: Tensor, cos: Tensor, sin: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """(B, .) -> queries (B x G, heads of a group, D), keys and values (B x G, D); rotary where it belongs."""
        # (B, heads + 2 G, D): queries, keys, values. The first two turn, and are turned together.
        turning, v = qkv.view(len(qkv), self._heads + 2 * self._groups, -1).tensor_split([-self._groups], 1)
        half = turning.shape[-1] // 2
        turned = turning * cos + torch.cat([-turning[..., half:], turning[..., :half]], -1) * sin
        q, k = turned.tensor_split([self._heads], 1)
        size = q.shape[-1]
        return q.reshape(len(q) * self._groups, -1, size), k.reshape(-1, size), v.reshape(-1, size)

    def _attend(self, q: Tensor, keys: Tensor, values: Tensor) -> Tensor:
        end = self._at + 1
        # (B x G, heads of a group, D) and (B x G, end, D) -> (B x G, heads of a group, end). Nothing in the cache comes
        # later than the query, so padding is all there is to mask.
        scores = torch.bmm(q, keys[:, :end].transpose(1, 2)).add_(self._bias[:, :, :end])
        return torch.bmm(scores.softmax(-1), values[:, :end]).view(len(q) // self._groups, -1)  # (B, heads x D)


class _Layer:
    """A layer's weights, fused, with the norms' weights and the attention's scale multiplied in."""

    def __init__(self, layer: Any) -> None:
        attention, mlp = layer.self_attn, layer.mlp
        q = matrix(attention.q_proj) * attention.scaling
        qkv = torch.cat([q, matrix(attention.k_proj), matrix(attention.v_proj)])
        self.qkv = qkv * layer.input_layernorm.weight  # scales columns: W (n x) = (W n) x
        self.out = matrix(attention.o_proj)
        gate_up = torch.cat([matrix(mlp.gate_proj), matrix(mlp.up_proj)])
        self.gate_up = gate_up * layer.post_attention_layernorm.weight
        self.down = matrix(mlp.down_proj)


def matrix(layer: Any) -> Tensor:
    """(out, in): what a linear layer multiplies by, the products of its adapters added."""
    if isinstance(layer, torch.nn.Linear):
        return layer.weight
    active = () if layer.disable_adapters else layer.active_adapters  # peft's layer around a linear one
    found: Tensor = layer.get_base_layer().weight + sum(layer.get_delta_weight(name) for name in active)
    return found


def _normed(x: Tensor, eps: float) -> Tensor:
    """RMS norm without its weight, which is part of the matrix that follows."""
    return x * torch.rsqrt(x.pow(2).mean(-1, keepdim=True) + eps)


def _roomy(layer: Any, samples: int, room: int) -> tuple[Tensor, Tensor]:
    """A layer's (P, G, T, D) keys and values -> (P x K x G, T + room, D), each prompt's repeated for its samples."""
    found = []
    for x in (layer.keys, layer.values):
        prompts, groups, width, size = x.shape
        out = x.new_zeros(prompts, samples, groups, width + room, size)
        out[:, :, :, :width] = x[:, None]  # (P, 1, G, T, D), broadcast over samples
        found.append(out.view(-1, width + room, size))
    return found[0], found[1]


def _bias(mask: Tensor, groups: int, samples: int, room: int, dtype: torch.dtype) -> Tensor:
    """(P x K x G, 1, T + room): minus infinity on the prompts' padding, else 0."""
    bias = torch.zeros(len(mask), mask.shape[1] + room, dtype=dtype, device=mask.device)
    bias[:, : mask.shape[1]].masked_fill_(mask == 0, float("-inf"))
    return bias.repeat_interleave(samples * groups, 0)[:, None]
