"""Means of several runs and their intervals, against numbers worked out otherwise."""

import numpy as np
import pytest

from prefrl.stats import aggregates
from prefrl.types import Floats

SCORES = np.array([3.0, 1.0, 4.0, 1.5, 9.0, 2.6, 5.3, 5.8])


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_the_interquartile_mean_is_that_of_the_middle_half() -> None:
    middle = np.sort(SCORES)[2:6]
    found = aggregates.of_runs([SCORES], rng())
    assert found.value == pytest.approx(middle.mean())
    assert found.low is not None
    assert found.high is not None
    assert found.low < middle.mean() < found.high
    assert aggregates.interquartile_mean(np.array([SCORES, SCORES + 1]), axis=1) == pytest.approx(
        [middle.mean(), middle.mean() + 1]
    )


def test_an_interval_holds_the_truth_as_often_as_it_says() -> None:
    """The middle half of a normal distribution has its mean at 0; a bootstrap over 20 runs covers a bit too rarely."""
    draw, hits = rng(1), 0
    for _ in range(300):
        found = aggregates.of_runs([draw.normal(size=20)], draw, resamples=300)
        assert found.low is not None
        assert found.high is not None
        hits += found.low <= 0 <= found.high
    assert 0.89 <= hits / 300 <= 0.98


def test_tasks_are_resampled_each_by_itself() -> None:
    """Two tasks whose runs agree: however they are drawn, each counts with its own runs, and nothing varies."""
    found = aggregates.of_runs([np.zeros(4), np.ones(8)], rng())
    assert (found.low, found.value, found.high) == (found.value, found.value, found.value)


def test_few_runs_have_no_interval_and_none_no_value() -> None:
    assert aggregates.of_runs([SCORES[:2]], rng()).low is None
    assert aggregates.of_runs([SCORES[:2]], rng()).value == pytest.approx(2.0)
    assert aggregates.of_runs([], rng()).value is None
    assert aggregates.of_runs([SCORES, np.zeros(0)], rng()).value is None


def test_the_chance_of_improvement_counts_pairs_and_halves_ties() -> None:
    ours, theirs = np.array([1.0, 2.0, 3.0]), np.array([2.0, 2.0, 0.0])
    by_hand = np.mean([(a > b) + 0.5 * (a == b) for a in ours for b in theirs])
    assert aggregates.improvement([ours], [theirs], rng()).value == pytest.approx(by_hand)
    both = aggregates.improvement([ours, SCORES], [theirs, SCORES], rng())
    assert both.value == pytest.approx((by_hand + 0.5) / 2)
    with pytest.raises(ValueError, match="as many tasks"):
        aggregates.improvement([ours], [], rng())


@pytest.mark.parametrize("strata", [[SCORES], [SCORES, SCORES[:4]]])
def test_a_profile_is_the_share_above_each_threshold(strata: list[Floats]) -> None:
    at = np.array([0.0, 2.0, 5.3, 9.0])
    share, low, high = aggregates.profile(strata, at, rng())
    pooled = np.concatenate(strata)
    assert share == pytest.approx([(pooled > t).mean() for t in at])
    assert (low <= share).all()
    assert (share <= high).all()
    assert share[0] == low[0] == 1.0
