from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from small_pictures import NO_STORE, Dark, likes_ink, small_digits

from prefrl.envs.digits import Digits
from prefrl.improve.pictures import PictureLearner, PictureLearnerSettings, apart
from prefrl.protocols import RewardModel
from prefrl.types import Floats, Picture, Steps

SMALL: dict[str, Any] = {"updates": 2, "groups": 2, "pictures": 24, "evaluation_pictures": 16, "learning_rate": 1e-3}
VARIANTS: list[dict[str, Any]] = [
    {},
    {"epochs": 2, "minibatches": 3, "advantage": "group_normalised", "beta": 0.0},
    {"algorithm": "dpok", "beta": 0.05},
    {"kl_in": "advantage", "kl_target": 3.0, "diversity": 0.1, "advantage": "batch_mean", "policy": {"chunk": 7}},
]


@pytest.fixture(scope="module")
def task() -> Digits:
    return small_digits("thicker", "a three")


def learner(task: Digits, **changes: Any) -> PictureLearner:
    return PictureLearnerSettings.model_validate({**SMALL, **changes}).build(task, np.random.default_rng(0))


def flat(one: PictureLearner) -> torch.Tensor:
    return torch.cat([p.detach().flatten() for p in one.policy.parameters()])


@pytest.mark.parametrize("changes", VARIANTS)
def test_every_variant_learns_to_use_more_ink_and_begins_each_batch_at_ratio_one(
    task: Digits, changes: dict[str, Any]
) -> None:
    one, rng = learner(task, updates=12, **changes), np.random.default_rng(0)
    before = one.evaluate(likes_ink(), np.random.default_rng(0)).metrics["learned"]
    metrics = one.improve(likes_ink(), NO_STORE, rng)
    after = one.evaluate(likes_ink(), np.random.default_rng(0)).metrics
    assert after["learned"] > before + 0.3
    assert metrics["ratio_error"] == 0.0
    assert metrics["kl"] > 0
    assert after["kl"] > 0


@pytest.mark.parametrize("changes", VARIANTS)
def test_the_same_seed_gives_the_same_bytes_and_a_resumed_learner_goes_on_alike(
    task: Digits, changes: dict[str, Any]
) -> None:
    whole, first, second = (learner(task, **changes) for _ in range(3))
    for seed in (1, 2):
        whole.improve(likes_ink(), NO_STORE, np.random.default_rng(seed))
    first.improve(likes_ink(), NO_STORE, np.random.default_rng(1))
    second.load(first.state())
    second.improve(likes_ink(), NO_STORE, np.random.default_rng(2))
    assert torch.equal(flat(whole), flat(second))
    assert whole.steps == second.steps == Steps(learn=2 * 2 * 48)
    assert whole.state()["beta"] == second.state()["beta"]


def test_the_chunk_changes_nothing_but_rounding(task: Digits) -> None:
    one, other = learner(task), learner(task, policy={"chunk": 5})
    drawn = one.policy.draw(["thicker"] * 12, np.random.default_rng(0))
    for ours, theirs in zip(*(x.policy.start_logp_and_kl(drawn) for x in (one, other)), strict=True):
        assert torch.equal(ours, theirs)


@pytest.mark.parametrize("changes", [{"beta": 0.5}, {"algorithm": "dpok", "beta": 0.5}])
def test_a_kl_holds_it_near_its_start(task: Digits, changes: dict[str, Any]) -> None:
    free, held = learner(task, updates=12, beta=0.0), learner(task, updates=12, **changes)
    far, near = (one.improve(likes_ink(), NO_STORE, np.random.default_rng(0))["kl"] for one in (free, held))
    assert near < 0.7 * far


def test_dpok_without_a_reward_goes_back_to_where_it_started(task: Digits) -> None:
    one = learner(task, algorithm="dpok", beta=1.0, updates=30)
    with torch.no_grad():
        one.policy.model.leave.bias.add_(0.1)
    nothing = cast("RewardModel[Picture]", Dark(constant=1.0))
    before = one.evaluate(nothing, np.random.default_rng(0)).metrics["kl"]
    one.improve(nothing, NO_STORE, np.random.default_rng(0))
    assert one.evaluate(nothing, np.random.default_rng(0)).metrics["kl"] < 0.2 * before


def test_beta_is_steered_and_a_round_ends_where_it_went_too_far(task: Digits) -> None:
    one = learner(task, kl_target=1e-6, kl_horizon=48.0)
    one.improve(likes_ink(), NO_STORE, np.random.default_rng(0))
    assert one.state()["beta"] == pytest.approx(0.005 * 0.8 * 1.2)  # at its start in the first batch, then too far
    one = learner(task, updates=12, beta=0.0, kl_stop=1e-3)
    assert 1 < one.improve(likes_ink(), NO_STORE, np.random.default_rng(0))["updates"] < 12


def test_the_distance_within_a_group_is_that_to_its_others() -> None:
    pixels = torch.tensor([0, 255, 255, 0, 0, 0], dtype=torch.uint8).view(6, 1, 1).expand(6, 2, 2)
    # Squares of 2 x 2 that are black or white are 2 apart.
    assert apart(pixels, 3).tolist() == [2.0, 1.0, 1.0, 0.0, 0.0, 0.0]


def test_diversity_keeps_pictures_apart(task: Digits) -> None:
    nothing = cast("RewardModel[Picture]", Dark(constant=1.0))
    plain, varied = learner(task, updates=15), learner(task, updates=15, diversity=1.0)
    spread = [plain.evaluate(nothing, np.random.default_rng(0)).metrics["spread"]]
    for one in (plain, varied):
        one.improve(nothing, NO_STORE, np.random.default_rng(0))
        spread.append(one.evaluate(nothing, np.random.default_rng(0)).metrics["spread"])
    assert spread[1] == pytest.approx(spread[0], rel=0.02)  # equal scores teach nothing but the KL
    assert spread[2] > 1.05 * spread[0]


def test_gold_is_neither_read_nor_attached_while_learning(task: Digits) -> None:
    likes, one = Dark(), learner(task)
    object.__setattr__(task, "gold", _never)
    try:
        one.improve(cast("RewardModel[Picture]", likes), NO_STORE, np.random.default_rng(0))
    finally:
        object.__delattr__(task, "gold")
    assert all(picture.gold is None for picture in likes.seen)


def _never(pictures: Sequence[Picture]) -> Floats:
    raise AssertionError("nobody may ask")


def test_pictures_are_asked_about_evenly_and_evaluated_by_caption(task: Digits) -> None:
    one = learner(task)
    asked = one.sample(5, np.random.default_rng(0))
    assert [picture.caption for picture in asked] == ["thicker", "a three"] * 3
    assert all(picture.gold is not None for picture in asked)
    found = one.evaluate(likes_ink(), np.random.default_rng(0))
    metrics = found.metrics
    assert metrics["gold"] == pytest.approx((metrics["gold/thicker"] + metrics["gold/a three"]) / 2)
    assert (metrics["count"], metrics["kl"], len(found.examples)) == (16.0, 0.0, 12)
    assert one.steps == Steps(query=6, evaluate=16)


def test_a_caption_without_a_gold_is_left_out_of_its_mean() -> None:
    one = learner(small_digits("mine", "thicker"))
    metrics = one.evaluate(likes_ink(), np.random.default_rng(0)).metrics
    assert metrics["gold"] == metrics["gold/thicker"]
    assert "gold/mine" not in metrics
    of_none = learner(small_digits("mine")).evaluate(likes_ink(), np.random.default_rng(0)).metrics
    assert set(of_none) == {"count", "learned", "kl", "spread"}


def test_all_captions_come_in_turn(task: Digits) -> None:
    drawn = learner(task)._painter.paint(4, 3, np.random.default_rng(0))
    assert sorted(drawn.captions.view(4, 3)[:, 0].tolist()) == [0, 0, 1, 1]
    assert (drawn.captions.view(4, 3) == drawn.captions.view(4, 3)[:, :1]).all()


def test_no_caption_comes_again_before_all_have_come_and_a_resumed_learner_goes_on_in_turn() -> None:
    task = small_digits("a one", "a two", "a three", "thicker")
    one, rng = learner(task), np.random.default_rng(0)
    seen = [one._painter.paint(3, 1, rng).captions.tolist() for _ in range(2)]
    resumed = learner(task)
    resumed.load(one.state())
    seen += [resumed._painter.paint(3, 1, rng).captions.tolist() for _ in range(2)]
    turns = np.concatenate(seen).reshape(3, 4)
    assert np.sort(turns, 1).tolist() == [[0, 1, 2, 3]] * 3


def test_groups_are_equal_by_the_reward_not_by_what_diversity_adds(task: Digits) -> None:
    nothing = cast("RewardModel[Picture]", Dark(constant=1.0))
    metrics = learner(task, diversity=1.0).improve(nothing, NO_STORE, np.random.default_rng(0))
    assert metrics["equal_groups"] == 1.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"clip": None}, "set clip=0.2, or epochs=1 and minibatches=1"),
        ({"clip": None, "minibatches": 2}, "need a clip"),
        ({"groups": 1, "pictures": 2, "minibatches": 3}, "1 x 2 pictures cannot be 3 minibatches"),
        ({"beta": 0.0, "kl_target": 1.0}, "beta must start above 0"),
        ({"pictures": 1}, "greater than or equal to 2"),
    ],
)
def test_settings_that_contradict_one_another_are_refused(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        PictureLearnerSettings.model_validate(changes)


def test_another_start_is_refused(task: Digits) -> None:
    state = learner(task).state()
    with pytest.raises(ValueError, match="it started from another denoiser"):
        learner(small_digits("thicker", "a three", seed=1)).load(state)


def test_the_formula_says_what_is_maximised() -> None:
    said = PictureLearnerSettings(diversity=0.5).formula()
    assert "min(r A_i, clip(r, 0.8, 1.2) A_i)" in said
    assert "R_i = score(x_i) + 0.5 (mean distance from the group's others) - 0.005 sum_t" in said
    assert (
        "log pi(x_t) A_i - 0.1 KL(pi(x_t) || ref(x_t))" in PictureLearnerSettings(algorithm="dpok", beta=0.1).formula()
    )
    assert "K_j" in PictureLearnerSettings(kl_in="advantage").formula()
    assert "KL" not in PictureLearnerSettings(algorithm="dpok", beta=0).formula()
