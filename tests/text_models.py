"""What several tests of reward models for text need: reviews, and small checkpoints on disk."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import torch
from transformers import (
    AutoModelForSequenceClassification,
    BertConfig,
    GPT2Config,
    GPT2ForSequenceClassification,
    PreTrainedTokenizerFast,
)

from prefrl.envs.reviews import reviews
from prefrl.envs.text import Reviews
from prefrl.types import Response


def no_loss(scores: torch.Tensor) -> torch.Tensor:
    return scores.sum(1)


def some(task: Reviews, count: int, seed: int = 0) -> list[Response]:
    """Reviews as imported, of very different lengths."""
    rng, grammar = np.random.default_rng(seed), reviews()
    found = []
    for prompt, rest in (grammar.sample(rng) for _ in range(count)):
        tokens = (*task.tokenizer.encode(rest, add_special_tokens=False), int(task.tokenizer.eos_token_id))
        found.append(Response(prompt, rest, tuple(task.tokenizer.encode(prompt)), tokens))
    return found


def logits(folder: Path, rows: list[list[int]]) -> Any:
    """What transformers' own class says of padded rows."""
    model = AutoModelForSequenceClassification.from_pretrained(folder)
    tokenizer = PreTrainedTokenizerFast.from_pretrained(folder)
    model.eval()
    assert tokenizer.pad_token_id == model.config.pad_token_id != tokenizer.eos_token_id
    assert len(tokenizer) <= model.get_input_embeddings().weight.shape[0]
    padded = tokenizer.pad({"input_ids": rows}, return_tensors="pt", padding_side="right")
    with torch.no_grad():
        return model(**padded).logits[:, 0].numpy()


def save_tokenizer(task: Reviews, folder: Path, **changes: Any) -> None:
    words = task.tokenizer._tokenizer
    tokenizer = PreTrainedTokenizerFast(tokenizer_object=words, **changes)  # type: ignore[no-untyped-call]
    tokenizer.save_pretrained(folder)


def gpt2(labels: int = 1) -> Any:
    torch.manual_seed(0)
    config = GPT2Config(vocab_size=1000, n_positions=64, n_embd=32, n_layer=2, n_head=2, pad_token_id=0)
    config.num_labels = labels
    return GPT2ForSequenceClassification(config)


SMALL: dict[str, Any] = {"hidden_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2}


def bert_config(**more: Any) -> BertConfig:
    return BertConfig(vocab_size=1000, intermediate_size=48, **SMALL, **more)


def classifier(task: Reviews, folder: Path, config: Any, **tokenizer: Any) -> None:
    """A checkpoint with weights that tell texts apart, its pooler's and head's included."""
    torch.manual_seed(0)
    model: Any = AutoModelForSequenceClassification.from_config(config)  # type: ignore[no-untyped-call]
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(torch.randn(parameter.shape) * 0.2)
    model.save_pretrained(folder)
    save_tokenizer(task, folder, pad_token="<pad>", bos_token="<bos>", eos_token="<eos>", **tokenizer)
