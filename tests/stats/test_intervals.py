"""Shares and correlations with intervals, against what is known of them."""

import numpy as np
import pytest
from scipy import stats

from prefrl.stats.estimates import Estimate, wilson
from prefrl.stats.intervals import average, clusters, correlate, correlation, defined, mean


def test_comparisons_that_share_a_candidate_hang_together() -> None:
    edges = np.array([[2 * i, 2 * i + 1] for i in range(6)] + [[0, 12]])
    found, sense = clusters(edges, np.arange(7), 13)
    assert sense == "components"
    assert found[0] == found[6]
    assert len(set(found.tolist())) == 6
    assert clusters(edges[:6], np.arange(6), 13)[1] == "comparisons"


def test_one_big_component_falls_back_to_judgements() -> None:
    edges, group = np.array([[0, 1], [1, 2], [0, 2], [2, 3]]), np.array([0, 0, 0, 1])
    found, sense = clusters(edges, group, 4)
    assert (found.tolist(), sense) == ([0, 0, 0, 1], "judgements")


def test_independent_hits_get_wilsons_interval(rng: np.random.Generator) -> None:
    found = mean(np.array([1.0] * 8 + [0.0] * 2), np.arange(10), rng)
    assert found.value == 0.8
    assert (found.low, found.high) == pytest.approx(wilson(0.8, 10))
    assert (found.count, found.how) == (10, "Wilson")


def test_hits_that_hang_together_get_a_wider_interval(rng: np.random.Generator) -> None:
    right = rng.random(60) < 0.7
    alone = mean(right.astype(float), np.arange(60), rng)
    tenfold = mean(np.repeat(right, 10).astype(float), np.repeat(np.arange(60), 10), rng)
    assert tenfold.low is not None
    assert tenfold.high is not None
    assert (tenfold.low, tenfold.high) == pytest.approx((alone.low, alone.high), abs=0.03)
    naive = wilson(float(right.mean()), 600)
    assert tenfold.high - tenfold.low > 2 * (naive[1] - naive[0])


def test_the_bootstrap_has_the_standard_error_of_a_mean_of_clusters() -> None:
    rng = np.random.default_rng(3)
    sizes = rng.integers(1, 6, 200)
    hits = np.concatenate([np.full(n, float(rng.random() < 0.6)) for n in sizes])
    found = mean(hits, np.repeat(np.arange(200), sizes), rng)
    residual = np.bincount(np.repeat(np.arange(200), sizes), hits - hits.mean())
    error = np.sqrt((residual**2).sum()) / len(hits)  # the linearised error of a ratio
    assert found.low is not None
    assert found.high is not None
    assert found.high - found.low == pytest.approx(2 * 1.96 * error, rel=0.1)


def test_agreeing_clusters_never_give_an_interval_of_no_width(rng: np.random.Generator) -> None:
    found = mean(np.ones(12), np.repeat(np.arange(6), 2), rng)
    assert (found.low, found.high) == pytest.approx(wilson(1.0, 6))
    assert found.how == "Wilson over 6 clusters"


def test_what_cannot_be_known_is_said_and_not_made_up(rng: np.random.Generator) -> None:
    assert mean(np.zeros(0), np.zeros(0, int), rng).why == "no comparison of this sort"
    few = mean(np.array([1.0, 0.0, 1.0]), np.array([0, 0, 1]), rng)
    assert (few.low, few.how) == (None, "no interval: only 2 clusters")
    flat = correlation("spearman", np.ones(9), np.arange(9.0), range(9), rng)
    assert (flat.value, flat.why) == (None, "all values are equal")
    assert correlation("kendall", np.arange(2.0), np.arange(2.0), range(2), rng).why == "2 points"


def test_an_interval_lies_around_the_value() -> None:
    drawn = np.linspace(0.2, 0.4, 201)  # resamples of what is biased by 0.2
    found = defined(np.array([0.5]), iter([drawn[:100], np.array([np.nan]), drawn[100:]]), 9, Estimate(count=12))
    assert (found.low, found.high) == pytest.approx((0.405, 0.595))
    assert (found.value, found.count, found.how) == (0.5, 12, "bootstrap over 9 clusters")


def test_correlations_by_hand(rng: np.random.Generator) -> None:
    x, y = np.array([1.0, 2.0, 3.0, 4.0]), np.array([1.0, 3.0, 2.0, 40.0])
    assert correlate("spearman", x, y) == pytest.approx(0.8)  # 1 - 6 * 2 / (4 * 15)
    assert correlate("kendall", x, y) == pytest.approx(4 / 6)  # 5 pairs agree, 1 does not
    assert correlate("pearson", x, 3 * x - 7) == pytest.approx(1.0)


def test_the_interval_of_a_correlation_is_fishers_for_independent_points() -> None:
    rng = np.random.default_rng(5)
    x = rng.normal(size=400)
    y = 0.6 * x + 0.8 * rng.normal(size=400)
    found = correlation("pearson", x, y, range(400), rng)
    expected = stats.pearsonr(x, y).confidence_interval(0.95)
    assert (found.low, found.high) == pytest.approx((expected.low, expected.high), abs=0.03)


def test_the_interval_of_a_correlation_is_one_of_95_percent() -> None:
    """On average over samples: one of 90 % would be a sixth narrower."""
    rng, found, expected = np.random.default_rng(7), list[float](), list[float]()
    for _ in range(6):
        x = rng.normal(size=100)
        y = 0.6 * x + 0.8 * rng.normal(size=100)
        one = correlation("pearson", x, y, range(100), rng)
        fisher = stats.pearsonr(x, y).confidence_interval(0.95)
        assert one.low is not None
        assert one.high is not None
        found.append(one.high - one.low)
        expected.append(fisher.high - fisher.low)
    assert np.mean(found) == pytest.approx(np.mean(expected), rel=0.07)


@pytest.mark.parametrize("levels", [3, 1000])
def test_rank_correlation_is_scipys_with_and_without_ties(levels: int) -> None:
    rng = np.random.default_rng(0)
    for _ in range(20):
        x, y = rng.integers(levels, size=(2, 30)).astype(float)
        assert correlate("spearman", x, y) == pytest.approx(float(stats.spearmanr(x, y).statistic), abs=1e-12)


def test_an_average_has_students_interval() -> None:
    values = np.random.default_rng(0).normal(size=12)
    low, high = stats.t.interval(0.95, 11, values.mean(), stats.sem(values))
    found = average(values)
    assert (found.low, found.high) == pytest.approx((low, high), abs=1e-12)
