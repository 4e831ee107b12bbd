"""A transformer that scores responses: one backbone with E linear heads, on the last real token of a causal model.

Variant: Stiennon et al. 2020, section 3.4. In place of a mean of 0 over reference summaries, each member has mean 0 and
std 1 over the candidates of a fit. Members share the backbone and differ in their heads alone. Left out: dropout, and
scores of single tokens.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cached_property
from typing import Literal, Self

import numpy as np
import torch
from pydantic import Field, model_validator
from torch import Tensor
from torch.nn.functional import linear

from prefrl.components import Settings
from prefrl.policies.responses import pad_right
from prefrl.protocols import Task, text
from prefrl.reward_models.backbone import Backbone, Train, digest, of_folder, of_policy, trainable
from prefrl.reward_models.ensemble import Ensemble, combine
from prefrl.seeding import generator, to_numpy
from prefrl.types import Floats, Response, State

CHUNK = 128
"""Responses scored at once outside a fit: bounds the memory, and lets rows of like length share a pass."""
NEEDS = "reward kind 'transformer' scores text responses"


class TransformerSettings(Settings):
    """A transformer, the task's starting policy or your own, with E linear heads evaluated in one pass."""

    kind: Literal["transformer"] = "transformer"
    backbone: str = ""
    """A folder, or a name, that transformers can load; the task's starting policy when not given."""
    checkpoint: str = ""
    """A sequence classifier with one label, by folder or name: its backbone and its head are where the model starts."""
    chat_template: bool | None = None
    """Whether prompt and response are put into the chat template of the tokenizer; by default only those of a
    checkpoint whose tokenizer has one."""
    download: bool = False
    """Whether a name may be looked up on the Hugging Face Hub; otherwise only local files are read."""
    members: int = Field(3, ge=1)
    """E: how many heads, each from its own random start, on one shared backbone."""
    combine: Ensemble = Ensemble()
    """How the members' scores become the reward."""
    train: Train = "full"
    """What a fit changes: everything, low-rank adapters and the heads (LoRA), or the heads alone."""
    lora_rank: int = Field(16, ge=1)
    """The rank of the adapters."""
    lora_targets: Literal["all-linear", "default"] = "all-linear"
    """Which matrices get an adapter: all of them, or those that peft knows as usual for the architecture."""
    pool: Literal["mean", "first"] = "mean"
    """What the heads see of an encoder: the mean over tokens, or the first. Of a causal model it is always the last,
    and the checkpoint of an encoder has its own way."""
    precision: Literal["float32", "bfloat16"] = "float32"
    """Of the backbone's products; weights, heads and scores are always float32."""

    @model_validator(mode="after")
    def _one_start(self) -> Self:
        if self.checkpoint and (self.backbone or self.members != 1):
            raise ValueError("a checkpoint brings a backbone and one head: leave backbone empty and set members to 1")
        return self

    def build(self, task: Task, rng: np.random.Generator) -> TransformerReward:
        if self.checkpoint:
            from prefrl.reward_models.io import load_classifier

            backbone, head = load_classifier(self.checkpoint, text(task, NEEDS), self.download, self.chat_template)
            reward = TransformerReward(self, backbone, rng)
            reward.start_from(head)
            return reward
        if self.backbone:
            backbone = of_folder(self.backbone, text(task, NEEDS), self.download, self.pool, bool(self.chat_template))
        else:
            backbone = of_policy(text(task, NEEDS), bool(self.chat_template), frozen=self.train != "full")
        return TransformerReward(self, backbone, rng)


class TransformerReward:
    """A `prefrl.protocols.RewardModel` of responses (Stiennon et al. 2020, section 3.4: a score at the end).

    It reads the tokens as they were sampled, the end token included, so it sees whether a response has ended; a
    backbone with another tokenizer, or with a chat template, reads the text, with an end of its own. Evaluation mode,
    no dropout. Heads start from N(0, 1 / (d + 1)).
    """

    def __init__(self, settings: TransformerSettings, backbone: Backbone, rng: np.random.Generator) -> None:
        self._settings, self.backbone = settings, backbone
        drawn = torch.randn(settings.members, backbone.width, generator=generator(rng))
        # Over sqrt(d + 1), so that scores do not start further apart the wider the backbone is.
        heads = drawn / math.sqrt(backbone.width + 1)
        self._heads, self._bias = torch.nn.Parameter(heads), torch.nn.Parameter(torch.zeros(settings.members))
        self._shift, self._scale = torch.zeros(settings.members), torch.ones(settings.members)
        self._fits, self._temperature = 0, 1.0
        backbone.model.requires_grad_(settings.train == "full")  # before adapters are added, which stay trainable
        if settings.train == "lora":
            from prefrl.policies.lora import add_adapters  # peft takes seconds to load

            add_adapters(backbone.model, settings.lora_rank, settings.lora_targets, rng, "reward")
        self._trained = trainable(backbone, settings.train)

    @property
    def members(self) -> int:
        return len(self._heads)

    @property
    def fitted(self) -> bool:
        return self._fits > 0

    def parameters(self) -> Iterable[torch.nn.Parameter]:
        return [*self._trained.values(), self._heads, self._bias]

    def to(self, device: torch.device) -> None:
        self.backbone.model.to(device)  # type: ignore[arg-type]  # transformers wraps torch's method
        for tensor in (self._heads, self._bias, self._shift, self._scale):
            tensor.data = tensor.data.to(device)

    def stack(self, candidates: Sequence[Response]) -> Mapping[str, Tensor]:
        """tokens (N, L) and lengths (N,); where only heads are trained, the backbone's features (N, d) at once.

        Raises ValueError for a candidate that is longer than the backbone's context.
        """
        if self._settings.train == "head":
            return {"features": self._in_chunks(candidates)}
        return self._padded(self.backbone.rows(candidates))

    def scores(self, stacked: Mapping[str, Tensor]) -> Tensor:
        features = stacked["features"] if "features" in stacked else self._features(stacked)
        return linear(features, self._heads, self._bias).T  # (N, E) -> (E, N)

    @torch.no_grad()
    def settle(self, stacked: Mapping[str, Tensor], loss: Callable[[Tensor], Tensor]) -> Tensor:
        count = len(next(iter(stacked.values())))
        parts = [self.scores({k: x[i : i + CHUNK] for k, x in stacked.items()}) for i in range(0, count, CHUNK)]
        scores = torch.cat(parts, 1)
        # The clamp: all scores may be equal, and rewards must stay finite.
        self._shift, self._scale = scores.mean(1), scores.std(1, correction=0).clamp(min=1e-6)
        self._fits, self._temperature = self._fits + 1, 1.0
        return scores

    def calibrate(self, temperature: float) -> None:
        self._temperature = temperature

    def raw_member_scores(self, candidates: Sequence[Response]) -> Floats:
        raw: Floats = self._scores_of(candidates) / self._temperature
        return raw

    def member_scores(self, candidates: Sequence[Response]) -> Floats:
        shift, scale = to_numpy(self._shift)[:, None], to_numpy(self._scale)[:, None]
        found: Floats = (self._scores_of(candidates) - shift) / scale
        return found

    def score(self, candidates: Sequence[Response]) -> Floats:
        found = combine(self.member_scores(candidates), self._settings.combine, self._fits)
        if np.isnan(found).any():  # which would say that there is no score
            raise FloatingPointError("a learned reward is not finite; expected finite numbers: look at its last fit")
        return found

    def features(self, candidates: Sequence[Response]) -> Floats:
        """(N, d): what the heads see, of a causal model its state at the last token."""
        return to_numpy(self._in_chunks(candidates))

    def state(self) -> State:
        """What a fit changes; of what it does not change, only a digest."""
        trained = {name: p.detach().clone() for name, p in self._trained.items()}
        heads = {"heads": self._heads.detach().clone(), "bias": self._bias.detach().clone()}
        settled = {"shift": self._shift, "scale": self._scale, "fits": self._fits, "temperature": self._temperature}
        return {"backbone": trained, "frozen": self._frozen, **heads, **settled}

    @torch.no_grad()
    def load(self, state: State) -> None:
        """Raises ValueError where names or shapes differ, or the weights that no fit changes."""
        own = {**self._trained, "heads": self._heads, "bias": self._bias}
        found = {**state["backbone"], "heads": state["heads"], "bias": state["bias"]}
        if wrong := [n for n, p in own.items() if n not in found or found[n].shape != p.shape]:
            raise ValueError(f"reward model: {wrong[0]} is missing or has another shape: it was made by other settings")
        if state["frozen"] != self._frozen:
            raise ValueError("reward model: its backbone's frozen weights are others than those it was fitted on")
        for name, parameter in own.items():
            parameter.copy_(found[name])
        self._shift, self._scale = (state[n].to(self._heads.device, copy=True) for n in ("shift", "scale"))
        self._fits, self._temperature = int(state["fits"]), float(state["temperature"])

    @torch.no_grad()
    def start_from(self, head: torch.nn.Linear) -> None:
        """Take over one head (1, d) that was fitted elsewhere, with its scores as they are."""
        self._heads.copy_(head.weight)
        if head.bias is not None:
            self._bias.copy_(head.bias)
        self._fits = 1  # it scores as it was fitted, so it counts as fitted

    @torch.no_grad()
    def mean_head(self) -> tuple[Tensor, float]:
        """The mean of the members' normalised scores is `features @ weight` (d,) plus a constant."""
        # A mean of linear heads is one linear head, so an ensemble can be exported as a single model.
        weight = (self._heads / self._scale[:, None]).mean(0)
        return weight, float(((self._bias - self._shift) / self._scale).mean())

    @cached_property
    def _frozen(self) -> str:
        return digest({n: p for n, p in self.backbone.weights().items() if n not in self._trained})

    def _features(self, stacked: Mapping[str, Tensor]) -> Tensor:
        """(N, d) float32."""
        with torch.autocast(
            stacked["tokens"].device.type, torch.bfloat16, enabled=self._settings.precision == "bfloat16"
        ):
            # Heads and scores in float32: bfloat16 near 1 moves in steps of 1/128, which would make ties.
            return self.backbone.states(stacked["tokens"], stacked["lengths"]).float()

    @torch.no_grad()
    def _scores_of(self, candidates: Sequence[Response]) -> Floats:
        return to_numpy(self.scores({"features": self._in_chunks(candidates)}))

    @torch.no_grad()
    def _in_chunks(self, candidates: Sequence[Response]) -> Tensor:
        """(N, d) features, rows of like length together."""
        rows = self.backbone.rows(candidates)
        order = sorted(range(len(rows)), key=lambda i: len(rows[i]))  # like lengths share a chunk
        chunks = [order[i : i + CHUNK] for i in range(0, len(rows), CHUNK)]
        features = torch.cat([self._features(self._padded([rows[i] for i in chunk])) for chunk in chunks])
        return features[torch.tensor(order, device=features.device).argsort()]

    def _padded(self, rows: Sequence[Sequence[int]]) -> dict[str, Tensor]:
        """Right-padded with 0, which is a valid id; lengths say what is real."""
        tokens, lengths = pad_right(rows, self._heads.device)
        return {"tokens": tokens, "lengths": lengths}
