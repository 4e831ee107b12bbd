"""Reward models as others keep them: sequence classifiers of transformers."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import torch
from transformers import AutoModelForSequenceClassification, PreTrainedModel, PreTrainedTokenizerBase

from prefrl.components import ConfigError
from prefrl.policies.language import merged_of
from prefrl.policies.pretrained import load_tokenizer, load_weights, quiet
from prefrl.protocols import TextTask
from prefrl.reward_models.backbone import (
    Backbone,
    end_token,
    is_encoder,
    of_classifier,
)
from prefrl.reward_models.packing import ATTENTION
from prefrl.storage.files import whole_folder

PAD = "<|pad|>"
"""Added to a tokenizer whose padding could be taken for the end of a response."""


def load_classifier(
    name: str, task: TextTask, download: bool, chat_template: bool | None
) -> tuple[Backbone, torch.nn.Linear]:
    """The backbone and the head (1, d) of an `AutoModelForSequenceClassification` checkpoint; its logits are the score.

    `chat_template`: whether it reads by one; None where its tokenizer decides. Raises `ConfigError` unless it has one
    label, and is a causal model with one linear head on the last token or an encoder that ends in one linear layer,
    whatever it has before that.
    """
    model: Any = load_weights(AutoModelForSequenceClassification, name, download, "reward.download")
    if model.config.num_labels != 1:
        raise ConfigError(f"{name} tells {model.config.num_labels} labels apart; a reward model has num_labels=1")
    path, tokenizer = _last_layer(model, name), load_tokenizer(name, download)
    # Before the last layer is taken off below, which would change what the model itself says.
    head, alone = model.get_submodule(path), _logit(model) if is_encoder(model) else None
    chat = tokenizer.chat_template is not None if chat_template is None else chat_template
    backbone = of_classifier(model, path, tokenizer, task, chat)
    if alone is not None and not torch.allclose(_padded_logit(backbone, head), alone, rtol=1e-4, atol=1e-5):
        raise ConfigError(
            f"{name}: the score of a {type(model).__name__} hangs on padding, or is not what its last linear layer "
            f"`{path}` says; use it as a backbone"
        )
    return backbone, head


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


def save_classifier(backbone: Backbone, weight: torch.Tensor, constant: float, folder: Path) -> float:
    """Write a reward model as an `AutoModelForSequenceClassification` checkpoint with its tokenizer.

    Its logit is the head's, `features @ weight` (d,) plus a constant, less that constant where such heads have no bias,
    as those of causal models; what is missing is returned. Adapters are merged. A chat template is written only if the
    model reads by it. Raises ValueError for an encoder that did not come from a checkpoint.
    """
    if backbone.pool not in ("last", "own"):
        raise ValueError(
            f"a {backbone.model.config.model_type} is an encoder, whose classifiers have deeper heads than ours: only "
            "causal models, and encoders that came from a reward.checkpoint, are exported"
        )
    # A copy: the tokenizer that the fitted model reads with must not get a padding token, or lose its template.
    tokenizer, model = copy.deepcopy(backbone.tokenizer), merged_of(backbone.model)
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


def _classifier(backbone: PreTrainedModel, weight: torch.Tensor) -> PreTrainedModel:
    """The backbone under one linear head (d,)."""
    config = copy.deepcopy(backbone.config)
    config.num_labels = 1
    if config._attn_implementation == ATTENTION:
        config._attn_implementation = None  # whatever the architecture has by default
    with torch.random.fork_rng(devices=[]):  # its random head is overwritten, and must not move the global generator
        model: Any = AutoModelForSequenceClassification.from_config(config)  # type: ignore[no-untyped-call]
    model.base_model.load_state_dict(backbone.state_dict())
    model.score.weight.data.copy_(weight[None])
    found: PreTrainedModel = model
    return found


def _closed(model: PreTrainedModel, path: str, weight: torch.Tensor, bias: float) -> PreTrainedModel:
    """A copy of an encoder's classifier with a last layer again: (d,) and a number."""
    found = copy.deepcopy(model)
    # Draws no random numbers for what is overwritten at once.
    head = torch.nn.utils.skip_init(torch.nn.Linear, len(weight), 1)  # type: ignore[no-untyped-call]
    head.weight.data.copy_(weight[None])
    head.bias.data.fill_(bias)
    found.set_submodule(path, head)
    return found


def _give_padding(model: Any, tokenizer: PreTrainedTokenizerBase) -> None:
    """Of its own where it is missing or is the end: causal classifiers look for the last token that is no padding."""
    if tokenizer.pad_token_id is None or tokenizer.pad_token_id == end_token(tokenizer):
        tokenizer.add_special_tokens({"pad_token": PAD})
        if len(tokenizer) > model.get_input_embeddings().weight.shape[0]:  # some models have rows to spare
            model.resize_token_embeddings(len(tokenizer), mean_resizing=False)
    model.config.pad_token_id = tokenizer.pad_token_id
