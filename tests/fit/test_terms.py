from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence

import choix
import numpy as np
import pytest
import torch

from prefrl.fit.likelihood import Likelihood, per_judgement, weights
from prefrl.fit.settings import FittingSettings
from prefrl.fit.terms import Terms, terms
from prefrl.judgements import Choice, Comparison, Judged, Judgement, Ranking, Rating
from prefrl.types import Query, Response


def candidates(count: int) -> list[Response]:
    return sorted((Response("p", str(i)) for i in range(count)), key=lambda c: c.id)


def judged(among: Sequence[Response], make: Callable[[str], Judgement]) -> Judged[Response]:
    query = Query(tuple(among))
    return Judged(query, make(query.id))


def ranked(pool: Sequence[Response], order: Sequence[int]) -> Judged[Response]:
    """A ranking of some of the pool, best first."""
    chosen = [pool[i] for i in sorted(order)]
    return judged(chosen, lambda id: Ranking(id, tuple(order.index(i) for i in sorted(order))))


def loss(
    some: Sequence[Judged[Response]], pool: Sequence[Response], scores: Sequence[float] | np.ndarray, **ways: str
) -> float:
    """The weighted negative log-likelihood of judgements."""
    settings = {"ties": "half", "rankings": "plackett_luce"} | ways
    made = terms(some, [c.id for c in pool], **settings)  # type: ignore[arg-type]
    likelihood = Likelihood(1, made, FittingSettings.model_validate(settings))
    values = likelihood.losses(made, torch.tensor([list(scores)])) * weights(made, torch.ones(1, len(some)))
    return float(values.detach().sum())


def test_a_ranking_has_the_likelihood_that_choix_gives_it(rng: np.random.Generator) -> None:
    pool, scores = candidates(5), rng.normal(size=5)
    orders: list[tuple[int, ...]] = [(3, 0, 4), (1, 2), (4, 3, 2, 1, 0)]
    some = [ranked(pool, order) for order in orders]
    expected = -choix.log_likelihood_rankings(orders, scores)
    assert loss(some, pool, scores) == pytest.approx(expected, rel=1e-5)


def test_a_ranking_of_two_and_a_comparison_are_the_same() -> None:
    pool, scores = candidates(2), [0.3, 1.0]
    comparison = judged(pool, lambda id: Comparison(id, 0.0))
    assert loss([ranked(pool, [1, 0])], pool, scores) == pytest.approx(loss([comparison], pool, scores))


def test_tied_groups_as_halves_are_the_mean_over_their_orders(rng: np.random.Generator) -> None:
    pool, scores = candidates(5), rng.normal(size=5)
    tied = judged(pool, lambda id: Ranking(id, (0, 1, 1, 1, 2)))
    orders = [(0, *middle, 4) for middle in itertools.permutations([1, 2, 3])]
    expected = np.mean([-choix.log_likelihood_rankings([order], scores) for order in orders])
    assert loss([tied], pool, scores) == pytest.approx(expected, rel=1e-5)


def test_all_pairs_of_a_ranking_share_its_weight(rng: np.random.Generator) -> None:
    pool, scores = candidates(4), rng.normal(size=4)
    pairs = list(itertools.combinations([2, 0, 3, 1], 2))
    expected = -choix.log_likelihood_pairwise(pairs, scores) * 3 / len(pairs)
    assert loss([ranked(pool, [2, 0, 3, 1])], pool, scores, rankings="pairs") == pytest.approx(expected, rel=1e-5)


def test_the_best_of_several_is_one_choice(rng: np.random.Generator) -> None:
    pool, scores = candidates(4), rng.normal(size=4)
    best = judged(pool, lambda id: Choice(id, 2))
    expected = -choix.log_likelihood_top1([(2, (0, 1, 3))], scores)
    assert loss([best], pool, scores) == pytest.approx(expected, rel=1e-5)


def weak_orders(size: int) -> list[tuple[int, ...]]:
    """Every ranking of `size` candidates with ties."""
    return [r for r in itertools.product(range(size), repeat=size) if set(r) == set(range(max(r) + 1))]


def test_rankings_with_ties_as_outcomes_have_probabilities_that_sum_to_one(rng: np.random.Generator) -> None:
    pool, scores = candidates(4), rng.normal(size=4)
    some = [judged(pool, lambda id, r=ranks: Ranking(id, r)) for ranks in weak_orders(4)]  # type: ignore[misc]
    assert len(some) == 75
    made = terms(some, [c.id for c in pool], "davidson", "plackett_luce")
    losses = Likelihood(1, made, FittingSettings(ties="davidson")).losses(made, torch.tensor(scores).float()[None])
    each = per_judgement(made, losses.detach())[0][0]
    assert float((-each).exp().sum()) == pytest.approx(1, rel=1e-5)


def test_a_judgements_weight_multiplies_its_likelihood() -> None:
    pool, scores = candidates(3), [0.0, 1.0, 3.0]
    once = judged(pool, lambda id: Ranking(id, (0, 1, 2)))
    heavy = judged(pool, lambda id: Ranking(id, (0, 1, 2), weight=2.5))
    assert loss([heavy], pool, scores) == pytest.approx(2.5 * loss([once], pool, scores))


def test_kinds_add_up_in_one_likelihood_on_one_reward(rng: np.random.Generator) -> None:
    pool, scores = candidates(4), rng.normal(size=4)
    some = [
        judged(pool[:2], lambda id: Comparison(id, 0.8)),
        judged(pool[1:], lambda id: Ranking(id, (0, 0, 1))),
        judged(pool, lambda id: Choice(id, 3)),
        judged(pool[:1], lambda id: Rating(id, (2,), 5)),
    ]
    assert loss(some, pool, scores) == pytest.approx(sum(loss([one], pool, scores) for one in some), rel=1e-5)


def test_ratings_on_different_scales_are_refused() -> None:
    pool = candidates(2)
    some = [judged([c], lambda id, n=n: Rating(id, (1,), n)) for c, n in zip(pool, (3, 5), strict=True)]  # type: ignore[misc]
    with pytest.raises(ValueError, match=r"scales of \[3, 5\] levels"):
        terms(some, [c.id for c in pool], "half", "pairs")


def test_rao_and_kupper_knows_no_rankings_of_three() -> None:
    pool = candidates(3)
    some = [judged(pool, lambda id: Ranking(id, (0, 1, 1)))]
    with pytest.raises(ValueError, match="rankings=pairs"):
        terms(some, [c.id for c in pool], "rao_kupper", "plackett_luce")
    assert terms(some, [c.id for c in pool], "rao_kupper", "pairs").choices.pairs
    best = [judged(pool, lambda id: Choice(id, 0))]
    with pytest.raises(ValueError, match="choices of more than two"):
        terms(best, [c.id for c in pool], "rao_kupper", "pairs")
    rated = [judged(pool, lambda id: Rating(id, (0, 1, 1), 2))]
    assert terms(rated, [c.id for c in pool], "rao_kupper", "plackett_luce").scale == 2


@pytest.fixture
def mixed() -> Terms:
    pool = candidates(6)
    kinds: list[Callable[[str], Judgement]] = [
        lambda id: Ranking(id, (0, 1, 2), "a"),
        lambda id: Choice(id, 1, "b"),
        lambda id: Rating(id, (0, 1, 2), 3, "a"),
    ]
    some = [judged(pool[i : i + 3], kinds[i % 3]) for i in range(4)]
    return terms(some, [c.id for c in pool], "half", "plackett_luce")


def test_minibatches_hold_every_term_once(mixed: Terms) -> None:
    parts = list(mixed.minibatches(torch.tensor([2, 0, 3, 1]), 3))
    assert [len(set(torch.cat([p.choices.judgement, p.ratings.judgement]).tolist())) for p in parts] == [3, 1]
    for name in ("choices", "ratings"):
        found = torch.cat([getattr(p, name).judgement for p in parts]).sort().values
        torch.testing.assert_close(found, getattr(mixed, name).judgement.sort().values)


def test_a_subset_counts_its_judgements_anew(mixed: Terms) -> None:
    part = mixed.subset(torch.tensor([False, True, True, False]))
    assert part.choices.judgement.tolist() == [0]
    assert part.ratings.judgement.tolist() == [1, 1, 1]
    assert part.labeler.tolist() == [1, 0]


def test_the_losses_of_a_judgement_are_gathered(mixed: Terms) -> None:
    sums, counts = per_judgement(mixed, torch.ones(1, len(mixed.choices.weight) + 3))
    assert sums[0].tolist() == counts.tolist() == [2, 1, 3, 2]


def test_more_tied_candidates_than_can_be_weighed_are_refused() -> None:
    pool = candidates(11)
    ids = [c.id for c in pool]
    tied = [judged(pool, lambda id: Ranking(id, (0,) * 11))]
    for ties in ("half", "davidson"):
        with pytest.raises(ValueError, match=r"(more than|at most) 10"):
            terms(tied, ids, ties, "plackett_luce")
    assert len(terms(tied, ids, "half", "pairs").choices.items) == 55
    assert len(terms([ranked(pool, range(11))], ids, "half", "plackett_luce").choices.items) == 10
