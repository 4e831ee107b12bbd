"""Outputs that look back: each step sees at most `memory` steps of its own episode, itself the last."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor


def looking_back(
    outputs: Callable[[Tensor], Tensor], inputs: Tensor, begins: np.ndarray, memory: int, most: int
) -> Tensor:
    """(E, S) outputs for steps (S, I) of episodes that start where `begins` (S,) says; the first step starts one.

    `outputs` maps (B, T, I), T <= memory, to (E, B, T) and lets no step see a later one. An episode's first `memory`
    steps are one row; each later step is the last of a row of its own. About `most` steps go through at once.
    """
    start, length, new = windows(begins, memory)
    found, places = list[Tensor](), list[np.ndarray]()
    rows = max(1, most // memory)
    for i in range(0, len(start), rows):
        part = slice(i, i + rows)
        at = np.arange(length[part].max())
        steps = np.minimum(start[part, None] + at, len(inputs) - 1)  # what lies beyond a row's end is not taken
        taken = (at < length[part, None]) & (at >= (length - new)[part, None])
        found.append(outputs(inputs[torch.from_numpy(steps)])[:, torch.from_numpy(taken)])
        places.append(steps[taken])
    return torch.cat(found, 1)[:, torch.from_numpy(np.concatenate(places).argsort())]


def windows(begins: np.ndarray, memory: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Rows of at most `memory` steps that show each step once with all it may see.

    Returns where each row starts (W,), its length (W,), and of how many of its last steps the output is new (W,).
    """
    at = np.arange(len(begins))
    heads = np.flatnonzero(begins | (at == 0))
    ends = np.append(heads[1:], len(begins))
    age = at - np.repeat(heads, ends - heads)
    late = np.flatnonzero(age >= memory)
    length = np.concatenate([np.minimum(ends - heads, memory), np.full(len(late), memory)])
    new = np.concatenate([length[: len(heads)], np.ones(len(late), np.int64)])
    return np.concatenate([heads, late - memory + 1]), length, new
