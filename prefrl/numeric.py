"""What counts as a number in a judgement, also where NumPy made it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np


def is_whole(value: Any, most: float = math.inf) -> bool:
    """Whether a value is a whole number from 0 on, true and false not among them."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and 0 <= int(value) <= most


def check_weight(weight: float) -> None:
    """Raise `ValueError` for a weight that says nothing."""
    if not 0.0 < weight < math.inf:
        raise ValueError(f"a judgement's weight must be positive and finite, got {weight}")


def plain(value: Any) -> Any:
    """NumPy's numbers as Python's, for JSON. Raises `TypeError` for anything else."""
    if isinstance(value, np.generic):
        return value.item()
    raise TypeError(f"{type(value).__name__} cannot be written as JSON: {value!r:.200}")
