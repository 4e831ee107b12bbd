"""Rows of tokens without padding: what several rows begin with is computed once, and each token takes part once.

A causal model's state at a token hangs on the tokens up to it alone, so rows that begin alike share those states: the
responses to one prompt pay for it once.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import embedding, scaled_dot_product_attention
from transformers import AttentionInterface, PreTrainedModel

from prefrl.seeding import to_numpy
from prefrl.types import Integers

ATTENTION = "prefrl_packed"
MODELS = ("gpt2", "gpt_neox", "llama")
"""Architectures in which a state hangs on tokens, positions and plain causal attention; tested against padded rows."""


@dataclass(frozen=True, eq=False)
class Packed:
    """N right-padded rows as P distinct beginnings, each named by its last token."""

    tokens: Tensor
    """(P,) int64."""
    positions: Tensor
    """(P,) int64: each one's place in its row."""
    rows: Tensor
    """(N, L) int64: which of the P stands at each place; 0 where there is padding."""
    origin: Tensor
    """(P,) int64: a place among the N x L where each of the P is found."""
    lengths: Tensor
    """(N,) int64."""

    @property
    def ends(self) -> Tensor:
        """(N,) int64: which of the P is each row's last token."""
        return self.rows[torch.arange(len(self.rows), device=self.rows.device), self.lengths - 1]


def pack(tokens: Tensor, lengths: Tensor) -> Packed:
    """Rows (N, L) with their lengths (N,), right-padded with anything."""
    counts, width = to_numpy(lengths), int(lengths.max())
    real = np.arange(width) < counts[:, None]
    values = np.where(real, to_numpy(tokens)[:, :width], -1)  # no token, so that what pads is like nothing real
    order = np.lexsort(values.T[::-1])  # lexsort's last key counts most, so the first token must come last
    source = np.empty_like(values)
    # (N, L): of the rows that begin alike up to a place, the one that is computed for all of them.
    source[order] = order[_first_alike(values[order])]
    fresh = real & (source == np.arange(len(values))[:, None])
    numbers = np.cumsum(fresh).reshape(fresh.shape) - 1  # (N, L): what a fresh place is counted as among the P
    rows = np.where(real, np.take_along_axis(numbers, source, 0), 0)
    origin = np.flatnonzero(fresh)
    arrays = (values[fresh], origin % width, rows, origin, counts)
    return Packed(*(torch.from_numpy(x).to(tokens.device) for x in arrays))


def _first_alike(values: Integers) -> Integers:
    """(N, L) sorted rows -> (N, L): the first row of those that have the same tokens up to each place."""
    alike = np.logical_and.accumulate(values[1:] == values[:-1], 1)  # like the row before, up to each place
    starts = np.where(alike, 0, np.arange(1, len(values))[:, None])
    # Sorted rows that begin alike are neighbours, so the newest start above is that of the group.
    return np.maximum.accumulate(np.concatenate([np.zeros_like(values[:1]), starts]), 0)


def use_packed_attention(model: PreTrainedModel) -> None:
    """Have a model's layers attend within packed rows."""
    AttentionInterface.register(ATTENTION, attend_packed)
    model.set_attn_implementation(ATTENTION)


def final_states(model: PreTrainedModel, packed: Packed) -> Tensor:
    """(N, d): the model's output at the last token of each row."""
    if model.config.model_type == "llama":
        return _llama_final_states(model, packed)
    hidden: Tensor = model(
        input_ids=packed.tokens[None], position_ids=packed.positions[None], use_cache=False, packed=packed
    ).last_hidden_state
    return hidden[0, packed.ends]


def attend_packed(
    module: torch.nn.Module,
    query: Tensor,
    key: Tensor,
    value: Tensor,
    attention_mask: Tensor | None,
    *,
    packed: Packed,
    scaling: float | None = None,
    **_: Any,
) -> tuple[Tensor, None]:
    """Causal attention within each row: query, key and value (1, heads, P, D) -> (1, P, heads, D).

    Always float32: on a CPU that is faster than bfloat16, and the gradients of shared tokens add up exactly.
    """
    with torch.autocast(query.device.type, enabled=False):
        q, k, v = (_spread(x[0].transpose(0, 1), packed.rows) for x in (query, key, value))
        grouped = q.shape[1] != k.shape[1]
        # Padding is on the right, where causal attention never looks from a real token.
        found = scaled_dot_product_attention(q, k, v, is_causal=True, scale=scaling, enable_gqa=grouped)
        flat = found.transpose(1, 2).flatten(0, 1)  # (N, heads, L, D) -> (N L, heads, D)
        picked = embedding(packed.origin, flat.flatten(1))  # (P, heads D): each beginning from one of its places
    return picked.view(1, -1, *flat.shape[1:]).to(value.dtype), None


def _spread(x: Tensor, rows: Tensor) -> Tensor:
    """(P, heads, D) -> (N, heads, L, D). An embedding, for its backward pass is the fast one."""
    return embedding(rows, x.flatten(1).float()).view(*rows.shape, *x.shape[1:]).transpose(1, 2)


def _llama_final_states(model: Any, packed: Packed) -> Tensor:
    """The same for a Llama; its last layer works at the last tokens alone, for only they are looked at."""
    x = model.embed_tokens(packed.tokens[None])
    turns = model.rotary_emb(x, position_ids=packed.positions[None])
    for layer in model.layers[:-1]:
        x = layer(x, position_embeddings=turns, packed=packed)
    final: Tensor = model.norm(_last_layer(model.layers[-1], x[0], (turns[0][0], turns[1][0]), packed))
    return final


def _last_layer(layer: Any, x: Tensor, turns: tuple[Tensor, Tensor], packed: Packed) -> Tensor:
    """(P, d) -> (N, d): keys and values of all tokens, everything else at the ends."""
    attention, ends = layer.self_attn, packed.ends
    normed = layer.input_layernorm(x)
    k, v = (project(normed).view(len(x), -1, attention.head_dim) for project in (attention.k_proj, attention.v_proj))
    q = attention.q_proj(normed[ends]).view(len(ends), -1, attention.head_dim)
    cos, sin = (turn[:, None] for turn in turns)
    # Only the last tokens ask, but every token of their rows answers.
    found = _attend_from_ends(_turn(q, cos[ends], sin[ends]), _turn(k, cos, sin), v, packed, attention.scaling)
    x = x[ends] + attention.o_proj(found.to(v.dtype))
    added: Tensor = layer.mlp(layer.post_attention_layernorm(x))
    return x + added


def _attend_from_ends(q: Tensor, k: Tensor, v: Tensor, packed: Packed, scaling: float) -> Tensor:
    """One query (heads, D) a row: (N, heads, D), (P, groups, D), (P, groups, D) -> (N, heads x D)."""
    # No causal mask here, since the last token sees its whole row: padding is masked instead.
    real = torch.arange(packed.rows.shape[1], device=packed.rows.device) < packed.lengths[:, None]
    with torch.autocast(q.device.type, enabled=False):
        keys, values, grouped = _spread(k, packed.rows), _spread(v, packed.rows), q.shape[1] != k.shape[1]
        found = scaled_dot_product_attention(
            q[:, :, None].float(), keys, values, attn_mask=real[:, None, None], scale=scaling, enable_gqa=grouped
        )
    return found.flatten(1)


def _turn(x: Tensor, cos: Tensor, sin: Tensor) -> Tensor:
    """Rotary positions (Su et al. 2021) in the order of transformers: the halves of a head turn together."""
    half = x.shape[-1] // 2
    return x * cos + torch.cat([-x[..., half:], x[..., :half]], -1) * sin
