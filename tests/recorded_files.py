"""Recorded behaviour, in the files that people have."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

SEEN = np.arange(10, dtype=np.float32).reshape(5, 2)
"""Five steps of two episodes, of 2 and of 3."""
TAKEN = np.array([0, 2, 1, 1, 0])
JOINED: dict[str, Any] = {"observations": SEEN, "actions": TAKEN, "lengths": np.array([2, 3]), "rewards": SEEN[:, 0]}


def saved(path: Path, **arrays: Any) -> Path:
    np.savez(path, **arrays)
    return path


def minari_folder(path: Path, start: int = 0, form: str = "arrow") -> Path:
    """As Minari writes what an environment with discrete actions did: two episodes, of 2 steps and of 3."""
    pytest.importorskip("minari")
    from gymnasium.spaces import Box, Discrete
    from minari.data_collector import EpisodeBuffer
    from minari.dataset.minari_storage import MinariStorage

    space = Box(-np.inf, np.inf, (2,), np.float32)
    storage = MinariStorage.new(path.absolute(), space, Discrete(3, start=start), data_format=form)
    for id, (first, last) in enumerate([(0, 2), (2, 5)]):
        steps = last - first
        episode = EpisodeBuffer(
            id=id,
            observations=np.concatenate([SEEN[first:last], SEEN[:1]]),
            actions=TAKEN[first:last] + start,
            rewards=[1.0] * steps,
            terminations=[False] * (steps - 1) + [True],
            truncations=[False] * steps,
        )
        storage.update_episodes([episode])
    return path
