"""Members put together: by hand, and through a model's one score function."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from prefrl.envs.control import ControlSettings
from prefrl.reward_models.ensemble import Ensemble, combine
from prefrl.reward_models.mlp import MLPSettings
from prefrl.types import Segment

VALUES = np.array([[1.0, 4.0], [3.0, 4.0], [5.0, 4.0]])
STD = np.sqrt(8 / 3)


@pytest.mark.parametrize(
    ("settings", "fits", "expected"),
    [
        ({}, 1, [3.0, 4.0]),
        ({"by": "worst"}, 1, [1.0, 4.0]),
        ({"by": "lower"}, 1, [3.0 - STD, 4.0]),
        ({"by": "lower", "caution": 0.5}, 9, [3.0 - 0.5 * STD, 4.0]),
        ({"optimism": 2.0}, 0, [3.0 + 2.0 * STD, 4.0]),
        ({"optimism": 2.0}, 1, [3.0 + 2.0 * STD, 4.0]),
        ({"optimism": 2.0, "optimism_decay": 0.5}, 3, [3.0 + 0.5 * STD, 4.0]),
        ({"by": "worst", "optimism": 1.0}, 1, [1.0 + STD, 4.0]),
        ({"by": "lower", "optimism": 1.0}, 1, [3.0, 4.0]),
    ],
)
def test_combining_is_as_computed_by_hand(settings: dict[str, Any], fits: int, expected: list[float]) -> None:
    np.testing.assert_allclose(combine(VALUES, Ensemble(**settings), fits), expected)


def test_one_member_has_no_spread() -> None:
    settings = Ensemble(by="lower", caution=3.0, optimism=5.0)
    np.testing.assert_array_equal(combine(VALUES[:1], settings, 1), VALUES[0])


@pytest.mark.parametrize("by", ["mean", "lower", "worst"])
@pytest.mark.parametrize("optimism", [0.0, 0.7])
def test_a_score_is_the_sum_of_what_learners_get_for_each_step(by: Any, optimism: float) -> None:
    task = ControlSettings(env="Pendulum-v1", segment_steps=6).build()
    settings = MLPSettings(hidden=(8,), combine=Ensemble(by=by, optimism=optimism))
    model, rng = settings.build(task, np.random.default_rng(0)), np.random.default_rng(1)
    segments = [
        Segment(rng.normal(size=(6, 3)).astype(np.float32), rng.normal(size=(6, 1)).astype(np.float32), "e", i)
        for i in range(5)
    ]
    found = []
    for _ in range(2):  # the bonus decays with each fit
        model.settle(model.stack(segments), lambda scores: scores.sum(1))
        rewards = model.rewards(np.stack([s.observations for s in segments]), np.stack([s.actions for s in segments]))
        np.testing.assert_allclose(model.score(segments), rewards.sum(1), rtol=1e-4, atol=1e-4)
        found.append(rewards)
    assert np.allclose(found[0], found[1], rtol=1e-4, atol=1e-5) == (optimism == 0.0)
