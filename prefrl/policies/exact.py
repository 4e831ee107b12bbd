"""Is what is computed here what a model says? Probes before any label or hour is spent.

Not every architecture of transformers keeps what this package relies on: that a causal model never looks at padding on
the right, that its decoding with a cache agrees with its plain forward pass, that its logits are its head's output.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from transformers import PreTrainedModel

from prefrl.components import ConfigError
from prefrl.policies.generate import Generation, Sampling, generate
from prefrl.seeding import generator

TOLERANCE = {torch.float32: 1e-3, torch.bfloat16: 0.5, torch.float16: 0.1}
"""Nats. In half precision a decoding step rounds otherwise than a pass over all tokens."""
PROMPTS, TOKENS = (3, 9, 6), 6
"""Tokens of each probe's prompt, and of the responses."""
LogProb = Callable[[Sequence[Sequence[int]], Tensor, Tensor], Tensor]
"""Prompts, (B, L) tokens and their mask -> (B, L) log-probabilities, 0 on padding."""


@torch.no_grad()
def check_exact(model: PreTrainedModel, log_prob: LogProb) -> None:
    """Raise `ConfigError` unless `log_prob`, and sampling, agree with the model's plain forward on random tokens.

    Rows are of different lengths, so that padding takes part on both sides.
    """
    try:
        prompts, found = _probes(model)
        said = log_prob([p for p in prompts for _ in range(2)], found.tokens, found.mask)
        rows = [tokens[mask].tolist() for tokens, mask in zip(found.tokens, found.mask, strict=True)]
        plain = [_plain(model, prompts[i // 2], row) for i, row in enumerate(rows)]
    except (RuntimeError, AttributeError, TypeError, ValueError, IndexError, KeyError) as error:
        raise ConfigError(f"{_called(model)} cannot be sampled from here: {error}; choose another model") from error
    for what, values in (("log-probabilities", said), ("sampling", found.logp)):
        off = max(
            float((row[mask] - one).abs().max()) for row, mask, one in zip(values, found.mask, plain, strict=True)
        )
        if not off <= TOLERANCE[model.dtype]:
            raise ConfigError(
                f"{_called(model)}: {what} here differ by {off:.2g} nats from the model's plain forward pass, so that "
                "it would be trained on wrong numbers; choose a model of another architecture"
            )


def _probes(model: PreTrainedModel) -> tuple[list[list[int]], Generation]:
    rng = np.random.default_rng(0)
    vocabulary = rows_of_embedding(model)
    prompts = [rng.integers(vocabulary, size=n).tolist() for n in PROMPTS]
    return prompts, generate(model, prompts, Sampling(2, TOKENS, ()), generator(rng))


def _plain(model: PreTrainedModel, prompt: Sequence[int], response: Sequence[int]) -> Tensor:
    """(L,) by the model's own forward pass, of one row alone."""
    ids = torch.tensor([[*prompt, *response]], device=model.device)
    logits: Tensor = model(input_ids=ids, use_cache=False).logits[0, len(prompt) - 1 : -1].float()
    return logits.log_softmax(-1).gather(1, ids[0, len(prompt) :, None])[:, 0]


def rows_of_embedding(model: PreTrainedModel) -> int:
    """How many tokens a model has a row for."""
    embedding: Any = model.get_input_embeddings()
    return int(embedding.weight.shape[0])


def _called(model: PreTrainedModel) -> str:
    return f"task.model: a {type(model).__name__} ({model.config.model_type})"
