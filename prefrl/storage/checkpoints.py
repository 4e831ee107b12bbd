"""States without pickle: nested dicts of arrays and plain values, as safetensors + JSON; and a run's newest one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.torch import load as load_tensors
from safetensors.torch import save as save_tensors

from prefrl.storage.files import MANIFEST, DamagedError, verify, write_file
from prefrl.types import State


def save_state(folder: Path, name: str, state: State) -> None:
    """Write a nested state as `<name>.safetensors` (its arrays) and `<name>.json` (its shape and everything else)."""
    tensors: dict[str, torch.Tensor] = {}
    outline = _split(state, name, tensors)
    write_file(folder / f"{name}.safetensors", save_tensors(tensors))
    write_file(folder / f"{name}.json", json.dumps(outline, indent=1, allow_nan=True).encode())


def load_state(folder: Path, name: str) -> State:
    """Read back what `save_state` wrote. Raises `DamagedError` on anything else."""
    try:
        tensors = load_tensors((folder / f"{name}.safetensors").read_bytes())
        outline = json.loads((folder / f"{name}.json").read_text())
        state = _join(outline, tensors)
    except (OSError, ValueError, KeyError, SafetensorError) as error:
        raise DamagedError(f"{folder} holds no state {name!r}: {error}") from error
    if not isinstance(state, dict):
        raise DamagedError(f"{folder}/{name}.json: expected an object, got {type(state).__name__}")
    return state


def checkpoints(folder: Path) -> list[Path]:
    """Those of a run, newest first."""
    return sorted(folder.glob("checkpoints/round-*"), key=lambda p: int(p.name.removeprefix("round-")), reverse=True)


def newest(folder: Path) -> tuple[Path, list[str]]:
    """The newest good checkpoint of a run (or the folder itself, if it is one), and what was wrong with newer ones.

    Raises `DamagedError` where there is none.
    """
    damaged = []
    found = checkpoints(folder) or [folder] * (folder / MANIFEST).exists()
    if not found:
        raise DamagedError(f"{folder} holds neither a run with a checkpoint nor a saved model")
    for checkpoint in found:
        try:
            verify(checkpoint)
        except DamagedError as error:
            damaged.append(str(error))
        else:
            return checkpoint, damaged
    raise DamagedError(f"{folder} holds no checkpoint that can be used: {'; '.join(damaged)}")


def _split(value: Any, path: str, tensors: dict[str, torch.Tensor]) -> Any:
    """Move arrays out of a nested value, leaving {"$tensor": path} (or "$array" for NumPy) in their place."""
    if isinstance(value, torch.Tensor):
        tensors[path] = value.detach().cpu().clone().contiguous()  # safetensors refuses tensors that share memory
        return {"$tensor": path}
    if isinstance(value, np.ndarray):
        # Reshaped, since ascontiguousarray makes a row of an array without axes.
        tensors[path] = torch.from_numpy(np.ascontiguousarray(value).copy()).reshape(value.shape)
        return {"$array": path}
    if isinstance(value, np.generic):
        return value.item()
    if isinstance(value, dict):
        # Pairs, not an object: optimiser states have integer keys, which JSON objects would turn into strings.
        return {"$dict": [[k, _split(v, f"{path}.{k}", tensors)] for k, v in value.items()]}
    if isinstance(value, list | tuple):
        return [_split(v, f"{path}.{i}", tensors) for i, v in enumerate(value)]
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(
        f"{path}: a state holds dicts, lists, arrays, tensors, numbers, strings and None, got {type(value)}"
    )


def _join(outline: Any, tensors: dict[str, torch.Tensor]) -> Any:
    if isinstance(outline, list):
        return [_join(v, tensors) for v in outline]
    if isinstance(outline, dict):
        (mark, inner), *_ = outline.items()
        if mark == "$tensor":
            return tensors[inner]
        if mark == "$array":
            return tensors[inner].numpy()
        return {k: _join(v, tensors) for k, v in inner}
    return outline
