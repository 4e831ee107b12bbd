"""A text task without a gold: prompts from a file, and a starting policy from a folder or a plain one of bytes."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from pydantic import Field
from transformers import (
    AutoModelForCausalLM,
    LlamaConfig,
    LlamaForCausalLM,
    PreTrainedModel,
    PreTrainedTokenizerBase,
)

from prefrl.components import ConfigError, Settings
from prefrl.envs.text import for_evaluation
from prefrl.exchange.formats import read_judgements
from prefrl.kinds import only
from prefrl.policies.cloning import make_tokenizer
from prefrl.policies.pretrained import load_tokenizer, load_weights
from prefrl.types import Floats, Response

ONLY_BYTES = 259
"""The 256 bytes, and the tokens for padding, begin and end."""


class TextsSettings(Settings):
    """Texts whose value only people know: for judgements from files."""

    kind: Literal["texts"] = "texts"
    prompts: Path | None = None
    """A file of judgements whose prompts are answered; not needed to fit a reward model. One in eight is kept for
    evaluation."""
    model: Path | None = None
    """A folder with a causal model of transformers and its tokenizer; without one a small Llama over bytes is made
    whose weights are random: it knows no language, and is a floor to compare with."""
    response_tokens: int = Field(256, ge=2)
    """The most tokens that a response may have, the end token included."""
    layers: int = Field(2, ge=1)
    """Of the small Llama."""
    width: int = Field(64, ge=8)
    """Of its hidden states."""
    heads: int = Field(4, ge=1)
    """Of each attention layer."""
    context: int = Field(16_384, ge=64)
    """The most bytes of a prompt and its response together."""

    def shrunk(self) -> TextsSettings:
        return self.model_copy(update={"response_tokens": 8, "layers": 1, "width": 16, "heads": 2})

    def build(self) -> Texts:
        """Raises `ConfigError` where the folder holds no model that can be used, `ValueError` for a bad file."""
        model, tokenizer = _load(self.model) if self.model else _small(self)
        judged = read_judgements(self.prompts).judged if self.prompts else ()
        refusal = ConfigError(f"task.prompts: {self.prompts} holds segments; expected responses to prompts")
        first = only(Response, [one.query.candidates[0] for one in judged], refusal)
        return Texts(self.response_tokens, tokenizer, model, tuple({one.prompt: 0 for one in first}))


@dataclass(frozen=True, eq=False)
class Texts:
    """A `prefrl.protocols.TextTask` that knows of no gold and cannot tell what is fluent."""

    response_tokens: int
    tokenizer: PreTrainedTokenizerBase
    start: PreTrainedModel
    known: tuple[str, ...]
    """Distinct prompts; none where there is no file of them."""
    name: str = "texts"
    kind: str = "text"

    def model(self) -> PreTrainedModel:
        return copy.deepcopy(self.start)

    def prompts(self, count: int, rng: np.random.Generator) -> list[str]:
        return self._draw(count, rng, evaluation=False)

    def evaluation_prompts(self, count: int, rng: np.random.Generator) -> list[str]:
        return self._draw(count, rng, evaluation=True)

    def gold(self, responses: Sequence[Response]) -> Floats:
        """(N,) NaN: only people know."""
        return np.full(len(responses), np.nan, np.float32)

    def fluency(self, responses: Sequence[Response]) -> Floats | None:
        """None: only people can tell."""
        return None

    def _draw(self, count: int, rng: np.random.Generator, evaluation: bool) -> list[str]:
        prompts = [prompt for prompt in self.known if for_evaluation(prompt) == evaluation]
        if not prompts:
            purpose = "to evaluate on (one in eight is)" if evaluation else "to learn on"
            raise ConfigError(f"task.prompts: {len(self.known)} prompts leave none {purpose}; give a file with more")
        return [prompts[i] for i in rng.integers(len(prompts), size=count)]


def _small(settings: TextsSettings) -> tuple[PreTrainedModel, PreTrainedTokenizerBase]:
    """The same weights in every run: a task is what it is, whatever the seed."""
    if settings.width % (2 * settings.heads):
        raise ConfigError(f"task.width: expected a multiple of 2 x heads = {2 * settings.heads}, got {settings.width}")
    tokenizer = make_tokenizer([], ONLY_BYTES)
    config = LlamaConfig(
        vocab_size=len(tokenizer),
        hidden_size=settings.width,
        intermediate_size=settings.width * 2,
        num_hidden_layers=settings.layers,
        num_attention_heads=settings.heads,
        max_position_embeddings=settings.context,
        tie_word_embeddings=True,
        pad_token_id=tokenizer.pad_token_id,
        bos_token_id=tokenizer.bos_token_id,
        eos_token_id=tokenizer.eos_token_id,
    )
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        model = LlamaForCausalLM(config)
    model.eval()  # type: ignore[no-untyped-call]
    return model, tokenizer


def _load(folder: Path) -> tuple[PreTrainedModel, PreTrainedTokenizerBase]:
    """A model and its tokenizer from a folder: safetensors only, no code of its own, nothing downloaded."""
    if not folder.is_dir():
        raise ConfigError(f"task.model: {folder} is no folder; expected one that save_pretrained wrote")
    try:
        model, tokenizer = load_weights(AutoModelForCausalLM, folder, False), load_tokenizer(folder, False)
    except ConfigError as error:
        raise ConfigError(f"task.model: {error}") from error
    if tokenizer.eos_token_id is None:
        raise ConfigError(f"task.model: the tokenizer in {folder} has no end token, so that no response could end")
    return model, tokenizer
