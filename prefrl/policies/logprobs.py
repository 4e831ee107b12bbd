"""How probable a language model finds the tokens of responses."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import cross_entropy
from transformers import DynamicCache, PreTrainedModel

from prefrl.distributed import world
from prefrl.policies.exact import rows_of_embedding
from prefrl.policies.generate import ALONE, tempered
from prefrl.policies.pretrained import window_of
from prefrl.policies.responses import Responses, pad_right

ROUNDING = {torch.float32: 1e-4, torch.bfloat16: 0.1, torch.float16: 0.02}
"""Nats. By more than this no log-probability differs that was computed in another order."""


@dataclass(frozen=True)
class Shortcuts:
    """What an architecture allows, which makes its log-probabilities cheaper and changes them by rounding alone."""

    head_alone: bool = False
    """Logits are the head's output: it is run where they are wanted only."""
    prompts_once: bool = False
    """Responses go on from the keys and values of a prompt that was run once for all of them."""


@torch.no_grad()
def shortcuts_of(model: PreTrainedModel) -> Shortcuts:
    """What is found out by trying."""
    if not head_alone(model):
        return Shortcuts()
    vocabulary, chooser = rows_of_embedding(model), torch.Generator().manual_seed(0)
    drawn = [torch.randint(vocabulary, (length,), generator=chooser) for length in (3, 9, 6)]
    prompts = tuple(tuple(one.tolist()) for one in drawn for _ in range(2))
    tokens = torch.randint(vocabulary, (len(prompts), 6), generator=chooser).to(model.device)
    mask = torch.ones_like(tokens, dtype=torch.bool)
    rows = Responses(("",) * len(prompts), prompts, tokens, mask, mask.float(), mask[:, 0])
    apart = response_logp(model, rows, 1.0, Shortcuts(head_alone=True))
    try:
        shared = response_logp(model, rows, 1.0, Shortcuts(head_alone=True, prompts_once=True))
    except (RuntimeError, AttributeError, TypeError, ValueError, IndexError, KeyError):
        return Shortcuts(head_alone=True)  # there is no cache, or it cannot be handed on
    return Shortcuts(True, bool((apart - shared).abs().max() <= ROUNDING[model.dtype]))


def response_logp(
    model: PreTrainedModel, responses: Responses, temperature: float, shortcuts: Shortcuts = Shortcuts(head_alone=True)
) -> Tensor:
    """(B, L) float32 log-probabilities of the responses' tokens, differentiable; 0 on padding."""
    if shortcuts.head_alone:
        return logp_of_states(model, response_states(model, responses, shortcuts), responses, temperature)
    return _logp_of_logits(_logits(model, responses), responses, temperature)


def response_states(model: PreTrainedModel, responses: Responses, shortcuts: Shortcuts) -> Tensor:
    """(n, d) hidden states that predict the n real tokens, row by row, differentiable."""
    if shortcuts.prompts_once and responses.repeat_prompts and _within_window(model, responses):
        return _states_from_shared_prompts(model, responses)
    ids, rows, columns = _rows_with_prompts(responses)
    hidden: Tensor = model.base_model(input_ids=ids, use_cache=False).last_hidden_state
    return hidden[rows, columns]


def logp_of_states(model: PreTrainedModel, states: Tensor, responses: Responses, temperature: float) -> Tensor:
    """`response_logp` from `response_states`, of a model whose logits are its head's output."""
    return _logp_of_logits(head_logits(model, states), responses, temperature)


def all_logp(
    model: PreTrainedModel,
    responses: Responses,
    temperature: float,
    part: int,
    shortcuts: Shortcuts,
    running: AbstractContextManager[None] = ALONE,
) -> Tensor:
    """`response_logp` without gradients, a part of the rows at a time; ranks share the rows.

    `running`: what surrounds the passes of this rank.
    """
    return in_all_rows(lambda rows: response_logp(model, rows, temperature, shortcuts), responses, part, running)


@torch.no_grad()
def in_all_rows(
    compute: Callable[[Responses], Tensor],
    responses: Responses,
    part: int,
    running: AbstractContextManager[None] = ALONE,
) -> Tensor:
    """(B, L) of what is computed for (b, l) tokens, without gradients, a part of the rows at a time; ranks share the
    rows."""
    found = torch.zeros(responses.mask.shape, device=responses.mask.device)[world().mine]
    with running:
        if len(found):
            mine = responses if world().size == 1 else responses.rows(torch.arange(len(responses))[world().mine])
            for at, rows in mine.parts(part):
                # a part is cut to its longest row
                found[at, : rows.mask.shape[1]] = compute(rows)
    return world().whole(found, len(responses))


def _logp_of_logits(logits: Tensor, responses: Responses, temperature: float) -> Tensor:
    mask = responses.mask
    # At the temperature of sampling, or the ratio is not 1 before the first step; in float32, whatever the model is.
    found = -cross_entropy(tempered(logits, temperature), responses.tokens[mask], reduction="none")
    return found.new_zeros(mask.shape).masked_scatter(mask, found)  # (n,) -> (B, L), row by row


def _logits(model: PreTrainedModel, responses: Responses) -> Tensor:
    """(n, V) logits of the n real tokens, row by row."""
    ids, rows, columns = _rows_with_prompts(responses)
    first = int(columns.min())  # whose logits are wanted
    kept: Tensor = model(input_ids=ids, use_cache=False, logits_to_keep=ids.shape[1] - first).logits
    return kept[rows, columns - first]


def _rows_with_prompts(responses: Responses) -> tuple[Tensor, Tensor, Tensor]:
    """(B, T) tokens, each row with its own prompt, and the rows (n,) and columns (n,) of what predicts each real token.

    Rows are padded on the right, where a causal model never looks: no attention mask and no position ids are needed.
    """
    rows, steps = responses.mask.nonzero(as_tuple=True)  # (n,), (n,)
    prompts, lengths = pad_right(responses.prompt_tokens, responses.mask.device)
    places = lengths[rows] + steps  # (n,): the column of each, after its prompt
    ids = prompts.new_zeros(len(responses), int(places.max()) + 1)  # padded with 0, which is a valid id
    ids[:, : prompts.shape[1]] = prompts
    ids[rows, places] = responses.tokens[rows, steps]
    return ids, rows, places - 1  # the state before a token predicts it


def _states_from_shared_prompts(model: PreTrainedModel, responses: Responses) -> Tensor:
    """(n, d) hidden states that predict the n real tokens, row by row, each distinct prompt run once.

    Prompts are padded on the right as well: no real token of theirs looks there, and those of responses are kept from
    it by a mask. Gradients of all responses to a prompt meet in its keys and values.
    """
    known: dict[tuple[int, ...], int] = {}
    of = [known.setdefault(prompt, len(known)) for prompt in responses.prompt_tokens]
    prompts, lengths = pad_right(list(known), responses.mask.device)  # (U, T), (U,)
    own = torch.tensor(of, device=prompts.device)  # (B,): which prompt
    cache = DynamicCache(config=model.config)
    opened: Tensor = model.base_model(input_ids=prompts, past_key_values=cache, use_cache=True).last_hidden_state
    before = opened[torch.arange(len(known), device=own.device), lengths - 1][own, None]  # (B, 1, d)
    said = responses.tokens[:, :-1]  # what the last token leads to, nobody asks
    if not said.shape[1]:
        return before[responses.mask]
    cache.batch_select_indices(own)
    padding = torch.arange(prompts.shape[1], device=own.device) < lengths[own, None]
    hidden: Tensor = model.base_model(
        input_ids=said,
        attention_mask=torch.cat([padding.long(), torch.ones_like(said)], 1),
        position_ids=lengths[own, None] + torch.arange(said.shape[1], device=own.device),
        past_key_values=cache,
        use_cache=True,
    ).last_hidden_state
    return torch.cat([before, hidden], 1)[responses.mask]


def _within_window(model: PreTrainedModel, responses: Responses) -> bool:
    """Whether every token sees all before it: windows are counted in columns, padding included."""
    window = window_of(model)
    return window is None or max(map(len, responses.prompt_tokens)) + responses.mask.shape[1] <= window


def head_logits(model: PreTrainedModel, hidden: Tensor) -> Tensor:
    """The language model's head, on hidden states of any shape (..., d)."""
    head = model.get_output_embeddings()  # type: ignore[no-untyped-call]
    logits: Tensor = head(hidden)
    return logits


@torch.no_grad()
def head_alone(model: PreTrainedModel) -> bool:
    """Whether a model's logits are its head's output, and nothing is done to them (soft caps, scales)."""
    ids = torch.arange(8, device=model.device)[None] * 7919 % rows_of_embedding(model)  # tokens that are far apart
    direct = model(input_ids=ids, use_cache=False).logits
    ours = head_logits(model, model.base_model(input_ids=ids, use_cache=False).last_hidden_state)
    # Hardly a cap shows on small logits: the bits must be the same, or nearly.
    return bool((direct - ours).abs().max() <= 1e-6 * direct.abs().max())
