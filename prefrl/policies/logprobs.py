"""How probable a language model finds the tokens of responses."""

from __future__ import annotations

import torch
from torch import Tensor
from transformers import PreTrainedModel

from prefrl.distributed import world
from prefrl.policies.exact import rows_of_embedding
from prefrl.policies.generate import tempered
from prefrl.policies.responses import Responses, pad_right


def response_logp(model: PreTrainedModel, responses: Responses, temperature: float, head_alone: bool = True) -> Tensor:
    """(B, L) float32 log-probabilities of the responses' tokens, differentiable; 0 on padding.

    Rows are padded on the right, where a causal model never looks: no attention mask and no position ids are needed.
    Where the logits are the head's output alone, it runs on the real tokens of the responses only.
    """
    rows, steps = responses.mask.nonzero(as_tuple=True)  # (n,), (n,): the n real tokens, row by row
    prompts, lengths = pad_right(responses.prompt_tokens, responses.mask.device)
    places = lengths[rows] + steps  # (n,): the column of each, after its prompt
    ids = prompts.new_zeros(len(responses), int(places.max()) + 1)  # padded with 0, which is a valid id
    ids[:, : prompts.shape[1]] = prompts
    chosen = responses.tokens[rows, steps]
    ids[rows, places] = chosen
    if head_alone:
        hidden = model.base_model(input_ids=ids, use_cache=False).last_hidden_state
        logits = head_logits(model, hidden[rows, places - 1])  # (n, V): the state before a token predicts it
    else:
        first = int(lengths.min()) - 1  # the first column whose logits are wanted
        kept = model(input_ids=ids, use_cache=False, logits_to_keep=ids.shape[1] - first).logits
        logits = kept[rows, places - 1 - first]
    # At the temperature of sampling, or the ratio is not 1 before the first step; in float32, whatever the model is.
    found = -torch.nn.functional.cross_entropy(tempered(logits, temperature), chosen, reduction="none")
    return found.new_zeros(responses.mask.shape).masked_scatter(responses.mask, found)  # (n,) -> (B, L), row by row


@torch.no_grad()
def all_logp(
    model: PreTrainedModel, responses: Responses, temperature: float, part: int, head_alone: bool = True
) -> Tensor:
    """`response_logp` without gradients, a part of the rows at a time; ranks share the rows."""
    found = torch.zeros(responses.mask.shape, device=responses.mask.device)[world().mine]
    if len(found):
        mine = responses if world().size == 1 else responses.rows(torch.arange(len(responses))[world().mine])
        for at, rows in mine.parts(part):
            # a part is cut to its longest row
            found[at, : rows.mask.shape[1]] = response_logp(model, rows, temperature, head_alone)
    return world().whole(found, len(responses))


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
