import math

import numpy as np
import pytest
import torch

from prefrl.fit.losses import davidson, rao_kupper
from prefrl.fit.metrics import Answering, accuracy, brier, calibration_error, log_losses, temperature
from prefrl.fit.settings import Ties


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


def test_a_calibration_error_is_the_same_whichever_comparisons_are_turned_round() -> None:
    """Two favourites at 0.9 of which one wins and one wins four times of five: 0.9 on average, as predicted."""
    predicted, preference = np.array([0.9, 0.9]), np.array([1.0, 0.8])
    assert calibration_error(predicted, preference) == pytest.approx(0.0)
    turned = np.array([False, True])
    assert calibration_error(
        np.where(turned, 1 - predicted, predicted), np.where(turned, 1 - preference, preference)
    ) == pytest.approx(0.0)


def test_a_temperature_finds_by_how_much_logits_are_too_large(rng: np.random.Generator) -> None:
    true = rng.normal(size=(1, 5000))
    preference = (rng.uniform(size=5000) < 1 / (1 + np.exp(-true[0]))).astype(float)
    assert temperature(3 * true, preference) == pytest.approx(3, rel=0.1)
    error = np.full(5000, 0.2)
    turned = np.where(rng.uniform(size=5000) < error, 1 - preference, preference)
    assert temperature(3 * true, turned, Answering(error=error)) == pytest.approx(3, rel=0.2)


def test_few_comparisons_move_a_temperature_little() -> None:
    assert temperature(np.zeros((2, 0)), np.zeros(0)) == 1.0
    wrong = np.array([[4.0, 4.0]])
    many, few, light = (
        temperature(np.tile(wrong, n), np.zeros(2 * n), None, w) for n, w in ((50, 1.0), (1, 1.0), (1, 0.1))
    )
    assert 1.0 < light < few < many


def test_the_probability_of_an_answer_is_mixed_with_mistakes() -> None:
    logits = np.log([[0.9 / 0.1]])
    assert Answering(error=0.1).expected(logits)[0] == pytest.approx(0.9 * 0.9 + 0.1 * 0.1)
    blind = Answering("davidson", tie=1.0, error=2 / 3)  # one of three answers, whatever is felt
    assert blind.expected(logits)[0] == pytest.approx(0.5)
    assert Answering(error=np.array([0.5, 0.0])).of(np.array([1])).expected(logits)[0] == pytest.approx(0.9)


@pytest.mark.parametrize(("ties", "tie"), [("davidson", 0.7), ("rao_kupper", 0.4)])
@pytest.mark.parametrize("error", [0.0, 0.2])
def test_an_expected_preference_is_that_of_the_likelihood_with_a_tie_as_a_half(
    ties: Ties, tie: float, error: float
) -> None:
    scores = torch.tensor([[[1.0, -0.3], [0.2, 2.0], [0.0, 0.0]], [[-1.0, 0.5], [3.0, 0.0], [0.1, 0.1]]]).double()
    free = torch.full((2,), math.log(tie) if ties == "davidson" else math.log(math.expm1(tie))).double()
    loss = davidson if ties == "davidson" else rao_kupper
    wins, half = torch.tensor([[1.0, 0.0]] * 3), torch.tensor([[0.5, 0.5]] * 3)
    first = (-loss(scores, wins, torch.zeros(3, dtype=torch.bool), free, error)).exp()
    tied = (-loss(scores, half, torch.ones(3, dtype=torch.bool), free, error)).exp()
    expected = (first + tied / 2).mean(0).numpy()
    logits = (scores[..., 0] - scores[..., 1]).numpy()
    np.testing.assert_allclose(Answering(ties, tie, error).expected(logits), expected, rtol=1e-6)
    each = np.full((2, 1), tie)
    np.testing.assert_allclose(Answering(ties, each, error).expected(logits), expected, rtol=1e-6)


def test_log_losses_are_finite_however_sure_a_model_is() -> None:
    sure, preference = np.array([[1000.0, -1000.0]]), np.array([1.0, 1.0])
    assert log_losses(sure, preference, Answering()).mean() == 500.0
    assert log_losses(sure, preference, Answering("davidson", 0.5)).mean() == pytest.approx(250.0, rel=0.01)
