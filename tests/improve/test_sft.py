"""Supervised fine-tuning: which responses it learns, its gradient, and what it learns on a toy."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import preferred
import pytest
import torch
from preferred import LIKES, NO_REWARD, SMALL

from prefrl.envs.text import Reviews
from prefrl.improve.direct import Direct
from prefrl.improve.objectives import policy_gradient
from prefrl.improve.sft import SFTSettings, _parts, best_responses
from prefrl.judgements import Comparison, Demonstration, Judged, Judgement, Ranking
from prefrl.policies.responses import Responses
from prefrl.protocols import Store
from prefrl.store import Store as Kept
from prefrl.types import Query, Response


def settings(**changes: object) -> SFTSettings:
    return SFTSettings.model_validate(SMALL | {"minibatch": 8, "epochs": 3} | changes)


def learner(task: Reviews, **changes: object) -> Direct:
    return settings(**changes).build(task, np.random.default_rng(0))


@pytest.fixture(scope="module")
def judged(toy_reviews: Reviews) -> Store[Response]:
    return preferred.toy_answers(toy_reviews)


def told(candidates: Sequence[Response], *judgements: Any) -> Store[Response]:
    """A store whose judgements are made from a query of all candidates."""
    query = Query(tuple(candidates))

    class Told:
        def judged(self) -> list[Judged[Response]]:
            made: list[Judgement] = [make(query.id) for make in judgements]
            return [Judged(query, one) for one in made]

        def demonstrations(self) -> list[Any]:
            return []

    return cast("Store[Response]", Told())


def test_what_is_better_than_another_and_worse_than_none_is_learned_once(toy_reviews: Reviews) -> None:
    policy = learner(toy_reviews).policy
    written = policy.respond(["The plot was"], 3, np.random.default_rng(0)).candidates(toy_reviews.tokenizer)
    drawn = a, b, c = sorted(written, key=lambda response: response.id)  # as a query has them

    def ranked(*ranks: int) -> Any:
        return lambda query: Ranking(query, ranks)

    assert best_responses(told(drawn, ranked(1, 0, 2))) == [b]
    assert best_responses(told(drawn, ranked(0, 0, 1))) == [a, b]  # both share the first rank
    assert best_responses(told(drawn, ranked(0, 0, 0))) == []
    assert best_responses(told(drawn, ranked(1, 0, 2), ranked(2, 0, 1))) == [b]
    assert best_responses(told(drawn[:2], lambda query: Comparison(query, 0.3))) == [b]
    assert c not in best_responses(told(drawn, ranked(0, 1, 2)))


def test_a_step_goes_down_the_mean_over_tokens_of_minus_log_pi(toy_reviews: Reviews) -> None:
    one = learner(toy_reviews, epochs=1, minibatch=1000, max_grad_norm=1e9)
    store = preferred.answers(one.sample(12, np.random.default_rng(0)))
    rows = Responses.of(best_responses(store), toy_reviews)
    own = learner(toy_reviews).policy
    loss = -own.log_prob(rows)[0].sum() / rows.mask.sum()
    loss.backward()  # type: ignore[no-untyped-call]
    found = one.improve(NO_REWARD, store, np.random.default_rng(1))
    assert found["loss"] == pytest.approx(float(loss.detach()), rel=1e-4)
    norm = torch.stack([p.grad.norm() for p in own.parameters() if p.grad is not None]).norm()
    assert found["grad_norm"] == pytest.approx(float(norm), rel=1e-3)
    assert found["responses"] == len(rows)


def test_its_gradient_is_the_policy_gradient_with_an_advantage_of_one_to_the_bit(toy_reviews: Reviews) -> None:
    one, other = learner(toy_reviews), learner(toy_reviews)
    drawn = one.policy.respond(["The plot was"], 5, np.random.default_rng(0))
    for loss, _ in _parts(one.policy, settings(), drawn, np.arange(5)):
        loss.backward()  # type: ignore[no-untyped-call]
    logp = other.policy.log_prob(drawn)[0]
    (policy_gradient(logp, torch.ones_like(logp)).sum() / drawn.mask.sum()).backward()  # type: ignore[no-untyped-call]
    gradients = [[p.grad for p in each.policy.parameters() if p.grad is not None] for each in (one, other)]
    assert len(gradients[0]) == len(gradients[1]) > 3
    assert all(torch.equal(a, b) for a, b in zip(*gradients, strict=True))


def test_it_learns_to_write_like_the_better_ones(toy_reviews: Reviews, judged: Store[Response]) -> None:
    one = learner(toy_reviews, epochs=6)
    before = one.evaluate(LIKES, np.random.default_rng(0)).metrics["learned"]
    first = one.improve(NO_REWARD, judged, np.random.default_rng(1))
    second = one.improve(NO_REWARD, judged, np.random.default_rng(2))
    assert second["loss"] < first["loss"] - 0.2
    assert one.evaluate(LIKES, np.random.default_rng(0)).metrics["learned"] > before + 0.3


def test_a_resumed_learner_goes_on_alike(toy_reviews: Reviews, judged: Store[Response]) -> None:
    preferred.check_resumed(settings(schedule="linear"), toy_reviews, NO_REWARD, judged)


def test_the_size_of_a_chunk_changes_rounding_alone(toy_reviews: Reviews, judged: Store[Response]) -> None:
    small, large = preferred.with_chunks(settings(), toy_reviews, NO_REWARD, judged)
    assert small["loss"] == pytest.approx(large["loss"], rel=1e-3)


def test_ties_alone_teach_nothing_and_that_is_said(toy_reviews: Reviews) -> None:
    one = learner(toy_reviews)
    store = preferred.answers(one.sample(8, np.random.default_rng(0)), LIKES, lambda lead: 0.5)
    with pytest.raises(ValueError, match=r"sft learns what was shown and the better responses.*raise loop\.labels"):
        one.improve(NO_REWARD, store, np.random.default_rng(0))


def test_what_is_longer_than_the_context_is_refused_and_named(toy_reviews: Reviews) -> None:
    one = learner(toy_reviews)
    prompt = "The plot was " + "so very long and dull " * 200
    store = preferred.answers([Response(prompt, lead) for lead in ("the one", "another")])
    with pytest.raises(
        ValueError, match=r"its response \(its prompt begins 'The plot was so.*context has \d+: shorten"
    ):
        one.improve(NO_REWARD, store, np.random.default_rng(0))


def test_demonstrations_are_learned_without_any_judgement(toy_reviews: Reviews, tmp_path: Path) -> None:
    one = learner(toy_reviews, epochs=4)
    (written,) = one.policy.respond(["The plot was"], 1, np.random.default_rng(0)).candidates(toy_reviews.tokenizer)
    with Kept[Response](tmp_path) as store:
        assert not one.imitates(store)
        query = Query((written,))
        store.ask([query])
        store.answer([Demonstration(query.id, written.id, "ann")])
        assert one.imitates(store)
        first = one.improve(NO_REWARD, store, np.random.default_rng(1))
        second = one.improve(NO_REWARD, store, np.random.default_rng(2))
    assert first["responses"] == 1
    assert second["loss"] < first["loss"]
