"""Reward models as others keep them: sequence classifiers of transformers, and the files of RewardBench."""

from __future__ import annotations

import copy
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from transformers import AutoModelForSequenceClassification, PreTrainedModel, PreTrainedTokenizerBase

from prefrl.components import ConfigError
from prefrl.protocols import TextTask
from prefrl.reward_models.backbone import (
    Backbone,
    end_token,
    is_encoder,
    load_tokenizer,
    load_weights,
    of_classifier,
    quiet,
)
from prefrl.reward_models.packing import ATTENTION
from prefrl.reward_models.text import TransformerReward, TransformerSettings
from prefrl.storage.files import whole_folder, write_file

PAD = "<|pad|>"
"""Added to a tokenizer whose padding could be taken for the end of a response."""


def load_classifier(
    name: str, task: TextTask, settings: TransformerSettings, rng: np.random.Generator
) -> TransformerReward:
    """A reward model of one member from an `AutoModelForSequenceClassification` checkpoint: its scores are its logits.

    Raises `ConfigError` unless it has one label, and is a causal model with one linear head on the last token or an
    encoder that ends in one linear layer, whatever it has before that.
    """
    model: Any = load_weights(AutoModelForSequenceClassification, name, settings.download)
    if model.config.num_labels != 1:
        raise ConfigError(f"{name} tells {model.config.num_labels} labels apart; a reward model has num_labels=1")
    path, tokenizer = _last_layer(model, name), load_tokenizer(name, settings.download)
    head, alone = model.get_submodule(path), _logit(model) if is_encoder(model) else None
    chat = tokenizer.chat_template is not None if settings.chat_template is None else settings.chat_template
    backbone = of_classifier(model, path, tokenizer, task, chat)
    if alone is not None and not torch.allclose(_padded_logit(backbone, head), alone, rtol=1e-4, atol=1e-5):
        raise ConfigError(
            f"{name}: the score of a {type(model).__name__} hangs on padding, or is not what its last linear layer "
            f"`{path}` says; use it as a backbone"
        )
    reward = TransformerReward(settings, backbone, rng)
    reward.start_from(head)
    return reward


def _last_layer(model: Any, name: str) -> str:
    """The path of the linear layer that makes the score."""
    inner = set(model.base_model.modules())
    layers = ((path, m) for path, m in model.named_modules() if m not in inner)
    found: list[str] = [path for path, m in layers if isinstance(m, torch.nn.Linear) and m.out_features == 1]
    if len(found) != 1 or not (is_encoder(model) or found[0] == "score"):
        raise ConfigError(
            f"{name} is a {type(model).__name__}: expected a causal model with one linear layer `score`, or an encoder "
            "that ends in one linear layer; use it as a backbone"
        )
    return found[0]


PROBE = torch.tensor([[2, 3, 4, 0, 0, 0], [2, 3, 4, 5, 6, 7]])
"""Two rows: the first one is three tokens and padding."""


@torch.no_grad()
def _logit(model: Any) -> torch.Tensor:
    """What transformers' own class says of the first row, on its own."""
    found: torch.Tensor = model(input_ids=PROBE[:1, :3], attention_mask=torch.ones(1, 3).long()).logits
    return found


@torch.no_grad()
def _padded_logit(backbone: Backbone, head: torch.nn.Module) -> torch.Tensor:
    """What a head on our features says of it, beside a longer row."""
    found: torch.Tensor = head(backbone.states(PROBE, torch.tensor([3, 6])))
    return found[:1]


def save_classifier(reward: TransformerReward, folder: Path) -> float:
    """Write a reward model as an `AutoModelForSequenceClassification` checkpoint with its tokenizer.

    Its logit is the mean of the members after shift and scale, less a constant where such heads have no bias, as those
    of causal models; the constant is returned. Adapters are merged. A chat template is written only if the model reads
    by it. Raises ValueError for an encoder that did not come from a checkpoint.
    """
    backbone, (weight, constant) = reward.backbone, reward.mean_head()
    if backbone.pool not in ("last", "own"):
        raise ValueError(
            f"a {backbone.model.config.model_type} is an encoder, whose classifiers have deeper heads than ours: only "
            "causal models, and encoders that came from a reward.checkpoint, are exported"
        )
    tokenizer, model = copy.deepcopy(backbone.tokenizer), _without_adapters(backbone.model)
    if not backbone.chat:
        tokenizer.chat_template = None
    if backbone.pool == "own":
        model, constant = _closed(model, backbone.head, weight, constant), 0.0
    else:
        model = _classifier(model, weight)
        _give_padding(model, tokenizer)
    with whole_folder(folder) as work, quiet():
        model.save_pretrained(work)
        tokenizer.save_pretrained(work)
    return constant


def _without_adapters(model: PreTrainedModel) -> PreTrainedModel:
    if not any("lora_" in name for name, _ in model.named_parameters()):
        return model
    from prefrl.reward_models.lora import merged  # peft takes seconds to load

    return merged(model)


def _classifier(backbone: PreTrainedModel, weight: torch.Tensor) -> PreTrainedModel:
    """The backbone under one linear head (d,)."""
    config = copy.deepcopy(backbone.config)
    config.num_labels = 1
    if config._attn_implementation == ATTENTION:
        config._attn_implementation = None  # whatever the architecture has by default
    with torch.random.fork_rng(devices=[]):
        model: Any = AutoModelForSequenceClassification.from_config(config)  # type: ignore[no-untyped-call]
    model.base_model.load_state_dict(backbone.state_dict())
    model.score.weight.data.copy_(weight[None])
    found: PreTrainedModel = model
    return found


def _closed(model: PreTrainedModel, path: str, weight: torch.Tensor, bias: float) -> PreTrainedModel:
    """A copy of an encoder's classifier with a last layer again: (d,) and a number."""
    found = copy.deepcopy(model)
    head = torch.nn.utils.skip_init(torch.nn.Linear, len(weight), 1)  # type: ignore[no-untyped-call]
    head.weight.data.copy_(weight[None])
    head.bias.data.fill_(bias)
    found.set_submodule(path, head)
    return found


def _give_padding(model: Any, tokenizer: PreTrainedTokenizerBase) -> None:
    """Of its own where it is missing or is the end: causal classifiers look for the last token that is no padding."""
    if tokenizer.pad_token_id is None or tokenizer.pad_token_id == end_token(tokenizer):
        tokenizer.add_special_tokens({"pad_token": PAD})
        if len(tokenizer) > model.get_input_embeddings().weight.shape[0]:
            model.resize_token_embeddings(len(tokenizer), mean_resizing=False)
    model.config.pad_token_id = tokenizer.pad_token_id


class ScoredPair(NamedTuple):
    """One row of a benchmark: two texts, the better one first, and what a reward model says of them."""

    id: int
    subset: str
    text_chosen: str
    text_rejected: str
    score_chosen: float
    score_rejected: float


def write_rewardbench(folder: Path, model: str, rows: Sequence[ScoredPair], chat: bool = False) -> dict[str, float]:
    """Write scores as RewardBench (Lambert et al. 2024) keeps its results; returns each subset's accuracy.

    `eval-set-scores/MODEL.json` has a list for each column, `eval-set/MODEL.json` the accuracies; a tie is an error.
    `chat`: the texts were scored in the chat template of the model's tokenizer.
    Raises ValueError for a score that is not finite, and where there are no rows.
    """
    path = f"{model}.json"
    if not rows or not model or ".." in Path(path).parts or Path(path).is_absolute():
        raise ValueError(f"expected a model's name and at least one row, got {model!r} and {len(rows)} rows")
    if bad := [r.id for r in rows if not (math.isfinite(r.score_chosen) and math.isfinite(r.score_rejected))]:
        raise ValueError(f"RewardBench row {bad[0]}: expected finite scores, got NaN or infinity")
    about = {"model": model, "model_type": "Seq. Classifier", "chat_template": "tokenizer" if chat else "none"}
    right = [int(r.score_chosen > r.score_rejected) for r in rows]
    subsets = sorted({r.subset for r in rows})
    accuracy = {s: float(np.mean([c for r, c in zip(rows, right, strict=True) if r.subset == s])) for s in subsets}
    _write_json(folder / "eval-set-scores" / path, about | _columns(rows) | {"results": right})
    _write_json(folder / "eval-set" / path, about | accuracy)
    return accuracy


def _columns(rows: Sequence[ScoredPair]) -> dict[str, list[Any]]:
    names = ("id", "subset", "text_chosen", "text_rejected", "scores_chosen", "scores_rejected")
    return {name: list(column) for name, column in zip(names, zip(*rows, strict=True), strict=True)}


def _write_json(path: Path, content: dict[str, Any]) -> None:
    write_file(path, json.dumps(content, indent=4, sort_keys=True).encode())
