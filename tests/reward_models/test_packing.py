"""Packed rows: every row can be read back, what is shared is there once, and a model says the same of them."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from transformers import AutoConfig, AutoModel, PreTrainedModel

from prefrl.reward_models.packing import MODELS, final_states, pack, use_packed_attention

ROWS = [[5, 6, 7, 8], [5, 6, 7], [5, 6, 9, 9, 9], [1], [5, 6, 7, 8], [0, 0], [0]]


def padded(rows: list[list[int]], filler: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    width = max(map(len, rows))
    tokens = torch.tensor([[*row, *[filler] * (width - len(row))] for row in rows])
    return tokens, torch.tensor([len(row) for row in rows])


def model_of(kind: str) -> PreTrainedModel:
    sizes = {"hidden_size": 32, "num_hidden_layers": 3, "num_attention_heads": 4, "intermediate_size": 48}
    more = {"n_inner": 48} if kind == "gpt2" else {"num_key_value_heads": 2} if kind == "llama" else {}
    config = AutoConfig.for_model(kind, vocab_size=50, max_position_embeddings=40, pad_token_id=0, **sizes, **more)
    torch.manual_seed(0)
    model: PreTrainedModel = AutoModel.from_config(config)  # type: ignore[no-untyped-call]
    model.eval()  # type: ignore[no-untyped-call]
    return model


@given(st.lists(st.lists(st.integers(0, 2), min_size=1, max_size=6), min_size=1, max_size=8), st.integers(0, 2))
def test_every_row_is_there_and_every_beginning_once(rows: list[list[int]], filler: int) -> None:
    packed = pack(*padded(rows, filler))
    for row, places in zip(rows, packed.rows.tolist(), strict=True):
        at = places[: len(row)]
        assert packed.tokens[at].tolist() == row
        assert packed.positions[at].tolist() == list(range(len(row)))
    beginnings = {tuple(row[: i + 1]) for row in rows for i in range(len(row))}
    assert len(packed.tokens) == len(packed.positions) == len(beginnings)
    assert packed.rows.flatten()[packed.origin].tolist() == list(range(len(beginnings)))
    assert packed.tokens[packed.ends].tolist() == [row[-1] for row in rows]


@pytest.mark.parametrize("kind", MODELS)
def test_packed_rows_get_the_states_and_the_gradients_of_padded_ones(kind: str) -> None:
    plain, packing = model_of(kind), model_of(kind)
    use_packed_attention(packing)
    tokens, lengths = padded(ROWS)
    mask = (torch.arange(tokens.shape[1]) < lengths[:, None]).long()
    expected = plain(input_ids=tokens, attention_mask=mask).last_hidden_state[torch.arange(len(ROWS)), lengths - 1]
    found = final_states(packing, pack(tokens, lengths))
    torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)
    weights = torch.from_numpy(np.random.default_rng(0).normal(size=expected.shape)).float()
    (expected * weights).sum().backward()
    (found * weights).sum().backward()  # type: ignore[no-untyped-call]
    for one, other in zip(packing.parameters(), plain.parameters(), strict=True):
        torch.testing.assert_close(one.grad, other.grad, atol=1e-5, rtol=1e-4)


@pytest.mark.parametrize("kind", MODELS)
def test_bfloat16_products_stay_near(kind: str) -> None:
    model = model_of(kind)
    use_packed_attention(model)
    packed = pack(*padded(ROWS))
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        rough = final_states(model, packed).float()
    exact = final_states(copy.deepcopy(model), packed).detach()
    assert 0 < (rough - exact).abs().max() < 0.05 * exact.abs().max()
