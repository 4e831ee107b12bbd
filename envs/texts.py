"""A text task without a gold: prompts from a file, and a starting policy from a folder or a plain one of bytes."""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Self

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
from prefrl.envs.prompts import Long, Opening, Prompt, check_template, for_evaluation, read_prompts, turn_end
from prefrl.policies.cloning import make_tokenizer
from prefrl.policies.pretrained import Precision, context_of, load_tokenizer, load_weights, on_same_weights
from prefrl.types import Fields, Floats, Response

RESPONSE_TOKENS = 256
ONLY_BYTES = 259
"""The 256 bytes, and the tokens for padding, begin and end."""


class TextsSettings(Settings):
    """Prompts from a file, answered by your own model; what a response is worth, people or a reward say."""

    kind: Literal["texts"] = "texts"
    prompts: Path | None = None
    """A file, or a folder of a data set, whose prompts are answered: rows with `prompt` or `messages`, whose other
    columns reward functions are given, or judgements. Not needed to fit a reward model."""
    evaluation_prompts: Path | None = None
    """Prompts to evaluate on; without them one in eight of the others is kept for it."""
    model: Path | None = None
    """A folder with a causal model of transformers and its tokenizer, or with an adapter of peft's, or a .gguf file;
    without one a small Llama over bytes is made whose weights are random: it knows no language, and is a floor to
    compare with."""
    dtype: Precision = "float32"
    """Of the model's weights."""
    chat_template: bool | None = None
    """Whether a prompt is put into the tokenizer's chat template; by default where it has one."""
    system: str = ""
    """A system prompt for conversations that have none; needs a chat template."""
    long_prompts: Long = "refuse"
    """What happens to prompts that leave no room for a response in the model's context: refuse them, cut them to their
    end, or skip them."""
    response_tokens: int | None = Field(None, ge=2)
    """The most tokens that a response may have, the end token included; by default 256, or half of the model's context
    where that is less."""
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

    def identity(self) -> Self:
        """Without where its prompts come from, and how long responses may be: a reward model hangs on neither."""
        names = ("prompts", "evaluation_prompts", "long_prompts", "response_tokens", "dtype")
        update = {name: type(self).model_fields[name].default for name in names}
        return self.model_copy(update=update | {"model": self.model and self.model.resolve()})

    def build(self) -> Texts:
        """Raises `ConfigError` where the folder holds no model that can be used, `ValueError` for a bad file."""
        model, tokenizer = _load(self.model, self.dtype) if self.model else _small(self)
        context = context_of(model)
        tokens = self.response_tokens or min(RESPONSE_TOKENS, (context or 2 * RESPONSE_TOKENS) // 2)
        opening = self._opening(tokenizer, None if context is None else context - tokens)
        learning, left_out = _known(self.prompts, opening, "prompts")
        kept, skipped = _known(self.evaluation_prompts, opening, "evaluation_prompts")
        own = set(kept) if kept else for_evaluation(list(learning))
        return Texts(
            tokens,
            tokenizer,
            model,
            _ends(model, tokenizer, opening.chat),
            opening,
            learning | kept,
            tuple(prompt for prompt in learning if prompt not in own),
            tuple(prompt for prompt in learning | kept if prompt in own),
            notes=(*left_out, *skipped),
        )

    def _opening(self, tokenizer: PreTrainedTokenizerBase, room: int | None) -> Opening:
        has = tokenizer.chat_template is not None
        chat = has if self.chat_template is None else self.chat_template
        if chat and not has:
            raise ConfigError(f"task.chat_template is true, but the tokenizer of {self.model} has no chat template")
        if self.system and not chat:
            raise ConfigError(
                "task.system needs a chat template: the tokenizer has none, or task.chat_template is false"
            )
        if chat and self.long_prompts == "cut":
            raise ConfigError("task.long_prompts=cut would cut the chat template open: set it to refuse or skip")
        if chat:
            check_template(tokenizer)
        if room is not None and room < 1:
            raise ConfigError(
                f"task.response_tokens={self.response_tokens} leaves no room for a prompt in the model's context of "
                f"{room + (self.response_tokens or 0)} tokens: set it lower"
            )
        return Opening(tokenizer, chat, self.system, room, self.long_prompts)


@dataclass(frozen=True, eq=False)
class Texts:
    """A `prefrl.protocols.TextTask` that knows of no gold and cannot tell what is fluent."""

    response_tokens: int
    tokenizer: PreTrainedTokenizerBase
    start: PreTrainedModel
    ends: tuple[int, ...]
    encode: Opening
    known: Mapping[str, Fields]
    """Distinct prompts, and what else their rows say; none where there is no file of them."""
    learning: tuple[str, ...]
    evaluating: tuple[str, ...]
    name: str = "texts"
    kind: str = "text"
    notes: tuple[str, ...] = field(default=())

    def model(self, frozen: bool = False) -> PreTrainedModel:
        return on_same_weights(self.start) if frozen else copy.deepcopy(self.start)

    def columns(self, prompt: str) -> Fields:
        return self.known.get(prompt, {})

    def prompts(self, count: int, rng: np.random.Generator) -> list[str]:
        return _drawn(self.learning, count, rng, "to learn on")

    def evaluation_prompts(self, count: int, rng: np.random.Generator) -> list[str]:
        return _drawn(self.evaluating, count, rng, "to evaluate on (one in eight is)")

    @property
    def ungraded(self) -> str:
        return "what is written to these prompts"

    def gold(self, responses: Sequence[Response]) -> Floats:
        """(N,) NaN: only people know."""
        return np.full(len(responses), np.nan, np.float32)

    def fluency(self, responses: Sequence[Response]) -> Floats | None:
        """None: only people can tell."""
        return None


def _drawn(prompts: Sequence[str], count: int, rng: np.random.Generator, purpose: str) -> list[str]:
    if not prompts:
        raise ConfigError(f"task.prompts: there is no prompt {purpose}; give a file with two or more")
    return [prompts[i] for i in rng.integers(len(prompts), size=count)]


def _known(path: Path | None, opening: Opening, setting: str) -> tuple[dict[str, Fields], tuple[str, ...]]:
    """The distinct prompts of a file with their columns, in their order, and what people should know of the others.

    Raises `ValueError` where a prompt does not fit and is to be refused, and where one has two sets of columns.
    """
    if path is not None and not path.exists():
        raise ConfigError(f"task.{setting}: no such file or folder: {path}")
    found: dict[str, Fields] = {}
    counts: Counter[str] = Counter()
    for prompt in read_prompts(path) if path else ():
        if prompt.text in found:
            _check_repeated(prompt, found[prompt.text])
            continue
        if not _fits(prompt, opening):
            counts[opening.long] += 1
            if opening.long == "skip":
                continue
        found[prompt.text] = prompt.columns
    done = {"cut": "cut to the room that the model's context leaves", "skip": "left out: the context has no room"}
    return found, tuple(f"{path}: {count} long prompts {done[how]}" for how, count in counts.items())


def _check_repeated(prompt: Prompt, before: Fields) -> None:
    if prompt.columns != before:
        names = [n for n in {**before, **prompt.columns} if before.get(n) != prompt.columns.get(n)]
        judged = {"chosen", "rejected", "completion", "label", "responses", "margin"}
        if set(names) - judged:
            raise ValueError(
                f"{prompt.place}: this prompt stood there before with another {names[0]!r}: rewards are given the "
                "columns of a prompt, so that there can be one of each"
            )


def _fits(prompt: Prompt, opening: Opening) -> bool:
    """Whether the model's context has room for it. Raises `ValueError` with its row where such prompts are refused."""
    try:
        return opening.fits(prompt.text)
    except ValueError as error:
        raise ValueError(f"{prompt.place}: {error}") from None


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


def _load(path: Path, dtype: Precision) -> tuple[PreTrainedModel, PreTrainedTokenizerBase]:
    """A model and its tokenizer from a folder or a .gguf file: no code of its own, nothing downloaded."""
    if not path.is_dir() and not (path.is_file() and path.suffix == ".gguf"):
        raise ConfigError(f"task.model: {path} is no folder; expected one that save_pretrained wrote, or a .gguf file")
    try:
        if (path / "adapter_config.json").exists():
            from prefrl.policies.lora import load_merged  # peft takes seconds to load

            return load_merged(path, dtype)
        model = load_weights(AutoModelForCausalLM, path, False, dtype=dtype)
        return model, load_tokenizer(path, False)
    except ConfigError as error:
        raise ConfigError(f"task.model: {error}") from error


def _ends(model: PreTrainedModel, tokenizer: PreTrainedTokenizerBase, chat: bool) -> tuple[int, ...]:
    """Every token that ends a response: chat models have two. The first is what ends a response that came as text.

    Raises `ConfigError` where there is none.
    """
    said = model.generation_config.eos_token_id if model.generation_config else None
    given = said if isinstance(said, list) else [said]
    found = dict.fromkeys(int(end) for end in [tokenizer.eos_token_id, *given] if end is not None)
    if not found:
        raise ConfigError(
            "task.model: neither the tokenizer nor the generation config has an end token, so that no response could "
            "end: set eos_token in tokenizer_config.json"
        )
    first = turn_end(tokenizer) if chat else None  # the end of a turn, which need not be that of a text
    return tuple(sorted(found, key=lambda end: end != first))
