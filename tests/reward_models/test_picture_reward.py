from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from small_pictures import small_digits

from prefrl.envs.digits import Digits, real_digits
from prefrl.fit.settings import FittingSettings
from prefrl.fit.trainer import fit
from prefrl.label.oracle import OracleSettings
from prefrl.protocols import RewardModel
from prefrl.reward_models.pictures import PictureReward, PictureRewardSettings
from prefrl.storage.checkpoints import load_state, save_state
from prefrl.store import Store
from prefrl.types import Picture, Query

EACH = pytest.mark.parametrize("network", ["mlp", "cnn"])
PIXELS, WHICH = real_digits()


@pytest.fixture(scope="module")
def task() -> Digits:
    return small_digits("a three", "an eight")


def model_of(task: Digits, network: str, **changes: Any) -> PictureReward:
    small = {"network": network, "hidden": (16,), "channels": (8,), **changes}
    return PictureRewardSettings.model_validate(small).build(task, np.random.default_rng(0))


def some(count: int, caption: str = "a three") -> list[Picture]:
    return [Picture(caption, one) for one in PIXELS[:count]]


def golden(task: Digits, caption: str, pixels: np.ndarray) -> Picture:
    return Picture(caption, pixels, task.gold([Picture(caption, pixels)]))


@EACH
def test_shapes_are_as_the_protocol_says(task: Digits, network: str) -> None:
    model: RewardModel[Picture] = model_of(task, network, members=3)
    pictures = some(7)
    stacked = model.stack(pictures)
    assert (model.members, model.fitted) == (3, False)
    assert model.scores(stacked).shape == (3, 7)
    model.settle(stacked, lambda scores: scores.sum(1))
    assert model.fitted
    found = model.member_scores(pictures)
    np.testing.assert_allclose(found.mean(1), 0, atol=1e-5)
    np.testing.assert_allclose(found.std(1), 1, atol=1e-5)
    np.testing.assert_allclose(model.score(pictures), found.mean(0), atol=1e-6)
    raw = model.raw_member_scores(pictures)
    model.calibrate(2.0)
    np.testing.assert_allclose(model.raw_member_scores(pictures), raw / 2, rtol=1e-5)
    assert model.features(pictures).shape == (7, 64)
    assert model.features(pictures).max() == 1.0


@EACH
def test_a_state_goes_through_a_checkpoint(task: Digits, network: str, tmp_path: Path) -> None:
    model, other, pictures = model_of(task, network), model_of(task, network, combine={"by": "worst"}), some(6)
    model.settle(model.stack(pictures), lambda scores: scores.sum(1))
    save_state(tmp_path, "reward", model.state())
    other.load(load_state(tmp_path, "reward"))
    assert np.array_equal(model.member_scores(pictures), other.member_scores(pictures))
    assert np.array_equal(other.score(pictures), model.member_scores(pictures).min(0))


@EACH
def test_it_learns_what_an_oracle_says_of_each_caption(task: Digits, network: str, tmp_path: Path) -> None:
    threes, eights = (PIXELS[digit == WHICH] for digit in (3, 8))
    pairs = [
        Query(tuple(golden(task, caption, one) for one in pair))
        for caption in task.captions
        for pair in zip(threes[:45], eights[:45], strict=True)
    ]
    model = model_of(task, network)
    with Store[Picture](tmp_path) as store:
        store.ask(pairs)
        OracleSettings().build(task).answer(store, np.random.default_rng(0))
        fit(model, store, FittingSettings(epochs=40), np.random.default_rng(0))
    for caption, better, worse in (("a three", threes, eights), ("an eight", eights, threes)):
        high, low = (model.score([Picture(caption, one) for one in of[100:140]]) for of in (better, worse))
        assert (high[:, None] > low[None]).mean() > 0.95


def test_it_sees_no_gold(task: Digits) -> None:
    model, pictures = model_of(task, "mlp"), some(4)
    golden = [Picture(one.caption, one.pixels, np.array([np.nan])) for one in pictures]
    assert torch.equal(model.scores(model.stack(pictures)), model.scores(model.stack(golden)))


def test_other_sizes_and_captions_are_refused(task: Digits) -> None:
    model = model_of(task, "mlp")
    with pytest.raises(ValueError, match=r"has pixels of shape \(9, 8\), but digits has \(8, 8\)"):
        model.score([Picture("a three", np.zeros((9, 8), np.uint8))])
    with pytest.raises(ValueError, match="has the caption 'a tree'; did you mean 'a three'"):
        model.score(some(1, "a tree"))
