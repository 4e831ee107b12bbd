"""Low-rank adapters: small matrices beside a model's own, which stay as they are.

Variant: LoRA (Hu et al. 2022, section 4.1) by peft, on all linear layers by default, where the paper adapts those of
attention; scaled by 2 whatever the rank is, without dropout. Left out: biases, and frozen weights in fewer bits.
"""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import torch
from peft import LoraConfig, inject_adapter_in_model
from peft.tuners.tuners_utils import BaseTunerLayer
from transformers import PreTrainedModel

from prefrl.components import ConfigError
from prefrl.seeding import draw_seed


def add_adapters(model: PreTrainedModel, rank: int, targets: str, rng: np.random.Generator) -> None:
    """Give a model's matrices adapters (Hu et al. 2022, section 4.1), scaled by 2; they change nothing at first.

    `targets`: "all-linear", or "default" for those that peft takes for this architecture.
    """
    chosen = "all-linear" if targets == "all-linear" else None
    # No dropout: the scores of one response must not differ between passes.
    config = LoraConfig(r=rank, lora_alpha=2 * rank, lora_dropout=0.0, target_modules=chosen)
    # peft draws from torch's global generator.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(draw_seed(rng))
        try:
            inject_adapter_in_model(config, model)
        except ValueError as error:
            kind = model.config.model_type
            raise ConfigError(f"reward.lora_targets={targets} does not suit a {kind}: {error}") from error
    model.eval()  # type: ignore[no-untyped-call]


def merged(model: PreTrainedModel) -> PreTrainedModel:
    """A copy with its adapters, if it has any, added to its own matrices."""
    found = copy.deepcopy(model)  # the original goes on being fitted, with its adapters apart
    for name, module in list(found.named_modules()):
        if isinstance(module, BaseTunerLayer):
            layer: Any = module
            layer.merge()
            found.set_submodule(name, layer.get_base_layer())
    return found
