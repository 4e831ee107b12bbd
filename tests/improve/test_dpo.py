"""Direct preference optimisation: its optima by exact enumeration, and what it learns from a store."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import preferred
import pytest
import torch
from preferred import LIKES, NO_REWARD, SMALL
from test_fixed_points import solved as solved  # a fixture
from torch import Tensor

from prefrl.envs.text import Reviews
from prefrl.improve.direct import Direct
from prefrl.improve.dpo import DPOSettings
from prefrl.improve.objectives import dpo_loss, ipo_loss
from prefrl.judgements import Judgement, Ranking
from prefrl.protocols import Store as AnyStore
from prefrl.store import Store
from prefrl.types import Query, Response

V, L, BETA = 3, 3, 0.4
SEQUENCES = torch.tensor(list(itertools.product(range(V), repeat=L)))
PAIRS = torch.tensor(list(itertools.combinations(range(len(SEQUENCES)), 2)))
FIRST, SECOND = PAIRS.T
REWARD = torch.randn(len(SEQUENCES), generator=torch.Generator().manual_seed(2), dtype=torch.float64)
REFERENCE = torch.randn(len(SEQUENCES), generator=torch.Generator().manual_seed(1), dtype=torch.float64).log_softmax(0)


def gaps_of(logits: Tensor) -> Tensor:
    gains = logits.log_softmax(0) - REFERENCE
    return gains[FIRST] - gains[SECOND]


def sigmoid_loss(logits: Tensor) -> Tensor:
    """The loss over all pairs of the 27 sequences, judged as Bradley and Terry would by the reward."""
    return dpo_loss(BETA * gaps_of(logits), (REWARD[FIRST] - REWARD[SECOND]).sigmoid(), 0.0).mean()


def preferences() -> Tensor:
    """(27, 27) how probable it is that each is better than each; no reward explains it."""
    draw = torch.rand(len(SEQUENCES), len(SEQUENCES), generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    return draw.triu(1) + (1 - draw.T).tril(-1) + 0.5 * torch.eye(len(SEQUENCES), dtype=torch.float64)


def square_loss(logits: Tensor) -> Tensor:
    return ipo_loss(gaps_of(logits), preferences()[FIRST, SECOND], 0.0, BETA).mean()


OPTIMA = {
    "the reference tilted by the reward": (sigmoid_loss, REFERENCE + REWARD / BETA),
    # Azar et al. 2024, equation 9, its Psi being the identity: by how often each beats the others.
    "the reference tilted by the chance to win": (square_loss, REFERENCE + preferences().mean(1) / BETA),
}


@pytest.mark.parametrize("name", OPTIMA)
def test_its_optimum_is(name: str) -> None:
    loss_of, tilted = OPTIMA[name]
    best = tilted.log_softmax(0).requires_grad_()
    torch.testing.assert_close(torch.autograd.grad(loss_of(best), best)[0], torch.zeros_like(best))
    other = REFERENCE.clone().requires_grad_()
    optimizer = torch.optim.LBFGS([other], max_iter=500, tolerance_grad=1e-12, tolerance_change=1e-16)

    def closure() -> Tensor:
        optimizer.zero_grad()
        loss = loss_of(other)
        loss.backward()  # type: ignore[no-untyped-call]
        return loss

    optimizer.step(closure)  # type: ignore[no-untyped-call]
    torch.testing.assert_close(other.detach().softmax(0), best.detach().softmax(0), atol=1e-4, rtol=1e-3)


def test_smoothing_takes_a_share_of_judgements_to_be_wrong() -> None:
    margin = torch.tensor([0.7, -0.3], dtype=torch.float64)
    sure = torch.tensor([1.0, 1.0], dtype=torch.float64)
    right, wrong = -margin.sigmoid().log(), -(-margin).sigmoid().log()
    torch.testing.assert_close(dpo_loss(margin, sure, 0.0), right)
    torch.testing.assert_close(dpo_loss(margin, sure, 0.2), 0.8 * right + 0.2 * wrong)
    torch.testing.assert_close(dpo_loss(-margin, 1 - sure, 0.2), 0.8 * right + 0.2 * wrong)
    torch.testing.assert_close(dpo_loss(margin, torch.full_like(sure, 0.5), 0.0), 0.5 * right + 0.5 * wrong)


def test_the_square_is_of_the_distance_from_half_of_one_over_beta() -> None:
    gaps, sure = torch.tensor([3.0, -1.0]), torch.ones(2)
    assert ipo_loss(gaps, sure, 0.0, 0.25).tolist() == [1.0, 9.0]  # 1 / (2 x 0.25) = 2
    assert ipo_loss(-gaps, 1 - sure, 0.0, 0.25).tolist() == [1.0, 9.0]  # the second one is better
    assert ipo_loss(gaps, torch.tensor([0.75, 0.5]), 0.0, 0.25).tolist() == [0.75 + 0.25 * 25, 0.5 * 9 + 0.5 * 1]
    assert ipo_loss(gaps, sure, 0.25, 0.25).tolist() == [0.75 + 0.25 * 25, 0.75 * 9 + 0.25 * 1]


def learner(task: Any, **changes: object) -> Direct:
    settings = SMALL | {"minibatch": 8, "epochs": 3} | changes
    return DPOSettings.model_validate(settings).build(task, np.random.default_rng(0))


@pytest.fixture(scope="module")
def judged(toy_reviews: Reviews) -> AnyStore[Response]:
    return preferred.toy_answers(toy_reviews)


@pytest.fixture(scope="module")
def few(toy_reviews: Reviews) -> AnyStore[Response]:
    return preferred.toy_answers(toy_reviews, 40)


ANSWERS: dict[str, Callable[[float], float]] = {
    "sigmoid": lambda lead: 1 / (1 + float(np.exp(-lead))),
    "ipo": lambda lead: 0.5 + lead,
}
"""The preference that each loss takes a lead of the implied reward for."""


@pytest.mark.parametrize("loss", ANSWERS)
def test_a_policy_has_nothing_to_learn_from_answers_by_the_reward_that_it_implies(solved: Any, loss: str) -> None:
    task, best = solved
    settings = DPOSettings.model_validate({"loss": loss, "beta": 0.05, "minibatch": 1000})
    reward = preferred.implied(best, task.start, settings.beta)
    there, away = preferred.at(best, settings, task), settings.build(task, np.random.default_rng(0))
    store = preferred.answers(there.sample(200, np.random.default_rng(0)), reward, ANSWERS[loss])
    found = there.improve(NO_REWARD, store, np.random.default_rng(0))
    assert found["margin"] > 0.02
    assert found["grad_norm"] < 3e-4  # of float32's rounding, which is another on each machine; away from there 0.01
    assert away.improve(NO_REWARD, store, np.random.default_rng(0))["grad_norm"] > 0.01


def test_it_learns_what_was_preferred_and_never_asks_the_reward(
    toy_reviews: Reviews, judged: AnyStore[Response]
) -> None:
    one = learner(toy_reviews)
    before = one.evaluate(LIKES, np.random.default_rng(0)).metrics
    for number in range(3):
        metrics = one.improve(NO_REWARD, judged, np.random.default_rng(number))
    after = one.evaluate(LIKES, np.random.default_rng(0)).metrics
    assert after["learned"] > before["learned"] + 0.3
    assert 0.6 < metrics["accuracy"] <= 1
    assert metrics["pairs"] > 60
    assert metrics["margin"] > 0
    assert one.steps.learn == 0  # it writes nothing to learn from


@pytest.mark.parametrize("changes", [{"loss": "ipo"}, {"length_normalised": True, "beta": 2.0}], ids=str)
def test_so_it_does_by_the_other_losses(toy_reviews: Reviews, few: AnyStore[Response], changes: dict[str, Any]) -> None:
    one = learner(toy_reviews, **changes)
    first, _, third = (one.improve(NO_REWARD, few, np.random.default_rng(number)) for number in range(3))
    assert third["loss"] < first["loss"]
    assert third["accuracy"] > first["accuracy"] + 0.1


def test_the_same_seed_gives_the_same_bytes_and_a_resumed_learner_goes_on_alike(
    toy_reviews: Reviews, few: AnyStore[Response]
) -> None:
    settings = DPOSettings.model_validate(SMALL | {"minibatch": 8, "epochs": 1})
    preferred.check_resumed(settings, toy_reviews, NO_REWARD, few)


def test_the_size_of_a_chunk_changes_a_step_by_rounding_only(toy_reviews: Reviews, few: AnyStore[Response]) -> None:
    settings = DPOSettings.model_validate(SMALL | {"minibatch": 1000})
    found = preferred.with_chunks(settings, toy_reviews, NO_REWARD, few)
    for name in ("loss", "grad_norm", "margin"):
        assert found[0][name] == pytest.approx(found[1][name], rel=1e-3, abs=1e-4)
    assert found[0]["loss"] == pytest.approx(np.log(2), abs=1e-4)  # at the start nothing has been gained


@pytest.mark.parametrize("normalised", [False, True])
def test_normalised_log_ratios_are_means_over_tokens(toy_reviews: Reviews, normalised: bool) -> None:
    one = learner(toy_reviews, length_normalised=normalised, beta=2.0, epochs=1)
    pair = one.sample(4, np.random.default_rng(0))[:2]
    assert len(pair[0].tokens) != len(pair[1].tokens)
    store = preferred.answers(pair, preferred.in_this_order(pair))
    one.improve(NO_REWARD, store, np.random.default_rng(0))  # now there are gains
    gains = preferred.gains(one, pair)
    if normalised:
        gains = [gain / len(each.tokens) for gain, each in zip(gains, pair, strict=True)]
    found = one.improve(NO_REWARD, store, np.random.default_rng(0))
    assert found["margin"] == pytest.approx(2.0 * (gains[0] - gains[1]), rel=1e-3)


def test_the_pairs_of_a_ranking_count_as_one_judgement(toy_reviews: Reviews, tmp_path: Path) -> None:
    found = learner(toy_reviews, asked_responses=3).sample(3, np.random.default_rng(0))
    query = Query(tuple(found))
    answers: list[Judgement] = [Ranking(query.id, (0, 1, 2), labeler="one")]
    with Store[Response](tmp_path / "ranked") as store:
        store.ask([query])
        store.answer(answers)
        metrics = learner(toy_reviews, epochs=1).improve(LIKES, store, np.random.default_rng(0))
    assert metrics["pairs"] == 3


def test_a_store_without_a_judged_pair_is_an_error(toy_reviews: Reviews, text_store: Store[Response]) -> None:
    with pytest.raises(ValueError, match="dpo learns from judged pairs"):
        learner(toy_reviews).improve(LIKES, text_store, np.random.default_rng(0))


def test_the_formula_says_what_the_settings_say() -> None:
    assert "mean[ 1 log s(h) ]" in DPOSettings().formula()
    assert "0.9 log s(h) + 0.1 log s(-h)" in DPOSettings(label_smoothing=0.1).formula()
    assert "mean[ 1 (d - 5)^2 ]" in DPOSettings(loss="ipo").formula()
    assert "0.9 (d - 5)^2 + 0.1 (d + 5)^2" in DPOSettings(loss="ipo", label_smoothing=0.1).formula()
    assert "log ref(worse)] / tokens(worse)" in DPOSettings(length_normalised=True).formula()
