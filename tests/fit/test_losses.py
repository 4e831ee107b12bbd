import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import expit

from prefrl.fit.losses import bradley_terry, log_preference, preference_logits, weighted_mean

finite = st.floats(-30, 30)


def test_logits_are_differences_of_scores() -> None:
    scores, edges = torch.tensor([[1.0, 2.0, 4.0], [0.0, 0.0, 1.0]]), torch.tensor([[0, 1], [2, 0]])
    torch.testing.assert_close(preference_logits(scores, edges), torch.tensor([[-1.0, 3.0], [0.0, 1.0]]))


@given(logit=finite, preference=st.floats(0, 1), error_rate=st.sampled_from([0.0, 0.1]))
def test_the_loss_is_the_cross_entropy_of_the_model(logit: float, preference: float, error_rate: float) -> None:
    p = (1 - error_rate) * expit(logit) + error_rate / 2
    q = (1 - error_rate) * expit(-logit) + error_rate / 2
    expected = -(preference * math.log(p) + (1 - preference) * math.log(q))
    got = bradley_terry(torch.tensor([[logit]], dtype=torch.float64), torch.tensor([preference]), error_rate)
    assert got.item() == pytest.approx(expected, rel=1e-6, abs=1e-9)


@given(logit=finite, shift=st.floats(-100, 100))
def test_a_shift_of_all_scores_changes_nothing(logit: float, shift: float) -> None:
    edges = torch.tensor([[0, 1]])
    a = preference_logits(torch.tensor([[logit, 0.0]], dtype=torch.float64), edges)
    b = preference_logits(torch.tensor([[logit + shift, shift]], dtype=torch.float64), edges)
    torch.testing.assert_close(bradley_terry(a, torch.tensor([1.0])), bradley_terry(b, torch.tensor([1.0])))


def test_swapping_the_candidates_swaps_the_preference() -> None:
    logits = torch.tensor([[0.7, -2.0]])
    torch.testing.assert_close(
        bradley_terry(logits, torch.tensor([0.9, 0.2]), 0.1), bradley_terry(-logits, torch.tensor([0.1, 0.8]), 0.1)
    )


def test_a_tie_pulls_scores_together() -> None:
    logits = torch.tensor([[2.0]], requires_grad=True)
    bradley_terry(logits, torch.tensor([0.5])).sum().backward()  # type: ignore[no-untyped-call]
    assert logits.grad is not None
    assert logits.grad.item() > 0


def test_confident_mistakes_still_have_a_gradient_and_no_infinities() -> None:
    logits = torch.tensor([[-500.0, 500.0]], requires_grad=True)
    loss = bradley_terry(logits, torch.tensor([1.0, 0.0]))
    loss.sum().backward()  # type: ignore[no-untyped-call]
    torch.testing.assert_close(loss.detach(), torch.tensor([[500.0, 500.0]]))
    torch.testing.assert_close(logits.grad, torch.tensor([[-1.0, 1.0]]))


def test_an_error_rate_bounds_what_one_wrong_label_can_cost() -> None:
    assert log_preference(torch.tensor(-1000.0), 0.1).item() == pytest.approx(math.log(0.05))


def test_gradients_agree_with_finite_differences() -> None:
    logits = torch.randn(2, 3, dtype=torch.float64, requires_grad=True)
    preference = torch.tensor([0.0, 0.5, 0.8], dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda x: bradley_terry(x, preference, 0.1), logits)


def test_members_are_averaged_on_their_own_weights_and_summed() -> None:
    losses, weight = torch.tensor([[1.0, 3.0], [10.0, 20.0]]), torch.tensor([[1.0, 1.0], [0.0, 2.0]])
    assert weighted_mean(losses, weight).item() == pytest.approx(2 + 20)
    assert weighted_mean(losses, torch.tensor([3.0, 1.0])).item() == pytest.approx(1.5 + 12.5)
