"""Segments, comparisons and labelers with a planted reward, for benchmarks of reward fitting."""

from __future__ import annotations

from typing import Any

import numpy as np

from prefrl.judgements import Comparison, Judged
from prefrl.reward_models.mlp import MLPSettings
from prefrl.types import Query, Segment

STEPS, OBSERVATION, ACTION, HIDDEN = 25, 6, 2, 32


class Task:
    """Enough of a control task to build a reward model."""

    name, kind, segment_steps, action_bounds = "planted", "control", STEPS, None
    observation_size, action_size = OBSERVATION, ACTION


STEEPNESS = {"linear": 1.0, "network": 1.0, "steep network": 2.1}
"""Standard deviation of what goes into a hidden unit: at 1 a tanh begins to bend, at 2 it saturates."""


class Planted:
    """A random reward over (observation, action), linear or a tanh network with one hidden layer."""

    def __init__(self, form: str, rng: np.random.Generator) -> None:
        size = OBSERVATION + ACTION
        self.linear = form == "linear"
        each = STEEPNESS[form] / np.sqrt(2 * size)  # inputs have variance 2
        self.first = rng.normal(size=(size, size if self.linear else HIDDEN)) * each
        self.last = rng.normal(size=self.first.shape[1]) / np.sqrt(self.first.shape[1])

    def score(self, segment: Segment) -> float:
        """The sum of a segment's rewards."""
        inside = np.concatenate([segment.observations, segment.actions], 1) @ self.first
        return float(((inside if self.linear else np.tanh(inside)) @ self.last).sum())


def segments(count: int, rng: np.random.Generator) -> list[Segment]:
    """Steps scatter about a mean of each segment's own, as they do in an episode; no two segments share a step."""
    found = []
    for _ in range(count):
        x = rng.normal(size=(1, OBSERVATION + ACTION)) + rng.normal(size=(STEPS, OBSERVATION + ACTION))
        x = x.astype(np.float32)
        found.append(Segment(x[:, :OBSERVATION], x[:, OBSERVATION:], str(rng.integers(2**60)), 0))
    return found


def compare(
    planted: Planted, count: int, mistakes: float, labeler: str, rng: np.random.Generator
) -> list[Judged[Segment]]:
    """Comparisons of fresh segments by a labeler who is wrong with a given probability."""
    judged = []
    for _ in range(count):
        query = Query(tuple(segments(2, rng)))
        first, second = (planted.score(c) for c in query.candidates)
        right = float(first > second)
        judged.append(Judged(query, Comparison(query.id, 1 - right if rng.random() < mistakes else right, labeler)))
    return judged


def model(members: int, rng: np.random.Generator, **settings: Any) -> Any:
    return MLPSettings(members=members, **settings).build(Task(), rng)


def agreement(reward: Any, planted: Planted, rng: np.random.Generator, count: int = 2000) -> tuple[float, float]:
    """Correlation of learned with planted scores, and the share of pairs in the same order, on fresh segments."""
    fresh = segments(count, rng)
    gold, learned = np.array([planted.score(s) for s in fresh]), reward.score(fresh)
    half = count // 2
    same = np.sign(gold[:half] - gold[half:]) == np.sign(learned[:half] - learned[half:])
    return float(np.corrcoef(gold, learned)[0, 1]), float(same.mean())
