"""Whole episodes of a policy, drawn."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from prefrl.policies.rollout import Act, whole_episodes
from prefrl.protocols import ControlTask
from prefrl.sample.segments import segment


class Episode(NamedTuple):
    """One of them."""

    frames: np.ndarray
    """(T, H, W, 3) uint8, one for each step."""
    gold: float
    """The task's own return."""


def filmed(task: ControlTask, act: Act, episodes: int, rng: np.random.Generator) -> Iterator[Episode]:
    """Episodes, one after another, as a segment's clip is drawn. Raises ValueError where a task cannot be drawn."""
    for number in range(episodes):
        rollout = whole_episodes(task, act, 1, rng)
        steps = int(rollout.ends[0].argmax()) + 1  # the row may go on after its first end
        whole = segment(rollout, 0, 0, steps, f"film {number}")
        try:
            frames = task.frames(whole)
        except RuntimeError as error:  # no OpenGL, say
            raise ValueError(str(error)) from error
        yield Episode(frames, float(rollout.gold[0, :steps].sum()))


__all__ = ["Episode", "filmed"]
