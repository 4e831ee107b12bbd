"""The network under a text reward model: where it comes from, which tokens it reads, what a fit may change in it."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from jinja2 import TemplateError
from torch import Tensor
from transformers import AutoModel, PreTrainedModel, PreTrainedTokenizerBase
from transformers.models.auto.modeling_auto import MODEL_FOR_MASKED_LM_MAPPING_NAMES

from prefrl.components import ConfigError
from prefrl.exchange.transcripts import prompt_messages, response_messages
from prefrl.policies.pretrained import beginning, context_of, first_line, load_tokenizer, load_weights
from prefrl.protocols import TextTask
from prefrl.reward_models.packing import MODELS, final_states, pack, use_packed_attention
from prefrl.seeding import to_numpy
from prefrl.types import Response

Train = Literal["full", "lora", "head"]
Pool = Literal["last", "first", "mean", "own"]
BUCKET = 16
"""Rows of like length that share a padded pass, where a model cannot be packed."""


@dataclass(frozen=True, eq=False)
class Backbone:
    """A transformer without its last layer, and how responses become its tokens."""

    model: PreTrainedModel
    """In evaluation mode, so without dropout, in fits as well."""
    tokenizer: PreTrainedTokenizerBase
    ends: tuple[int, ...]
    """The policy's end tokens: what a response that has ended has last."""
    opened: Callable[[str], Sequence[int]] | None
    """A prompt's tokens as the policy reads it, where sampled tokens are read as they are; None where the text is
    encoded anew."""
    width: int
    """Of what the heads see."""
    pool: Pool = "last"
    """`own`: an encoder's classifier pools as it was made to, and the heads see what its last layer was given."""
    head: str = ""
    """With `own`, the path of that layer, which is now the identity."""
    chat: bool = False
    """Whether prompt and response are put into the tokenizer's chat template."""

    @property
    def context(self) -> int | None:
        """The most tokens that the model has positions for."""
        known = [context_of(self.model)]
        known += _after_padding(self.model)
        if self.opened is None:
            known.append(self.tokenizer.model_max_length)
        return min((int(n) for n in known if n), default=None)

    def rows(self, candidates: Sequence[Response]) -> list[list[int]]:
        """Tokens of prompt and response. Raises ValueError for a candidate that has none, or more than fit."""
        rows, context = [self._encode(c) for c in candidates], self.context
        for row, candidate in zip(rows, candidates, strict=True):
            if not row:
                raise ValueError(f"candidate {candidate.id[:12]} has no tokens: expected a prompt or a response")
            if context is not None and len(row) > context:
                raise ValueError(
                    f"candidate {candidate.id[:12]}{beginning(candidate.prompt)} has {len(row)} tokens, but the "
                    f"reward's backbone has a context of {context}: leave it out of what is imported, or choose a "
                    "reward.backbone with a longer context"
                )
        return rows

    def states(self, tokens: Tensor, lengths: Tensor) -> Tensor:
        """(N, L) right-padded rows with their lengths (N,) -> (N, d) what the heads see."""
        if self.model.config.model_type in MODELS:
            return final_states(self.model, pack(tokens, lengths))
        # Rows of like length share a pass, and are put back in their order by the inverse permutation.
        order = lengths.argsort()
        parts = [self._padded_states(tokens[part], lengths[part]) for part in torch.split(order, BUCKET)]
        return torch.cat(parts)[order.argsort()]

    def _padded_states(self, tokens: Tensor, lengths: Tensor) -> Tensor:
        tokens = tokens[:, : int(lengths.max())]  # a part needs no more columns than its longest row
        mask = torch.arange(tokens.shape[1], device=tokens.device) < lengths[:, None]
        found = self.model(input_ids=tokens, attention_mask=mask.long())
        # Of a classifier whose last layer is the identity, the logits (n, d) are what that layer was given.
        hidden: Tensor = found.logits if self.pool == "own" else found.last_hidden_state
        if self.pool == "own":
            return hidden
        if self.pool == "mean":
            return (hidden * mask[:, :, None]).sum(1) / lengths[:, None]  # (n, L, d) -> (n, d), padding left out
        # By length, not by looking for padding: where padding is the end token, a search finds the wrong place.
        return hidden[torch.arange(len(tokens), device=tokens.device), lengths - 1 if self.pool == "last" else 0]

    def _encode(self, response: Response) -> list[int]:
        """As sampled, where the backbone reads the policy's tokens; else from the text, with the end where it ended."""
        ended = not response.tokens or response.tokens[-1] in self.ends
        if self.chat:  # first of all: a template reads the text, whatever was sampled
            return in_turns(self.tokenizer, response, ended)
        if self.opened is not None:
            prompt = list(response.prompt_tokens or self.opened(response.prompt))
            # As sampled: text that is encoded anew can merge across the border, and its tokens are then others.
            said = response.tokens or self.tokenizer.encode(response.text, add_special_tokens=False)
            return [*prompt, *said, *self.ends[:1] * (not response.tokens)]
        prompt, end = self.tokenizer.encode(response.prompt), end_token(self.tokenizer)
        if self.pool == "last" and prompt[-1:] == [end]:  # some tokenizers end all that they encode
            prompt.pop()
        return [*prompt, *self.tokenizer.encode(response.text, add_special_tokens=False), *[end] * ended]

    def weights(self) -> dict[str, torch.nn.Parameter]:
        """What the heads' view hangs on, by name: all but a pooler, unless it is a classifier's own."""
        return {n: p for n, p in self.model.named_parameters() if self.pool == "own" or "pooler" not in n}


def in_turns(tokenizer: PreTrainedTokenizerBase, response: Response, ended: bool) -> list[int]:
    """The turns of prompt and response in the chat template, which begins and ends them; a cut response stays open.

    A prompt that is no transcript is what the user says. Raises ValueError where the template refuses the turns.
    """
    asked = prompt_messages(response.prompt)
    said = [{"role": "assistant", "content": response.text}] if asked is None else response_messages(response.text)
    turns = [*(asked or [{"role": "user", "content": response.prompt}]), *said]
    try:
        found = tokenizer.apply_chat_template(turns, continue_final_message=not ended, return_dict=False)
    except (TemplateError, ValueError) as error:
        raise ValueError(
            f"candidate {response.id[:12]} does not fit the chat template of the reward's tokenizer: "
            f"{first_line(error)}; leave it out, or set reward.chat_template=false"
        ) from error
    return list(found)


def end_token(tokenizer: PreTrainedTokenizerBase) -> int:
    """What stands after a response that has ended. Raises `ConfigError` where the tokenizer has nothing for it."""
    found = tokenizer.eos_token_id if tokenizer.eos_token_id is not None else tokenizer.sep_token_id
    if found is None:
        raise ConfigError(
            "the reward's tokenizer has neither an end token nor a separator, so a response that has ended looks like "
            "one that was cut: set eos_token in its tokenizer_config.json"
        )
    return int(found)


def of_policy(task: TextTask, chat: bool, frozen: bool) -> Backbone:
    """The task's starting policy, reading what was sampled, or the text where it is put into a chat template."""
    return _ready(task.model(frozen).base_model, task.tokenizer, task, "mean", chat)


def of_folder(name: str, task: TextTask, download: bool, pool: Literal["first", "mean"], chat: bool) -> Backbone:
    """A model of transformers by folder or name. Raises `ConfigError` where it cannot be used."""
    return _ready(
        load_weights(AutoModel, name, download, "reward.download"), load_tokenizer(name, download), task, pool, chat
    )


def of_classifier(model: Any, head: str, tokenizer: PreTrainedTokenizerBase, task: TextTask, chat: bool) -> Backbone:
    """A sequence classifier without its last layer, which is at the path `head`: of a causal one what is under it."""
    width, encoder = int(model.get_submodule(head).in_features), is_encoder(model)
    if encoder:
        model.set_submodule(head, torch.nn.Identity())
    ready = _ready(model if encoder else model.base_model, tokenizer, task, "own", chat)
    return replace(ready, width=width, head=head if encoder else "")


def is_encoder(model: PreTrainedModel) -> bool:
    return model.config.model_type in MODEL_FOR_MASKED_LM_MAPPING_NAMES


def _ready(model: Any, tokenizer: PreTrainedTokenizerBase, task: TextTask, pool: Pool, chat: bool) -> Backbone:
    if model.config.is_encoder_decoder:
        raise ConfigError(f"a {model.config.model_type} has an encoder and a decoder: choose a backbone with one stack")
    if chat and tokenizer.chat_template is None:
        raise ConfigError("reward.chat_template is true, but the reward's tokenizer has no chat template")
    if model.config.model_type in MODELS:
        # Only what was tested against padded rows is packed; other architectures may mix tokens in other ways.
        use_packed_attention(model)
    # Two tokenizers with one vocabulary read the same ids, so what was sampled need not be encoded again.
    same = tokenizer is task.tokenizer or tokenizer.get_vocab() == task.tokenizer.get_vocab()
    opened = task.encode if same and not chat else None
    pool = pool if is_encoder(model) else "last"
    # Evaluation mode for good: dropout would give one response a different score in each pass.
    return Backbone(model.eval(), tokenizer, task.ends, opened, int(model.config.hidden_size), pool, chat=chat)


def _after_padding(model: PreTrainedModel) -> list[int]:
    """How many positions are left where they are counted from the one after padding's, as RoBERTa does."""
    tables = [m for n, m in model.named_modules() if n.endswith("position_embeddings")]
    starts = [(m, m.padding_idx) for m in tables if isinstance(m, torch.nn.Embedding)]
    return [m.num_embeddings - start - 1 for m, start in starts if start is not None]


def trainable(backbone: Backbone, train: Train) -> dict[str, torch.nn.Parameter]:
    """What a fit changes, by name."""
    if train == "head":
        return {}
    return {n: p for n, p in backbone.weights().items() if train == "full" or "lora_" in n}


def digest(named: Mapping[str, Tensor]) -> str:
    """sha256 over names and values."""
    found = hashlib.sha256()
    for name, value in named.items():
        found.update(name.encode())
        # As bytes, since NumPy has no bfloat16.
        found.update(to_numpy(value.detach().contiguous().view(torch.uint8)).tobytes())
    return found.hexdigest()
