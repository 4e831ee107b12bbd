"""A transformer that scores responses: the starting policy's backbone with E linear heads on the last real token."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor
from transformers import PreTrainedTokenizerBase

from prefrl.components import ConfigError, Settings
from prefrl.protocols import Task, TextTask
from prefrl.seeding import draw_seed
from prefrl.types import Floats, Response, State

CHUNK = 128
"""Responses scored at once outside a fit: bounds the memory, and lets rows of like length share a pass."""


class TransformerSettings(Settings):
    """The task's starting policy as a backbone, with E linear heads evaluated in one pass."""

    kind: Literal["transformer"] = "transformer"
    members: int = Field(3, ge=1)
    """E: how many heads, each from its own random start, on one shared backbone."""
    train: Literal["full", "head"] = "full"
    """What a fit changes: everything, or the heads alone."""

    def build(self, task: Task, rng: np.random.Generator) -> TransformerReward:
        return TransformerReward(self, _text(task), rng)


class TransformerReward:
    """A `prefrl.protocols.RewardModel` of responses (Stiennon et al. 2020, section 3.4: a score at the end).

    It reads the tokens as they were sampled, the end token included, so it sees whether a response has ended; rows
    are padded on the right, where a causal model never looks. Evaluation mode, no dropout, float32. Heads start from
    N(0, 1 / (d + 1)).
    """

    def __init__(self, settings: TransformerSettings, task: TextTask, rng: np.random.Generator) -> None:
        self._train = settings.train
        self._tokenizer = task.tokenizer
        model = task.model()
        width = int(model.config.hidden_size)
        self._backbone: torch.nn.Module = model.base_model.requires_grad_(settings.train == "full")
        generator = torch.Generator().manual_seed(draw_seed(rng))
        heads = torch.randn(settings.members, width, generator=generator) / math.sqrt(width + 1)
        self._heads, self._bias = torch.nn.Parameter(heads), torch.nn.Parameter(torch.zeros(settings.members))
        self._shift, self._scale = torch.zeros(settings.members), torch.ones(settings.members)
        self._fitted = False

    @property
    def members(self) -> int:
        return len(self._heads)

    @property
    def fitted(self) -> bool:
        return self._fitted

    def parameters(self) -> Iterable[torch.nn.Parameter]:
        backbone = self._backbone.parameters() if self._train == "full" else ()
        return [*backbone, self._heads, self._bias]

    def stack(self, candidates: Sequence[Response]) -> Mapping[str, Tensor]:
        """tokens (N, L) and lengths (N,); where only heads are trained, the backbone's features (N, d) at once."""
        rows = [_ids(c, self._tokenizer) for c in candidates]
        if self._train == "head":
            return {"features": self._in_chunks(rows)}
        return _padded(rows)

    def scores(self, stacked: Mapping[str, Tensor]) -> Tensor:
        features = stacked["features"] if "features" in stacked else self._features(stacked)
        return self._heads @ features.T + self._bias[:, None]

    @torch.no_grad()
    def settle(self, stacked: Mapping[str, Tensor]) -> None:
        count = len(next(iter(stacked.values())))
        parts = [self.scores({k: x[i : i + CHUNK] for k, x in stacked.items()}) for i in range(0, count, CHUNK)]
        scores = torch.cat(parts, 1)
        self._shift, self._scale = scores.mean(1), scores.std(1, correction=0).clamp(min=1e-6)
        self._fitted = True

    @torch.no_grad()
    def raw_member_scores(self, candidates: Sequence[Response]) -> Floats:
        features = self._in_chunks([_ids(c, self._tokenizer) for c in candidates])
        raw: Floats = self.scores({"features": features}).numpy()
        return raw

    def member_scores(self, candidates: Sequence[Response]) -> Floats:
        shift, scale = self._shift.numpy()[:, None], self._scale.numpy()[:, None]
        found: Floats = (self.raw_member_scores(candidates) - shift) / scale
        return found

    def score(self, candidates: Sequence[Response]) -> Floats:
        mean: Floats = self.member_scores(candidates).mean(0)
        return mean

    def state(self) -> State:
        backbone = {name: p.detach().clone() for name, p in self._backbone.named_parameters()}
        heads = {"heads": self._heads.detach().clone(), "bias": self._bias.detach().clone()}
        return {"backbone": backbone, **heads, "shift": self._shift, "scale": self._scale, "fitted": self._fitted}

    @torch.no_grad()
    def load(self, state: State) -> None:
        """Raises ValueError where names or shapes differ."""
        own = {**dict(self._backbone.named_parameters()), "heads": self._heads, "bias": self._bias}
        found = {**state["backbone"], "heads": state["heads"], "bias": state["bias"]}
        if wrong := [n for n, p in own.items() if n not in found or found[n].shape != p.shape]:
            raise ValueError(f"reward model: {wrong[0]} is missing or has another shape: it was made by other settings")
        for name, parameter in own.items():
            parameter.copy_(found[name])
        self._shift, self._scale = state["shift"].clone(), state["scale"].clone()
        self._fitted = bool(state["fitted"])

    def _features(self, stacked: Mapping[str, Tensor]) -> Tensor:
        """(N, d): the backbone's output at each row's last real token. Padding beyond the longest row is cut off."""
        lengths = stacked["lengths"]
        tokens = stacked["tokens"][:, : int(lengths.max())]
        hidden: Tensor = self._backbone(input_ids=tokens, use_cache=False).last_hidden_state
        return hidden[torch.arange(len(tokens)), lengths - 1]

    @torch.no_grad()
    def _in_chunks(self, rows: Sequence[Sequence[int]]) -> Tensor:
        """(N, d) features, rows of like length together."""
        order = sorted(range(len(rows)), key=lambda i: len(rows[i]))
        chunks = [order[i : i + CHUNK] for i in range(0, len(rows), CHUNK)]
        features = torch.cat([self._features(_padded([rows[i] for i in chunk])) for chunk in chunks])
        return features[torch.tensor(order).argsort()]


def _padded(rows: Sequence[Sequence[int]]) -> dict[str, Tensor]:
    """Right-padded with 0, which is a valid id; lengths say what is real."""
    width = max(map(len, rows))
    tokens = torch.tensor([[*row, *[0] * (width - len(row))] for row in rows])
    return {"tokens": tokens, "lengths": torch.tensor([len(row) for row in rows])}


def _ids(response: Response, tokenizer: PreTrainedTokenizerBase) -> list[int]:
    """Prompt and response as sampled; only a response that comes without tokens is encoded, as one that has ended."""
    prompt = response.prompt_tokens or tokenizer.encode(response.prompt)
    if response.tokens:
        return [*prompt, *response.tokens]
    return [*prompt, *tokenizer.encode(response.text, add_special_tokens=False), int(tokenizer.eos_token_id)]


def _text(task: Task) -> TextTask:
    if task.kind != "text":
        raise ConfigError(f"reward kind 'transformer' scores text responses, but the task is of kind {task.kind!r}")
    return task  # type: ignore[return-value]
