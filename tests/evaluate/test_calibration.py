"""The bins of a reliability diagram, by hand."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prefrl.evaluate.calibration import reliability
from prefrl.stats.estimates import wilson


def test_bins_by_hand() -> None:
    predicted = np.array([0.55, 0.45, 0.95, 0.05, 1.0])
    preference = np.array([1.0, 1.0, 1.0, 0.5, 0.0])
    low, high = reliability(predicted, preference)
    assert (low.count, high.count) == (2, 3)
    assert low.confidence == pytest.approx(0.55)
    assert low.share == pytest.approx(0.5)  # 1, and 0 after turning round
    assert high.confidence == pytest.approx((0.95 + 0.95 + 1.0) / 3)
    assert high.share == pytest.approx((1 + 0.5 + 0) / 3)


@given(st.lists(st.tuples(st.floats(0, 1), st.sampled_from([0.0, 0.5, 1.0])), min_size=1))
def test_the_order_of_the_two_candidates_does_not_matter(rows: list[tuple[float, float]]) -> None:
    p, y = np.array(rows).T
    decided = p != 0.5  # an even prediction has no favourite
    one, other = reliability(p[decided], y[decided]), reliability(1 - p[decided], 1 - y[decided])
    assert sum(b.count for b in one) == sum(b.count for b in other) == decided.sum()
    assert sum(b.count * b.share for b in one) == pytest.approx(sum(b.count * b.share for b in other))


def test_the_interval_is_wilsons() -> None:
    # 8 of 10 at 95 %, as tabulated (Brown, Cai and DasGupta 2001 give the formula).
    assert wilson(0.8, 10) == pytest.approx((0.4901, 0.9433), abs=1e-3)
    assert wilson(1.0, 3)[1] == pytest.approx(1.0)
    assert wilson(1.0, 3)[0] > 0.4


def test_nothing_gives_no_bins_and_unequal_rows_are_refused() -> None:
    assert reliability(np.zeros(0), np.zeros(0)) == ()
    with pytest.raises(ValueError, match="two equal rows"):
        reliability(np.zeros(2), np.zeros(3))
