"""Best-of-n against brute force: all sets of n of a pool, and all draws from a base that can be enumerated."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from prefrl.evaluate.best_of_n import best, expected, kl, kl_bound, masses_of_best

NAN = np.nan
SCORES = st.sampled_from([-1.0, 0.0, 0.5, 2.0, NAN])


def chosen(scores: list[float], values: list[float]) -> float:
    """What the best is worth; equals are equally likely, and NaN is below all."""
    ranked = [-np.inf if np.isnan(s) else s for s in scores]
    return float(np.mean([v for s, v in zip(ranked, values, strict=True) if s == max(ranked)]))


def by_sets(judged: list[float], measured: list[float]) -> list[float]:
    """The mean over every set of n of the pool."""
    places = range(len(judged))
    return [
        float(
            np.mean(
                [chosen([judged[i] for i in s], [measured[i] for i in s]) for s in itertools.combinations(places, n)]
            )
        )
        for n in range(1, len(judged) + 1)
    ]


@settings(max_examples=60)
@given(st.lists(st.lists(SCORES, min_size=5, max_size=5), min_size=1, max_size=3), st.integers(0, 9))
def test_the_estimate_from_a_pool_is_the_mean_over_all_its_sets(judged: list[list[float]], seed: int) -> None:
    measured = np.random.default_rng(seed).normal(size=(len(judged), 5))
    by_hand = [by_sets(row, list(values)) for row, values in zip(judged, measured, strict=True)]
    np.testing.assert_allclose(expected(np.array(judged), measured), by_hand, atol=1e-12)


def test_one_response_is_the_mean_and_all_of_them_are_the_best() -> None:
    judged, measured = np.array([[3.0, 1.0, 2.0]]), np.array([[10.0, 20.0, 60.0]])
    found = expected(judged, measured)
    assert found[0, 0] == pytest.approx(30)
    assert found[0, 1] == pytest.approx((10 + 10 + 60) / 3)
    assert found[0, 2] == pytest.approx(10)
    assert expected(judged, judged)[0].tolist() == pytest.approx([2, 8 / 3, 3])


def test_large_pools_keep_their_digits() -> None:
    pool = np.arange(1500.0)[None]
    found = expected(pool, pool)[0]
    n = np.arange(1, 1501)  # the mean of the highest of n of 0 .. N - 1, without putting back
    np.testing.assert_allclose(found, n * 1501 / (n + 1) - 1, rtol=1e-9)


def test_the_estimate_is_unbiased_for_fresh_draws() -> None:
    rng = np.random.default_rng(0)
    worth = np.array([0.0, 1.0, 4.0])
    pools = rng.choice(3, size=(20_000, 4), p=[0.5, 0.3, 0.2])
    exact = [float(masses_of_best(np.array([0.5, 0.3, 0.2]), n) @ worth) for n in range(1, 5)]
    np.testing.assert_allclose(expected(worth[pools], worth[pools]).mean(0), exact, atol=0.03)


@pytest.mark.parametrize(
    ("scores", "at"),
    [([1, 3, 2], 1), ([2, 5, 5], 1), ([NAN, -4, NAN], 1), ([NAN, NAN], 0), ([NAN, -np.inf, 0], 2)],
)
def test_the_best_is_the_first_of_the_highest_and_never_one_without_a_score(scores: list[float], at: int) -> None:
    assert best(np.array(scores)) == at
    assert best(np.array([scores, scores[::-1]])).shape == (2,)


def drawn(base: list[float], values: list[float], n: int) -> np.ndarray:
    """(Y,): how probable each response is as the best of n, by going through all draws; equals are equally likely."""
    found = np.zeros(len(base))
    for draw in itertools.product(range(len(base)), repeat=n):
        high = max(values[y] for y in draw)
        winners = [y for y in draw if values[y] == high]
        for y in winners:
            found[y] += np.prod([base[i] for i in draw]) / len(winners)
    return found


@pytest.mark.parametrize("n", [1, 2, 4])
@pytest.mark.parametrize("values", [[0.0, 1.0, 2.0, 3.0], [0.0, 1.0, 1.0, 3.0]])
def test_the_kl_is_that_of_all_draws_and_below_the_bound(n: int, values: list[float]) -> None:
    base = [0.1, 0.2, 0.4, 0.3]
    masses = np.array(
        [sum(p for p, v in zip(base, values, strict=True) if v == value) for value in sorted(set(values))]
    )
    all_draws = drawn(base, values, n)
    by_hand = float((all_draws * np.log(all_draws / np.array(base))).sum())
    assert kl(masses, n) == pytest.approx(by_hand, abs=1e-12)
    assert kl(masses, n) <= kl_bound(n) + 1e-12
    assert masses_of_best(masses, n).sum() == pytest.approx(1)


def test_the_bound_is_reached_where_no_response_comes_twice() -> None:
    assert kl_bound(1) == 0
    assert kl_bound(4) == pytest.approx(np.log(4) - 3 / 4)
    many = np.full(1_000_000, 1e-6)
    for n in (2, 8, 64):
        assert kl(many, n) == pytest.approx(kl_bound(n), abs=1e-3)
    assert kl_bound(np.array([1, 2, 8])).tolist() == pytest.approx([0, np.log(2) - 0.5, np.log(8) - 7 / 8])


def test_what_cannot_be_drawn_counts_nothing() -> None:
    assert kl(np.array([0.0, 0.5, 0.5, 0.0]), 3) == pytest.approx(kl(np.array([0.5, 0.5]), 3))
    assert kl(np.array([1.0]), 5) == 0
    assert kl(np.array([1 - 1e-15, 1e-15]), 2) == pytest.approx(2e-15 * np.log(2) - 1e-15, rel=1e-2)
