"""Direct preference optimisation: its optimum by exact enumeration, and what it learns from a store."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from torch import Tensor

from prefrl.envs.text import Reviews
from prefrl.improve.dpo import DPO, DPOSettings
from prefrl.improve.objectives import dpo_loss
from prefrl.judgements import Comparison, Judgement, Ranking
from prefrl.protocols import RewardModel
from prefrl.store import Store
from prefrl.types import Floats, Query, Response

V, L, BETA = 3, 3, 0.4
SEQUENCES = torch.tensor(list(itertools.product(range(V), repeat=L)))
PAIRS = torch.tensor(list(itertools.combinations(range(len(SEQUENCES)), 2)))
REWARD = torch.randn(len(SEQUENCES), generator=torch.Generator().manual_seed(2), dtype=torch.float64)
REFERENCE = torch.randn(len(SEQUENCES), generator=torch.Generator().manual_seed(1), dtype=torch.float64).log_softmax(0)


def loss_of(logits: Tensor, smoothing: float = 0.0) -> Tensor:
    """The loss over all pairs of the 27 sequences, judged as Bradley and Terry would by the reward."""
    gains = BETA * (logits.log_softmax(0) - REFERENCE)
    first, second = PAIRS.T
    preference = (REWARD[first] - REWARD[second]).sigmoid()
    return dpo_loss(gains[first] - gains[second], preference, smoothing).mean()


def test_its_optimum_is_the_reference_tilted_by_the_reward() -> None:
    best = (REFERENCE + REWARD / BETA).log_softmax(0).requires_grad_()
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


class Likes:
    """Scores a response by how often it says "the"."""

    def score(self, candidates: Sequence[Response]) -> Floats:
        return np.array([r.text.split().count("the") for r in candidates], np.float32)


LIKES = cast("RewardModel[Response]", Likes())
SMALL: dict[str, Any] = {
    "evaluation_prompts": 64,
    "learning_rate": 5e-3,
    "minibatch": 8,
    "epochs": 3,
    "policy": {"chunk": 6},
}


def learner(task: Reviews, **changes: object) -> DPO:
    return DPOSettings.model_validate({**SMALL, **changes}).build(task, np.random.default_rng(0))


@pytest.fixture
def judged(toy_reviews: Reviews, tmp_path: Path) -> Store[Response]:
    """Pairs of the starting policy's responses, of which the one that says the word more often is better."""
    found = learner(toy_reviews).sample(160, np.random.default_rng(0))
    store = Store[Response](tmp_path / "judged")
    queries = [Query((a, b)) for a, b in zip(found[::2], found[1::2], strict=True) if a.id != b.id]
    store.ask(queries)
    store.answer([said(query) for query in queries])
    return store


def said(query: Query[Response]) -> Comparison:
    first, second = Likes().score(query.candidates)
    return Comparison(query.id, 0.5 + 0.5 * float(np.sign(first - second)), labeler="one")


def flat(one: DPO) -> Tensor:
    return torch.cat([p.flatten() for p in one.state()["model"].values()])


def test_it_learns_what_was_preferred_and_never_asks_the_reward(toy_reviews: Reviews, judged: Store[Response]) -> None:
    one = learner(toy_reviews)
    before = one.evaluate(LIKES, np.random.default_rng(0)).metrics
    for number in range(3):
        metrics = one.improve(cast("RewardModel[Response]", None), judged, np.random.default_rng(number))
    after = one.evaluate(LIKES, np.random.default_rng(0)).metrics
    assert after["learned"] > before["learned"] + 0.3
    assert 0.6 < metrics["accuracy"] <= 1
    assert metrics["pairs"] > 60
    assert metrics["margin"] > 0
    assert one.steps.learn == 0  # it writes nothing to learn from


def test_the_same_seed_gives_the_same_bytes_and_a_resumed_learner_goes_on_alike(
    toy_reviews: Reviews, judged: Store[Response]
) -> None:
    whole, first, second = (learner(toy_reviews, epochs=1) for _ in range(3))
    for seed in (1, 2):
        whole.improve(LIKES, judged, np.random.default_rng(seed))
    first.improve(LIKES, judged, np.random.default_rng(1))
    second.load(first.state())
    second.improve(LIKES, judged, np.random.default_rng(2))
    assert torch.equal(flat(whole), flat(second))
    assert not torch.equal(flat(whole), flat(first))


def test_the_size_of_a_chunk_changes_a_step_by_rounding_only(toy_reviews: Reviews, judged: Store[Response]) -> None:
    found = []
    for chunk in (2, 1000):
        one = learner(toy_reviews, policy={"chunk": chunk}, minibatch=1000, epochs=1)
        found.append(one.improve(LIKES, judged, np.random.default_rng(1)))
    for name in ("loss", "grad_norm", "margin"):
        assert found[0][name] == pytest.approx(found[1][name], rel=1e-3, abs=1e-4)
    assert found[0]["loss"] == pytest.approx(np.log(2), abs=1e-4)  # at the start nothing has been gained


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
