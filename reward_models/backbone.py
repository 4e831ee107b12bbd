"""The network under a text reward model: where it comes from, which tokens it reads, what a fit may change in it."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal

import torch
from torch import Tensor
from transformers import AutoModel, AutoTokenizer, PreTrainedModel, PreTrainedTokenizerBase
from transformers.models.auto.modeling_auto import MODEL_FOR_MASKED_LM_MAPPING_NAMES
from transformers.utils.logging import (
    disable_progress_bar,
    enable_progress_bar,
    get_verbosity,
    is_progress_bar_enabled,
    set_verbosity,
    set_verbosity_error,
)

from prefrl.components import ConfigError
from prefrl.protocols import TextTask
from prefrl.reward_models.packing import MODELS, final_states, pack, use_packed_attention
from prefrl.types import Response

Train = Literal["full", "lora", "head"]
BUCKET = 16
"""Rows of like length that share a padded pass, where a model cannot be packed."""


@dataclass(frozen=True, eq=False)
class Backbone:
    """A transformer without a head, and how responses become its tokens."""

    model: PreTrainedModel
    """In evaluation mode, so without dropout, in fits as well."""
    tokenizer: PreTrainedTokenizerBase
    policy_end: int | None
    """The policy's end token where the tokens it sampled must be encoded anew, None where they are read as they are."""
    pool: Literal["last", "first", "mean"] = "last"

    @property
    def width(self) -> int:
        return int(self.model.config.hidden_size)

    @property
    def context(self) -> int | None:
        """The most tokens that the model has positions for."""
        known = [getattr(self.model.config, "max_position_embeddings", None)]  # some architectures have no bound
        if self.policy_end is not None:
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
                    f"candidate {candidate.id[:12]} has {len(row)} tokens, but the reward's backbone has a context of "
                    f"{context}: leave it out, or choose a reward.backbone with a longer context"
                )
        return rows

    def states(self, tokens: Tensor, lengths: Tensor) -> Tensor:
        """(N, L) right-padded rows with their lengths (N,) -> (N, d) what the heads see."""
        if self.model.config.model_type in MODELS:
            return final_states(self.model, pack(tokens, lengths))
        order = lengths.argsort()
        parts = [self._padded_states(tokens[part], lengths[part]) for part in torch.split(order, BUCKET)]
        return torch.cat(parts)[order.argsort()]

    def _padded_states(self, tokens: Tensor, lengths: Tensor) -> Tensor:
        tokens = tokens[:, : int(lengths.max())]
        mask = torch.arange(tokens.shape[1]) < lengths[:, None]
        hidden: Tensor = self.model(input_ids=tokens, attention_mask=mask.long()).last_hidden_state
        if self.pool == "mean":
            return (hidden * mask[:, :, None]).sum(1) / lengths[:, None]
        return hidden[torch.arange(len(tokens)), lengths - 1 if self.pool == "last" else 0]

    def _encode(self, response: Response) -> list[int]:
        """As sampled, where the backbone reads the policy's tokens; else from the text, with the end where it ended."""
        sampled = self.policy_end is None
        prompt = list((sampled and response.prompt_tokens) or self.tokenizer.encode(response.prompt))
        if sampled and response.tokens:
            return [*prompt, *response.tokens]
        end = end_token(self.tokenizer)
        if self.pool == "last" and prompt[-1:] == [end]:  # some tokenizers end all that they encode
            prompt.pop()
        ended = not response.tokens or response.tokens[-1] == self.policy_end
        return [*prompt, *self.tokenizer.encode(response.text, add_special_tokens=False), *[end] * ended]


def end_token(tokenizer: PreTrainedTokenizerBase) -> int:
    """What stands after a response that has ended. Raises `ConfigError` where the tokenizer has nothing for it."""
    found = tokenizer.eos_token_id if tokenizer.eos_token_id is not None else tokenizer.sep_token_id
    if found is None:
        raise ConfigError(
            "the reward's tokenizer has neither an end token nor a separator, so a response that has ended looks like "
            "one that was cut: set eos_token in its tokenizer_config.json"
        )
    return int(found)


def of_policy(task: TextTask) -> Backbone:
    """The task's starting policy, reading what was sampled."""
    return _ready(task.model().base_model, task.tokenizer, None, "mean")


def of_folder(name: str, task: TextTask, download: bool, pool: Literal["first", "mean"]) -> Backbone:
    """A model of transformers by folder or name. Raises `ConfigError` where it cannot be used."""
    model = load_weights(AutoModel, name, download)
    tokenizer = load_tokenizer(name, download)
    same = tokenizer.get_vocab() == task.tokenizer.get_vocab()
    return _ready(model, tokenizer, None if same else end_token(task.tokenizer), pool)


def of_classifier(model: PreTrainedModel, tokenizer: PreTrainedTokenizerBase, task: TextTask) -> Backbone:
    """What is under a sequence classifier."""
    same = tokenizer.get_vocab() == task.tokenizer.get_vocab()
    return _ready(model, tokenizer, None if same else end_token(task.tokenizer), "mean")


def _ready(
    model: Any, tokenizer: PreTrainedTokenizerBase, policy_end: int | None, pool: Literal["first", "mean"]
) -> Backbone:
    if model.config.is_encoder_decoder:
        raise ConfigError(f"a {model.config.model_type} has an encoder and a decoder: choose a backbone with one stack")
    if model.config.model_type in MODELS:
        use_packed_attention(model)
    encoder = model.config.model_type in MODEL_FOR_MASKED_LM_MAPPING_NAMES
    return Backbone(model.eval(), tokenizer, policy_end, pool if encoder else "last")


def load_weights(auto: Any, name: str, download: bool) -> PreTrainedModel:
    """Float32, from safetensors alone and without anybody's code. Raises `ConfigError` where weights are missing."""
    where = {"local_files_only": not download, "trust_remote_code": False}
    try:
        with quiet():
            model, info = auto.from_pretrained(
                name, dtype=torch.float32, use_safetensors=True, output_loading_info=True, **where
            )
    except (OSError, ValueError) as error:
        hint = first_line(error) if download else "only local files are looked at unless reward.download is true"
        raise ConfigError(f"no model in safetensors could be read from {name!r}: {hint}") from error
    if missing := sorted(k for k in info["missing_keys"] if "pooler" not in k):
        raise ConfigError(f"{name}: weights are missing, {missing[0]} for one: expected a complete checkpoint")
    found: PreTrainedModel = model
    return found


def load_tokenizer(name: str, download: bool) -> PreTrainedTokenizerBase:
    try:
        found: PreTrainedTokenizerBase = AutoTokenizer.from_pretrained(
            name, local_files_only=not download, trust_remote_code=False
        )
    except (OSError, ValueError) as error:
        raise ConfigError(f"no tokenizer could be read from {name!r}: {first_line(error)}") from error
    return found


def first_line(error: Exception) -> str:
    """What went wrong; the advice that libraries add is for others."""
    return str(error).strip().partition("\n")[0]


def trainable(model: PreTrainedModel, train: Train) -> dict[str, torch.nn.Parameter]:
    """What a fit changes, by name. A pooler is no part of what the heads see."""
    if train == "head":
        return {}
    named = ((n, p) for n, p in model.named_parameters() if "pooler" not in n)
    return {n: p for n, p in named if train == "full" or "lora_" in n}


def digest(named: Mapping[str, Tensor]) -> str:
    """sha256 over names and values."""
    found = hashlib.sha256()
    for name, value in named.items():
        found.update(name.encode())
        found.update(value.detach().contiguous().view(torch.uint8).numpy().tobytes())
    return found.hexdigest()


@contextmanager
def quiet() -> Iterator[None]:
    """Keep transformers from drawing bars, and from reporting on the head that is left out."""
    shown, verbosity = is_progress_bar_enabled(), get_verbosity()
    disable_progress_bar()  # type: ignore[no-untyped-call]
    set_verbosity_error()  # type: ignore[no-untyped-call]
    try:
        yield
    finally:
        set_verbosity(verbosity)
        if shown:
            enable_progress_bar()  # type: ignore[no-untyped-call]
