"""Arrays in files named by the id of what they belong to, as safetensors."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
from safetensors import SafetensorError
from safetensors.numpy import load, save

from prefrl.storage.files import DamagedError, write_file
from prefrl.types import Floats


def write_arrays(root: Path, id: str, arrays: dict[str, Floats]) -> None:
    """Write arrays under an id; what is there already is left alone."""
    path = _path(root, id)
    if not path.exists():
        write_file(path, save({name: np.ascontiguousarray(array) for name, array in arrays.items()}))


def read_arrays(root: Path, id: str) -> dict[str, Floats]:
    """Read what was written under an id. Raises `DamagedError` where it is missing or torn."""
    try:
        return load(_path(root, id).read_bytes())
    except (OSError, SafetensorError) as error:
        raise DamagedError(f"{_path(root, id)} cannot be read: {error}") from error


def _path(root: Path, id: str) -> Path:
    """Ids can come from files that others made: nothing but a sha256 may become part of a path."""
    if not re.fullmatch("[0-9a-f]{64}", id):
        raise DamagedError(f"{id!r} is no sha256, so it names no file")
    return root / id[:2] / f"{id}.safetensors"
