"""Kahneman-Tversky optimisation: its loss and its reference point by hand, and what it learns from a store."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import preferred
import pytest
import torch
from preferred import LIKES, NO_REWARD, SMALL
from test_fixed_points import solved as solved  # a fixture

from prefrl.envs.text import Reviews
from prefrl.fit.pairs import batch
from prefrl.improve.direct import Direct, Pairs
from prefrl.improve.kto import KTOSettings, reference_point
from prefrl.improve.objectives import kto_loss
from prefrl.protocols import Store
from prefrl.types import Response


def learner(task: Any, **changes: object) -> Direct:
    settings = SMALL | {"minibatch": 8, "epochs": 3} | changes
    return KTOSettings.model_validate(settings).build(task, np.random.default_rng(0))


@pytest.fixture(scope="module")
def judged(toy_reviews: Reviews) -> Store[Response]:
    return preferred.toy_answers(toy_reviews)


@pytest.fixture(scope="module")
def few(toy_reviews: Reviews) -> Store[Response]:
    return preferred.toy_answers(toy_reviews, 40)


def s(x: float) -> float:
    return 1 / (1 + math.exp(-x))


def test_the_loss_is_one_minus_the_value_of_a_gain_or_loss_against_the_reference_point() -> None:
    gains = torch.tensor([3.0, 3.0, -1.0], requires_grad=True)
    found = kto_loss(gains, torch.tensor([True, False, False]), gains.mean() - 2 / 3, 0.5)  # a point of 1
    assert found.tolist() == pytest.approx([1 - s(1.0), 1 - s(-1.0), 1 - s(1.0)])
    (slope,) = torch.autograd.grad(found.sum(), gains)
    # The derivative of s(x) is s(x) s(-x): up for the desirable one, down for the others, and no more by the point.
    assert slope.tolist() == pytest.approx([x * 0.5 * s(1.0) * s(-1.0) for x in (-1, 1, 1)])


@pytest.mark.parametrize(
    ("changes", "answer", "expected"),
    [
        ({}, 1.0, 0.5),
        ({"desirable": 2.0, "undesirable": 0.0}, 1.0, 0.5),
        ({"desirable": 1.5, "undesirable": 0.5}, 0.0, 0.5),
        ({"desirable": 1.5}, 1.0, 0.625),
        ({}, 0.75, 0.25),  # half as sure
        ({}, 0.25, 0.25),
    ],
)
def test_at_the_start_half_of_the_weights_is_lost(
    toy_reviews: Reviews, changes: dict[str, float], answer: float, expected: float
) -> None:
    one = learner(toy_reviews, epochs=1, **changes)
    store = preferred.answers(one.sample(8, np.random.default_rng(0)), LIKES, lambda lead: answer)
    assert one.improve(NO_REWARD, store, np.random.default_rng(0))["loss"] == pytest.approx(expected, abs=1e-3)


def test_the_reference_point_is_the_mean_gain_of_responses_to_other_prompts(
    toy_reviews: Reviews, few: Store[Response], monkeypatch: pytest.MonkeyPatch
) -> None:
    one = learner(toy_reviews, undesirable=0.0)  # all gains rise
    data = batch(few.judged())
    pairs, at = Pairs.of(data, one.policy), np.arange(5)
    assert float(reference_point(one.policy, pairs, at)) == pytest.approx(0.0, abs=1e-4)
    one.improve(NO_REWARD, few, np.random.default_rng(0))
    moved = []
    for i in at:
        (a, b), (other, _) = data.edges[i], data.edges[(i + 1) % 5]
        prompt = data.candidates[other]
        for each in (data.candidates[a], data.candidates[b]):
            if each.prompt != prompt.prompt:
                moved.append(Response(prompt.prompt, each.text, prompt.prompt_tokens, each.tokens))
    expected = float(np.mean(preferred.gains(one, moved)))
    assert len(moved) >= 6
    assert expected > 0.01
    assert float(reference_point(one.policy, pairs, at)) == pytest.approx(expected, abs=1e-3)
    lengths = [len(one.prompt_tokens) + len(one.tokens) for one in moved]
    room = sorted(lengths)[len(lengths) // 2]
    monkeypatch.setattr("prefrl.improve.kto.context_of", lambda model: room)
    fit = [one for one, length in zip(moved, lengths, strict=True) if length <= room]
    assert 0 < len(fit) < len(moved)
    expected = max(0.0, float(np.mean(preferred.gains(one, fit))))
    assert float(reference_point(one.policy, pairs, at)) == pytest.approx(expected, abs=1e-3)


def test_the_reference_point_is_never_negative_and_0_where_there_is_one_prompt(
    solved: Any, toy_reviews: Reviews, few: Store[Response]
) -> None:
    one = learner(toy_reviews)
    pairs = Pairs.of(batch(few.judged()), one.policy)
    with torch.no_grad():
        for parameter in one.policy.parameters():
            parameter.mul_(0.9)  # all responses become less probable
    assert float(reference_point(one.policy, pairs, np.arange(8))) == 0.0
    task, best = solved
    settings = KTOSettings()
    there = preferred.at(best, settings, task)
    alone = Pairs.of(batch(preferred.answers(there.sample(20, np.random.default_rng(0))).judged()), there.policy)
    assert float(reference_point(there.policy, alone, np.arange(4))) == 0.0


def test_it_learns_what_was_preferred_and_never_asks_the_reward(toy_reviews: Reviews, judged: Store[Response]) -> None:
    one = learner(toy_reviews)
    before = one.evaluate(LIKES, np.random.default_rng(0)).metrics
    for number in range(3):
        metrics = one.improve(NO_REWARD, judged, np.random.default_rng(number))
    after = one.evaluate(LIKES, np.random.default_rng(0)).metrics
    assert after["learned"] > before["learned"] + 0.3
    assert metrics["accuracy"] > 0.6
    assert metrics["margin"] > 0
    assert metrics["reference_point"] >= 0


def test_ties_teach_nothing(toy_reviews: Reviews, text_store: Store[Response]) -> None:
    one = learner(toy_reviews)
    found = one.sample(8, np.random.default_rng(0))
    with pytest.raises(ValueError, match="learns nothing from ties"):
        one.improve(NO_REWARD, preferred.answers(found, LIKES, lambda lead: 0.5), np.random.default_rng(0))
    with pytest.raises(ValueError, match="kto learns from judged pairs"):
        one.improve(NO_REWARD, text_store, np.random.default_rng(0))


def test_the_same_seed_gives_the_same_bytes_and_a_resumed_learner_goes_on_alike(
    toy_reviews: Reviews, few: Store[Response]
) -> None:
    settings = KTOSettings.model_validate(SMALL | {"minibatch": 8})
    preferred.check_resumed(settings, toy_reviews, NO_REWARD, few)


def test_the_size_of_a_chunk_changes_a_step_by_rounding_only(toy_reviews: Reviews, few: Store[Response]) -> None:
    settings = KTOSettings.model_validate(SMALL | {"minibatch": 1000})
    found = preferred.with_chunks(settings, toy_reviews, NO_REWARD, few)
    for name in ("loss", "grad_norm", "margin", "reference_point"):
        assert found[0][name] == pytest.approx(found[1][name], rel=1e-3, abs=1e-4)


def test_the_formula_says_what_the_settings_say() -> None:
    assert "1 s(0.1 (g(better) - z)) + 1.5 s(0.1 (z - g(worse)))" in KTOSettings(undesirable=1.5).formula()
