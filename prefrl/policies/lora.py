"""Low-rank adapters: small matrices beside a model's own, which stay as they are.

Variant: LoRA (Hu et al. 2022, section 4.1) by peft, on all linear layers by default, where the paper adapts those of
attention; scaled by 2 whatever the rank is, without dropout. Left out: biases, and frozen weights in fewer bits.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import torch
from peft import LoraConfig, PeftConfig, PeftModel, inject_adapter_in_model
from peft.tuners.tuners_utils import BaseTunerLayer
from safetensors.numpy import save_file
from transformers import AutoModelForCausalLM, PreTrainedModel, PreTrainedTokenizerBase
from transformers.pytorch_utils import Conv1D

from prefrl.components import ConfigError
from prefrl.policies.pretrained import Precision, load_tokenizer, load_weights
from prefrl.seeding import draw_seed, to_numpy


def add_adapters(model: PreTrainedModel, rank: int, targets: str, rng: np.random.Generator, role: str) -> None:
    """Give a model's matrices adapters, scaled by 2; they change nothing at first.

    `targets`: "all-linear", or "default" for those that peft takes for this architecture; `role`: whose setting it is,
    "reward" or "learner.policy". Everything else is frozen; adapters are float32, whatever the model is.
    """
    chosen = "all-linear" if targets == "all-linear" else None
    # No dropout: what a network says of one response must not differ between passes.
    config = LoraConfig(
        r=rank, lora_alpha=2 * rank, lora_dropout=0.0, target_modules=chosen, fan_in_fan_out=_turned_round(model)
    )
    model.requires_grad_(False)
    # peft draws from torch's global generator.
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(draw_seed(rng))
        try:
            inject_adapter_in_model(config, model)
        except ValueError as error:
            kind = model.config.model_type
            raise ConfigError(f"{role}.lora_targets={targets} does not suit a {kind}: {error}") from error
    for parameter in model.parameters():
        if parameter.requires_grad:
            parameter.data = parameter.data.float()  # small steps would be lost in half precision
    model.eval()  # type: ignore[no-untyped-call]


def _turned_round(model: PreTrainedModel) -> bool:
    """Whether a model keeps its matrices as (in, out), as GPT-2 does."""
    return any(isinstance(module, Conv1D) for module in model.modules())


@contextmanager
def without_adapters(model: torch.nn.Module) -> Iterator[None]:
    """The model as it was before it got adapters."""
    layers = [module for module in model.modules() if isinstance(module, BaseTunerLayer)]
    for layer in layers:
        layer.enable_adapters(False)
    try:
        yield
    finally:
        for layer in layers:
            layer.enable_adapters(True)  # which makes them trainable again


def save_adapters(model: PreTrainedModel, folder: Path) -> None:
    """Write the adapters alone, as peft's `PeftModel.from_pretrained` reads them. Raises `ConfigError` without any."""
    found = {name: to_numpy(p) for name, p in model.named_parameters() if "lora_" in name}
    if not found:
        raise ConfigError("the policy has no adapters to export: it was trained whole (learner.policy.train=full)")
    layers = {n: m for n, m in model.named_modules() if isinstance(m, BaseTunerLayer)}
    rank = next(len(p) for name, p in found.items() if "lora_A" in name)
    base = model.config._name_or_path or None
    base = str(Path(base).resolve()) if base and Path(base).exists() else base  # wherever it is loaded from later
    config = LoraConfig(
        r=rank,
        lora_alpha=2 * rank,
        lora_dropout=0.0,
        target_modules=sorted(layers),
        fan_in_fan_out=_turned_round(model),
        task_type="CAUSAL_LM",
        base_model_name_or_path=base,
    )
    config.inference_mode = True
    config.save_pretrained(str(folder))
    named = {f"base_model.model.{name.replace('.default.', '.')}": p for name, p in found.items()}
    save_file(named, folder / "adapter_model.safetensors", {"format": "pt"})


def load_merged(folder: Path, dtype: Precision) -> tuple[PreTrainedModel, PreTrainedTokenizerBase]:
    """The model that an adapter was trained on, the adapter added to its matrices, and a tokenizer.

    What is learned from there on gets adapters of its own, so that the reference is the model with the first ones.
    Raises `ConfigError` where the model is not on this machine.
    """
    settings = PeftConfig.from_pretrained(str(folder))
    base = Path(settings.base_model_name_or_path or "")
    if not settings.base_model_name_or_path or not base.exists():
        raise ConfigError(
            f"{folder} is an adapter of {settings.base_model_name_or_path!r}, which is no folder here: say where it is "
            "as base_model_name_or_path in its adapter_config.json"
        )
    if (base / "adapter_config.json").exists():
        under = load_merged(base, dtype)[0]
    else:
        under = load_weights(AutoModelForCausalLM, base, False, dtype=dtype)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FutureWarning)  # peft asks the model for what transformers will rename
        adapted: Any = PeftModel.from_pretrained(under, str(folder))
    found: PreTrainedModel = adapted.merge_and_unload().eval().requires_grad_(True)  # peft has frozen it
    found.config._name_or_path = str(folder)
    own = (folder / "tokenizer_config.json").exists()
    return found, load_tokenizer(folder if own else base, False)


def merged(model: PreTrainedModel) -> PreTrainedModel:
    """A copy with its adapters, if it has any, added to its own matrices."""
    found = copy.deepcopy(model)  # the original goes on being fitted, with its adapters apart
    for name, module in list(found.named_modules()):
        if isinstance(module, BaseTunerLayer):
            module.merge()
            found.set_submodule(name, module.get_base_layer())
    return found
