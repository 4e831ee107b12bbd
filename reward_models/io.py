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
from prefrl.files import whole_folder, write_file
from prefrl.protocols import TextTask
from prefrl.reward_models.backbone import end_token, load_tokenizer, load_weights, of_classifier, quiet
from prefrl.reward_models.text import TransformerReward, TransformerSettings

PAD = "<|pad|>"
"""Added to a tokenizer whose padding could be taken for the end of a response."""


def load_classifier(
    name: str, task: TextTask, settings: TransformerSettings, rng: np.random.Generator
) -> TransformerReward:
    """A reward model of one member from an `AutoModelForSequenceClassification` checkpoint: its scores are its logits.

    Raises `ConfigError` unless it has one label and one linear head on the last token.
    """
    model: Any = load_weights(AutoModelForSequenceClassification, name, settings.download)
    if model.config.num_labels != 1:
        raise ConfigError(f"{name} tells {model.config.num_labels} labels apart; a reward model has num_labels=1")
    head: Any = dict(model.named_children()).get("score")
    if not isinstance(head, torch.nn.Linear) or [name for name, _ in head.named_parameters()] != ["weight"]:
        raise ConfigError(f"{name} is a {model.config.model_type} without a linear head `score`: use it as a backbone")
    backbone = of_classifier(model.base_model, load_tokenizer(name, settings.download), task)
    reward = TransformerReward(settings, backbone, rng)
    reward.start_from(head.weight)
    return reward


def save_classifier(reward: TransformerReward, folder: Path) -> float:
    """Write a reward model as an `AutoModelForSequenceClassification` checkpoint with its tokenizer.

    Its logit is the mean of the members after shift and scale, less a constant, since such heads have no bias; the
    constant is returned. Adapters are merged. Padding gets a token of its own where it is missing, or is the end
    token: classifiers look for the last token that is no padding. Raises ValueError for an encoder.
    """
    if reward.backbone.pool != "last":
        kind = reward.backbone.model.config.model_type
        raise ValueError(
            f"a {kind} is an encoder, whose classifiers have deeper heads: only causal models are exported"
        )
    tokenizer = copy.deepcopy(reward.backbone.tokenizer)
    weight, constant = reward.mean_head()
    model = _classifier(_without_adapters(reward.backbone.model), weight)
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
    config.num_labels, config._attn_implementation = 1, "sdpa"
    with torch.random.fork_rng(devices=[]):
        model: Any = AutoModelForSequenceClassification.from_config(config)  # type: ignore[no-untyped-call]
    model.base_model.load_state_dict(backbone.state_dict())
    model.score.weight.data.copy_(weight[None])
    found: PreTrainedModel = model
    return found


def _give_padding(model: Any, tokenizer: PreTrainedTokenizerBase) -> None:
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


def write_rewardbench(folder: Path, model: str, rows: Sequence[ScoredPair]) -> dict[str, float]:
    """Write scores as RewardBench (Lambert et al. 2024) keeps its results; returns each subset's accuracy.

    `eval-set-scores/MODEL.json` has a list for each column, `eval-set/MODEL.json` the accuracies; a tie is an error.
    Raises ValueError for a score that is not finite, and where there are no rows.
    """
    path = f"{model}.json"
    if not rows or not model or ".." in Path(path).parts or Path(path).is_absolute():
        raise ValueError(f"expected a model's name and at least one row, got {model!r} and {len(rows)} rows")
    if bad := [r.id for r in rows if not (math.isfinite(r.score_chosen) and math.isfinite(r.score_rejected))]:
        raise ValueError(f"RewardBench row {bad[0]}: expected finite scores, got NaN or infinity")
    about = {"model": model, "model_type": "Seq. Classifier", "chat_template": "none"}
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
