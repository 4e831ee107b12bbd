import math

import numpy as np
import pytest

from prefrl.fit.metrics import accuracy, brier, calibration_error


def test_accuracy_leaves_ties_out_and_gives_half_for_an_even_prediction() -> None:
    predicted, preference = np.array([0.9, 0.4, 0.5, 0.9]), np.array([1.0, 1.0, 0.0, 0.5])
    assert accuracy(predicted, preference) == pytest.approx((1 + 0 + 0.5) / 3)


def test_nothing_to_measure_is_nan_and_not_a_number_made_up() -> None:
    empty = np.array([])
    assert math.isnan(accuracy(empty, empty))
    assert math.isnan(accuracy(np.array([0.7]), np.array([0.5])))
    assert math.isnan(brier(empty, empty))
    assert math.isnan(calibration_error(empty, empty))


def test_brier_by_hand() -> None:
    assert brier(np.array([1.0, 0.5]), np.array([1.0, 0.0])) == pytest.approx(0.125)


def test_a_calibrated_prediction_has_no_calibration_error(rng: np.random.Generator) -> None:
    predicted = rng.uniform(size=20_000)
    preference = (rng.uniform(size=20_000) < predicted).astype(float)
    assert calibration_error(predicted, preference) < 0.015
    assert calibration_error(np.full(100, 0.9), np.full(100, 0.5)) == pytest.approx(0.4)


def test_calibration_does_not_depend_on_which_candidate_comes_first(rng: np.random.Generator) -> None:
    predicted, preference = rng.uniform(size=100), rng.integers(0, 2, 100).astype(float)
    assert calibration_error(predicted, preference) == pytest.approx(calibration_error(1 - predicted, 1 - preference))
