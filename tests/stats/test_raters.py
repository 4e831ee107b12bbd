"""Agreement between raters, against independent implementations and by hand."""

import time
from collections.abc import Callable
from typing import Any

import krippendorff
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats
from statsmodels.stats import inter_rater
from statsmodels.stats.proportion import proportion_confint

from prefrl.stats.estimates import Estimate
from prefrl.stats.intervals import mean, position_test, share
from prefrl.stats.raters import (
    Ratings,
    agreement_with_others,
    cohen,
    cohen_kappa,
    entropies,
    fleiss_kappa,
    krippendorff_alpha,
    raw_agreement,
)
from prefrl.types import Floats

Generator = np.random.Generator
MEASURES: list[Callable[..., Estimate]] = [
    raw_agreement,
    cohen_kappa,
    fleiss_kappa,
    krippendorff_alpha,
    lambda ratings, rng, resamples=99: krippendorff_alpha(ratings, rng, "ordinal", resamples),
]


def ratings(table: Any) -> Ratings:
    """From a table (raters, items) with NaN where somebody did not answer."""
    full = np.array(table, np.float64)
    rater, item = np.nonzero(np.isfinite(full))
    return Ratings(item, rater, full[rater, item].astype(np.int64))


def noisy(rng: Generator, raters: int, items: int, right: float = 0.7, missing: float = 0.0) -> Floats:
    """(raters, items) of three categories: the true one with some probability, else any."""
    truth = rng.integers(3, size=items)
    table = np.where(rng.random((raters, items)) < right, truth, rng.integers(3, size=(raters, items)))
    return np.where(rng.random((raters, items)) < missing, np.nan, table)


@pytest.mark.parametrize("missing", [0.0, 0.4])
@pytest.mark.parametrize("level", ["nominal", "ordinal"])
def test_alpha_is_that_of_the_reference_also_where_answers_are_missing(
    rng: Generator, level: Any, missing: float
) -> None:
    table = noisy(rng, 4, 60, missing=missing)
    expected = krippendorff.alpha(reliability_data=table, level_of_measurement=level)
    assert krippendorff_alpha(ratings(table), rng, level).value == pytest.approx(expected, abs=1e-12)


def test_alpha_of_the_worked_example_of_krippendorff_2011(rng: Generator) -> None:
    x = np.nan
    table = [
        [1, 2, 3, 3, 2, 1, 4, 1, 2, x, x, x],
        [1, 2, 3, 3, 2, 2, 4, 1, 2, 5, x, 3],
        [x, 3, 3, 3, 2, 3, 4, 2, 2, 5, 1, x],
        [1, 2, 3, 3, 2, 4, 4, 1, 2, 5, 1, x],
    ]
    assert krippendorff_alpha(ratings(table), rng).value == pytest.approx(0.743, abs=5e-4)
    assert krippendorff_alpha(ratings(table), rng, "ordinal").value == pytest.approx(0.815, abs=5e-4)


def test_fleiss_is_that_of_the_reference(rng: Generator) -> None:
    table = noisy(rng, 5, 50)
    counts = inter_rater.aggregate_raters(table.T)[0]
    assert fleiss_kappa(ratings(table), rng).value == pytest.approx(inter_rater.fleiss_kappa(counts), abs=1e-12)


def test_fleiss_with_different_numbers_of_answers_by_hand(rng: Generator) -> None:
    x = np.nan
    found = fleiss_kappa(ratings([[0, 0, 1, 0], [0, 1, 1, x], [0, 1, x, x]]), rng)
    # Items agree 1, 1/3 and 1; the fourth has one answer. Of 8 answers 4 are 0 and 4 are 1, so chance is 1/2.
    assert found.value == pytest.approx(((1 + 1 / 3 + 1) / 3 - 0.5) / 0.5)
    assert found.count == 3


def test_cohen_is_that_of_the_reference_for_two(rng: Generator) -> None:
    table = noisy(rng, 2, 80)
    expected = inter_rater.cohens_kappa(inter_rater.to_table(table.T, 3)[0]).kappa
    assert cohen_kappa(ratings(table), rng).value == pytest.approx(expected, abs=1e-12)
    assert cohen(table[0].astype(int), table[1].astype(int)) == pytest.approx(expected, abs=1e-12)


def test_cohen_of_several_is_the_mean_over_pairs_weighted_with_common_items(rng: Generator) -> None:
    table = noisy(rng, 4, 60, missing=0.3)
    kappas, weights = [], []
    for a, b in ((i, j) for i in range(4) for j in range(i)):
        both = np.isfinite(table[a]) & np.isfinite(table[b])
        cells = inter_rater.to_table(table[[a, b]][:, both].T.astype(int), 3)[0]
        kappas.append(inter_rater.cohens_kappa(cells).kappa)
        weights.append(both.sum())
    assert cohen_kappa(ratings(table), rng).value == pytest.approx(np.average(kappas, weights=weights), abs=1e-12)


def test_pairs_of_raters_with_few_common_items_have_no_say_in_the_mean(rng: Generator) -> None:
    table = np.full((3, 29), np.nan)
    table[0, :20] = table[1, :20] = np.arange(20) % 2
    table[2, :9] = 1 - np.arange(9) % 2
    assert cohen_kappa(ratings(table), rng).value == 1.0
    assert cohen_kappa(ratings(table[[0, 2]]), rng).why == "no two raters judged 10 items in common"


def test_raw_agreement_counts_each_item_once(rng: Generator) -> None:
    x = np.nan
    found = raw_agreement(ratings([[0, 0, 1], [0, 0, x], [1, 0, x]]), rng)
    assert found.value == pytest.approx((1 / 3 + 1) / 2)
    assert found.count == 2


def test_each_rater_is_compared_with_the_others(rng: Generator) -> None:
    table = np.zeros((4, 20))
    table[2] = 1
    table[3, 1:] = np.nan
    first, second, odd, last = agreement_with_others(ratings(table), rng)
    assert first.value == second.value == pytest.approx((19 / 2 + 2 / 3) / 20)
    assert odd.value == 0.0
    assert last.value == pytest.approx(2 / 3)
    alone = agreement_with_others(ratings([[0, 1], [np.nan, np.nan]]), rng)
    assert [m.why for m in alone] == ["nobody else judged what this rater did"]


def test_entropy_is_in_bits() -> None:
    assert entropies(ratings([[0, 0, 0], [0, 1, 1], [0, np.nan, 2]])) == pytest.approx([0, 1, np.log2(3)])
    assert len(entropies(ratings(np.zeros((0, 0))))) == 0


@pytest.mark.parametrize("measure", MEASURES)
@pytest.mark.parametrize(
    ("table", "reason"),
    [
        (np.zeros((0, 0)), "there are no answers"),
        (np.zeros((1, 20)), "there is only one rater"),
        ([[1, np.nan], [np.nan, 1]], "no item was judged by two raters"),
    ],
)
def test_what_cannot_be_measured_says_why(
    rng: Generator, measure: Callable[..., Estimate], table: Any, reason: str
) -> None:
    assert measure(ratings(table), rng) == Estimate(why=reason)


@pytest.mark.parametrize("measure", MEASURES[1:])
def test_unanimous_answers_leave_nothing_beyond_chance(rng: Generator, measure: Callable[..., Estimate]) -> None:
    found = measure(ratings(np.ones((3, 40))), rng)
    assert (found.value, found.low, found.high) == (None, None, None)
    assert "alike" in found.why
    raw = raw_agreement(ratings(np.ones((3, 40))), rng)
    assert (raw.value, raw.high) == (1.0, 1.0)
    assert raw.low == pytest.approx(proportion_confint(40, 40, method="wilson")[0])


@pytest.mark.parametrize("measure", MEASURES)
def test_intervals_cover_the_value_that_much_data_would_give(rng: Generator, measure: Callable[..., Estimate]) -> None:
    truth = measure(ratings(noisy(rng, 3, 40_000)), rng, resamples=1).value
    assert truth is not None
    found = [measure(ratings(noisy(rng, 3, 80)), rng, resamples=199) for _ in range(100)]
    covered = sum(m.low <= truth <= m.high for m in found if m.low is not None and m.high is not None)
    assert covered >= 86, "95 of 100 are expected, and 86 or fewer come up once in a thousand times"


def test_an_interval_leaves_out_a_fortieth_on_either_side(rng: Generator) -> None:
    """Of the share of 400 items on which two agree: 1.96 standard errors either way."""
    same = np.arange(400) < 280
    found = raw_agreement(ratings([same, np.ones(400)]), rng, resamples=9999)
    assert (found.value, found.low, found.high) == pytest.approx((0.7, 0.7 - 0.0449, 0.7 + 0.0449), abs=2.5e-3)


@pytest.mark.parametrize("measure", MEASURES)
def test_numbers_hang_on_the_seed_alone(measure: Callable[..., Estimate]) -> None:
    table = noisy(np.random.default_rng(3), 4, 50, missing=0.2)
    once, again = (measure(ratings(table), np.random.default_rng(5)) for _ in range(2))
    assert once == again
    assert once.low is not None
    assert once.low < (once.value or 0) < (once.high or 0)


@settings(max_examples=150, deadline=None)
@given(
    st.lists(
        st.tuples(st.integers(0, 12), st.integers(0, 3), st.integers(0, 3)), max_size=40, unique_by=lambda t: t[:2]
    )
)
def test_every_number_is_finite_or_missing_with_a_reason(answers: list[tuple[int, int, int]]) -> None:
    item, rater, value = np.array(answers, np.int64).reshape(-1, 3).T
    some, rng = Ratings(item, rater, value, cluster=item // 2), np.random.default_rng(0)
    found = [measure(some, rng, resamples=19) for measure in MEASURES]
    for one in [*found, *agreement_with_others(some, rng, resamples=19)]:
        numbers = [n for n in (one.value, one.low, one.high) if n is not None]
        assert np.isfinite(numbers).all()
        assert max(numbers, default=0) <= 1
        assert len(numbers) == 3 or one.why or one.how
    assert np.isfinite(entropies(some)).all()


def test_items_of_one_cluster_are_resampled_together(rng: Generator) -> None:
    table = noisy(rng, 2, 60)
    copies = np.repeat(table, 10, axis=1)
    alone, same = ratings(copies), ratings(copies)
    together = Ratings(same.item, same.rater, same.value, cluster=same.item // 10)
    for measure in MEASURES:
        wide, narrow = measure(together, rng), measure(alone, rng)
        assert wide.value == pytest.approx(narrow.value)
        assert None not in (wide.low, wide.high, narrow.low, narrow.high)
        assert wide.high - wide.low > 2 * (narrow.high - narrow.low)  # type: ignore[operator]


def test_few_items_have_a_value_and_no_interval(rng: Generator) -> None:
    found = fleiss_kappa(ratings([[0, 1, 1], [0, 1, 0]]), rng)
    assert found.value is not None
    assert (found.low, found.how) == (None, "no interval: only 3 clusters")
    spread = krippendorff_alpha(ratings([[0, 1] * 10] * 2), rng)
    assert (spread.value, spread.low, spread.how) == (1.0, None, "no interval: resampling shows no spread")


def test_ratings_that_make_no_sense_are_refused() -> None:
    row = np.arange(3)
    with pytest.raises(ValueError, match="judged an item twice"):
        Ratings(np.zeros(3, int), np.array([0, 1, 0]), row)
    with pytest.raises(ValueError, match="columns of one length"):
        Ratings(row, row, row[:2])
    with pytest.raises(ValueError, match="at most 32 categories, got 40"):
        Ratings(np.arange(40), np.arange(40), np.arange(40))


def test_shares_have_the_wilson_interval_of_the_reference() -> None:
    found = share(17, 40)
    assert (found.low, found.high) == pytest.approx(proportion_confint(17, 40, method="wilson"))
    assert (found.value, found.count) == (17 / 40, 40)
    assert share(0, 0, "nobody came") == Estimate(why="nobody came")


def test_means_of_few_and_of_equal_things(rng: Generator) -> None:
    assert mean(np.array([0.0, 1.0, 1.0]), np.array([0, 0, 1]), rng).how == "no interval: only 2 clusters"
    flat = mean(np.full(50, 0.5), np.arange(50), rng)
    assert (flat.low, flat.high) == pytest.approx(proportion_confint(25, 50, method="wilson"))


def test_more_raters_make_raw_agreement_surer(rng: Generator) -> None:
    widths = []
    for raters in (2, 12):
        found = raw_agreement(ratings(noisy(rng, raters, 200)), rng)
        assert found.low is not None
        assert found.high is not None
        widths.append(found.high - found.low)
    assert widths[1] < 0.75 * widths[0]


def test_the_position_test_is_exact_and_finds_a_bias_in_a_hundred_answers(rng: Generator) -> None:
    assert position_test(8, 10) == pytest.approx(2 * stats.binom.cdf(2, 10, 0.5))
    assert position_test(0, 0) is None
    biased = [position_test(rng.binomial(100, 0.7), 100) for _ in range(200)]
    fair = [position_test(rng.binomial(100, 0.5), 100) for _ in range(200)]
    assert np.mean([p is not None and p < 0.01 for p in biased]) > 0.9
    assert np.mean([p is not None and p < 0.01 for p in fair]) < 0.03
    assert (position_test(100, 100) or 1) < 1e-20


def test_a_hundred_thousand_judgements_take_seconds_at_most(rng: Generator) -> None:
    items, overlap = 33_334, 3
    rater = rng.permuted(np.tile(np.arange(12), (items, 1)), axis=1)[:, :overlap]
    some = Ratings(np.repeat(np.arange(items), overlap), rater.ravel(), rng.integers(3, size=items * overlap))
    start = time.process_time()
    for measure in MEASURES:
        assert measure(some, rng, resamples=99).low is not None
    assert time.process_time() - start < 4.0, "half a second on an idle core"
