from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
import torch
from text_models import no_loss, some

from prefrl.components import ConfigError
from prefrl.envs.text import Reviews
from prefrl.reward_models.ensemble import Ensemble
from prefrl.reward_models.text import TransformerReward, TransformerSettings
from prefrl.types import Response

Train = Literal["full", "lora", "head"]
EACH = pytest.mark.parametrize("train", ["full", "lora", "head"])


def make(task: Reviews, train: Train = "full", members: int = 3, seed: int = 0) -> TransformerReward:
    return TransformerSettings(members=members, train=train).build(task, np.random.default_rng(seed))


@EACH
def test_a_score_does_not_hang_on_the_batch_or_its_padding(toy_reviews: Reviews, train: Train) -> None:
    reward, candidates = make(toy_reviews, train), some(toy_reviews, 20)
    together = reward.member_scores(candidates)
    alone = np.concatenate([reward.member_scores([c]) for c in candidates], 1)
    turned = reward.member_scores(candidates[::-1])[:, ::-1]
    padded = dict(reward.stack(candidates))
    if train != "head":
        padded["tokens"] = torch.cat([padded["tokens"], torch.full((20, 7), 9)], 1)
    np.testing.assert_allclose(together, alone, atol=1e-5)
    np.testing.assert_allclose(together, turned, atol=1e-5)
    np.testing.assert_allclose(together, reward.scores(padded).detach().numpy(), atol=1e-5)


def test_many_candidates_come_back_in_their_own_order(toy_reviews: Reviews) -> None:
    reward, candidates = make(toy_reviews), some(toy_reviews, 150)
    picked = [0, 149, 64, 3]
    found = reward.score(candidates)[picked]
    np.testing.assert_allclose(found, reward.score([candidates[i] for i in picked]), atol=1e-5)


def test_a_response_that_has_ended_scores_differently_from_one_that_was_cut(toy_reviews: Reviews) -> None:
    reward, (one,) = make(toy_reviews), some(toy_reviews, 1)
    ended, cut = reward.score([one, replace(one, tokens=one.tokens[:-1])])
    assert abs(ended - cut) > 1e-3


def test_padding_is_not_told_by_its_id(toy_reviews: Reviews) -> None:
    """A real token with the padding's id still counts."""
    reward, (one,) = make(toy_reviews), some(toy_reviews, 1)
    longer = replace(one, tokens=(*one.tokens, 0))
    assert reward.stack([longer])["lengths"].tolist() == [len(one.prompt_tokens) + len(one.tokens) + 1]
    assert abs(np.diff(reward.score([one, longer]))[0]) > 1e-4


def test_tokens_are_taken_as_sampled_and_only_imported_texts_are_encoded(toy_reviews: Reviews) -> None:
    reward, (one,) = make(toy_reviews), some(toy_reviews, 1)
    imported, renamed = Response(one.prompt, one.text), replace(one, prompt="x", text="y")
    np.testing.assert_array_equal(reward.score([imported]), reward.score([one]))
    np.testing.assert_array_equal(reward.score([renamed]), reward.score([one]))


def test_heads_start_small_and_apart(toy_reviews: Reviews) -> None:
    reward, candidates = make(toy_reviews, members=64), some(toy_reviews, 20)
    scores = reward.member_scores(candidates)
    assert scores.shape == (64, 20)
    assert 0.3 < scores.std(0).mean() < 3.0
    assert np.linalg.matrix_rank(scores) > 10


@EACH
def test_settling_gives_each_member_mean_zero_and_unit_spread_on_what_it_saw(
    toy_reviews: Reviews, train: Train
) -> None:
    reward, candidates = make(toy_reviews, train), some(toy_reviews, 30)
    assert not reward.fitted
    raw = reward.scores(reward.stack(candidates)).detach().numpy()
    reward.settle(reward.stack(candidates), no_loss)
    scores = reward.member_scores(candidates)
    np.testing.assert_allclose(reward.raw_member_scores(candidates), raw, atol=1e-5)
    np.testing.assert_allclose(scores.mean(1), 0, atol=1e-5)
    np.testing.assert_allclose(scores.std(1), 1, atol=1e-4)
    np.testing.assert_allclose(scores, (raw - raw.mean(1, keepdims=True)) / raw.std(1, keepdims=True), atol=1e-4)
    np.testing.assert_allclose(reward.score(candidates), scores.mean(0), atol=1e-6)
    assert reward.fitted


@EACH
def test_a_saved_state_scores_to_the_same_bits(toy_reviews: Reviews, train: Train) -> None:
    first, second, probes = make(toy_reviews, train), make(toy_reviews, train, seed=1), some(toy_reviews, 8)
    first.settle(first.stack(some(toy_reviews, 30)), no_loss)
    assert first.score(probes).tobytes() != second.score(probes).tobytes()
    second.load(first.state())
    assert first.score(probes).tobytes() == second.score(probes).tobytes()
    assert second.fitted


def test_a_state_is_a_copy(toy_reviews: Reviews) -> None:
    reward = make(toy_reviews)
    state = reward.state()
    before = {name: p.clone() for name, p in state["backbone"].items()}
    with torch.no_grad():
        for parameter in reward.parameters():
            parameter.add_(1.0)
    assert all(torch.equal(before[name], p) for name, p in state["backbone"].items())


def test_a_state_of_other_settings_is_refused(toy_reviews: Reviews) -> None:
    with pytest.raises(ValueError, match=r"heads is missing or has another shape"):
        make(toy_reviews, members=2).load(make(toy_reviews, members=3).state())


@EACH
def test_gradients_reach_what_is_trained_and_nothing_else(toy_reviews: Reviews, train: Train) -> None:
    reward, candidates = make(toy_reviews, train), some(toy_reviews, 4)
    reward.scores(reward.stack(candidates))[0].sum().backward()  # type: ignore[no-untyped-call]
    touched = [p.grad is not None and bool(p.grad.abs().sum() > 0) for p in reward.parameters()]
    frozen = {id(p) for p in reward.backbone.model.parameters()} - {id(p) for p in reward.parameters()}
    still = sum(p.grad is None for p in reward.backbone.model.parameters() if id(p) in frozen)
    adapters = 14 if train == "lora" else 0  # one layer has seven matrices; B is 0 at first, so A has no gradient yet
    assert sum(touched) == len(touched) - adapters // 2
    assert still == len(frozen)
    assert len(touched) == {"head": 2, "lora": 2 + adapters, "full": 13}[train]


def test_training_the_reward_model_leaves_the_task_s_model_alone(toy_reviews: Reviews) -> None:
    before = [p.clone() for p in toy_reviews.model().parameters()]
    reward = make(toy_reviews)
    with torch.no_grad():
        for parameter in reward.parameters():
            parameter.add_(1.0)
    assert all(torch.equal(a, b) for a, b in zip(before, toy_reviews.model().parameters(), strict=True))


def test_the_same_seed_gives_the_same_heads(toy_reviews: Reviews) -> None:
    candidates = some(toy_reviews, 3)
    first, second, third = (make(toy_reviews, seed=s).score(candidates).tobytes() for s in (0, 0, 1))
    assert first == second != third


def test_gold_is_not_read(toy_reviews: Reviews) -> None:
    reward, candidates = make(toy_reviews), some(toy_reviews, 3)
    golden = [replace(c, gold=np.full(1, np.nan)) for c in candidates]
    assert reward.score(golden).tobytes() == reward.score(candidates).tobytes()


def test_a_control_task_is_refused() -> None:
    class Control:
        name, kind = "pendulum", "control"

    with pytest.raises(ConfigError, match="scores text responses"):
        TransformerSettings().build(Control(), np.random.default_rng(0))


def test_nothing_is_left_in_training_mode(toy_reviews: Reviews) -> None:
    assert not any(m.training for m in make(toy_reviews).backbone.model.modules())


def test_bfloat16_products_leave_float32_scores_near_the_exact_ones(toy_reviews: Reviews) -> None:
    candidates = some(toy_reviews, 20)
    exact = make(toy_reviews).member_scores(candidates)
    settings = TransformerSettings(precision="bfloat16")
    rough = settings.build(toy_reviews, np.random.default_rng(0)).member_scores(candidates)
    assert rough.dtype == np.float32
    assert len(np.unique(rough)) == rough.size
    np.testing.assert_allclose(rough, exact, atol=0.05)


def test_a_temperature_divides_raw_scores_and_nothing_else_and_is_kept(toy_reviews: Reviews) -> None:
    reward, candidates = make(toy_reviews), some(toy_reviews, 10)
    raw = reward.raw_member_scores(candidates)
    reward.settle(reward.stack(candidates), no_loss)
    normalised = reward.member_scores(candidates)
    reward.settle(reward.stack(candidates), no_loss)
    reward.calibrate(2.0)
    again = make(toy_reviews, seed=1)
    again.load(reward.state())
    np.testing.assert_allclose(again.raw_member_scores(candidates), raw / 2, atol=1e-6)
    np.testing.assert_allclose(again.member_scores(candidates), normalised, atol=1e-6)


def test_the_reward_is_put_together_as_asked(toy_reviews: Reviews) -> None:
    settings = TransformerSettings(combine=Ensemble(by="worst"))
    reward, candidates = settings.build(toy_reviews, np.random.default_rng(0)), some(toy_reviews, 10)
    np.testing.assert_array_equal(reward.score(candidates), reward.member_scores(candidates).min(0))


@EACH
def test_features_are_what_the_heads_see(toy_reviews: Reviews, train: Train) -> None:
    reward, candidates = make(toy_reviews, train), some(toy_reviews, 10)
    heads, bias = list(reward.parameters())[-2:]
    scores = heads.detach().numpy() @ reward.features(candidates).T + bias.detach().numpy()[:, None]
    np.testing.assert_allclose(reward.raw_member_scores(candidates), scores, atol=1e-5)


def test_an_empty_response_is_its_end_alone(toy_reviews: Reviews) -> None:
    reward, (one,) = make(toy_reviews), some(toy_reviews, 1)
    end = int(toy_reviews.tokenizer.eos_token_id)
    empty = Response(one.prompt, "")
    assert reward.backbone.rows([empty]) == [[*one.prompt_tokens, end]]
    assert np.isfinite(reward.score([empty, one])).all()
