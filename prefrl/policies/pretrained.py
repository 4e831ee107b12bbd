"""Models and tokenizers that others made, from a folder or by name: safetensors alone, and nobody's code."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, TypeAlias, TypeVar

import torch
from transformers import AutoModel, AutoTokenizer, PreTrainedModel, PreTrainedTokenizerBase
from transformers.utils.logging import (
    disable_progress_bar,
    enable_progress_bar,
    get_verbosity,
    is_progress_bar_enabled,
    set_verbosity,
    set_verbosity_error,
)

from prefrl.components import ConfigError

M = TypeVar("M", bound=PreTrainedModel)
NAMED = 40
"""So many characters of a prompt say which one a message is about."""
Precision: TypeAlias = Literal["float32", "bfloat16"]


def load_weights(
    auto: Any, name: str | Path, download: bool, switch: str = "", dtype: Precision = "float32"
) -> PreTrainedModel:
    """A model of a transformers class, dropout off. Raises `ConfigError` where weights are missing.

    A path to a .gguf file is one that transformers unpacks. `download`: whether a name may be looked up on the Hub;
    `switch`: the setting that allows it, for the advice.
    """
    try:
        with quiet():
            model, info = auto.from_pretrained(
                dtype=getattr(torch, dtype), use_safetensors=True, output_loading_info=True, **_where(name, download)
            )
    except ImportError as error:
        advice = "; run: pip install 'prefrl[gguf]'" if Path(name).suffix == ".gguf" else ""
        raise ConfigError(f"{name}: {first_line(error)}{advice}") from error
    except (OSError, ValueError) as error:
        local = switch and not download
        hint = f"only local files are looked at unless {switch} is true" if local else first_line(error)
        raise ConfigError(f"no model in safetensors could be read from {str(name)!r}: {hint}") from error
    headless = auto is AutoModel  # then nothing reads a pooler
    # transformers fills what is missing with random numbers and only warns.
    if missing := sorted(k for k in info["missing_keys"] if not (headless and "pooler" in k)):
        raise ConfigError(f"{name}: weights are missing, {missing[0]} for one: expected a complete checkpoint")
    found: PreTrainedModel = model
    if Path(name).suffix == ".gguf":
        # Its weights are whole numbers of floats by now, and can be trained and saved like any others.
        model.hf_quantizer = None
        del model.config.quantization_config
    return found


def load_tokenizer(name: str | Path, download: bool) -> PreTrainedTokenizerBase:
    """The tokenizer beside a model. Raises `ConfigError` where there is none."""
    try:
        with quiet():
            found: PreTrainedTokenizerBase = AutoTokenizer.from_pretrained(**_where(name, download))
    except (OSError, ValueError) as error:
        raise ConfigError(f"no tokenizer could be read from {str(name)!r}: {first_line(error)}") from error
    return found


def _where(name: str | Path, download: bool) -> dict[str, Any]:
    """Where to look, and that no code is run from there."""
    path, safe = Path(name), {"local_files_only": not download, "trust_remote_code": False}
    if path.suffix == ".gguf" and path.is_file():
        return {"pretrained_model_name_or_path": path.parent, "gguf_file": path.name, **safe}
    return {"pretrained_model_name_or_path": name, **safe}


def on_same_weights(model: M) -> M:
    """Another model on the very same weights, which it does not train."""
    # What the copy is told to have copied already; tied weights stay tied.
    known = {id(p): torch.nn.Parameter(p.detach(), requires_grad=False) for p in model.parameters()}
    return copy.deepcopy(model, known)


def context_of(model: PreTrainedModel) -> int | None:
    """The most tokens that a model has positions for; some architectures have no bound."""
    known = getattr(model.config, "max_position_embeddings", None)
    return None if known is None else int(known)


WINDOWS = ("sliding_window", "window_size", "attention_chunk_size")
"""What configs of transformers call it."""


def window_of(model: PreTrainedModel) -> int | None:
    """How many tokens back a token looks, where some layer's attention has such a window."""
    found = [size for name in WINDOWS if isinstance(size := getattr(model.config, name, None), int) and size > 0]
    return min(found, default=None)


def beginning(prompt: str) -> str:
    """Which prompt a message is about, in brackets after a space; nothing where there is none."""
    return f" (its prompt begins {prompt[:NAMED]!r})" if prompt else ""


def first_line(error: Exception) -> str:
    """What went wrong; the advice that libraries add is for others."""
    return str(error).strip().partition("\n")[0]


@contextmanager
def quiet() -> Iterator[None]:
    """Keep transformers from drawing bars, and from reporting on the head that is left out."""
    shown, verbosity = is_progress_bar_enabled(), get_verbosity()
    disable_progress_bar()  # type: ignore[no-untyped-call]
    set_verbosity_error()  # type: ignore[no-untyped-call]
    try:
        yield
    finally:
        set_verbosity(verbosity)
        if shown:
            enable_progress_bar()  # type: ignore[no-untyped-call]
