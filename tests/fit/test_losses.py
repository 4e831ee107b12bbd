import itertools
import math
from collections.abc import Callable

import choix
import numpy as np
import pytest
import statsmodels.api as sm
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import expit
from scipy.stats import logistic
from statsmodels.miscmodels.ordinal_model import OrderedModel

from prefrl.fit.losses import choice, davidson, preference_logits, rao_kupper, rating, weighted_mean, with_errors

finite = st.floats(-30, 30)
NO, YES = torch.tensor([False]), torch.tensor([True])


def row(*values: float) -> torch.Tensor:
    """One row of scores of one member, (1, 1, K)."""
    return torch.tensor([[list(values)]], dtype=torch.float64)


def target(*values: float) -> torch.Tensor:
    return torch.tensor([list(values)], dtype=torch.float64)


def test_logits_are_differences_of_scores() -> None:
    scores, edges = torch.tensor([[1.0, 2.0, 4.0], [0.0, 0.0, 1.0]]), np.array([[0, 1], [2, 0]])
    torch.testing.assert_close(preference_logits(scores, edges), torch.tensor([[-1.0, 3.0], [0.0, 1.0]]))


@given(logit=finite, preference=st.floats(0, 1), blind=st.sampled_from([0.0, 0.1]))
def test_a_choice_of_two_is_the_cross_entropy_of_bradley_and_terry(
    logit: float, preference: float, blind: float
) -> None:
    p = (1 - blind) * expit(logit) + blind / 2
    q = (1 - blind) * expit(-logit) + blind / 2
    expected = -(preference * math.log(p) + (1 - preference) * math.log(q))
    got = choice(row(logit, 0.0), target(preference, 1 - preference), blind / 2)
    assert got.item() == pytest.approx(expected, rel=1e-6, abs=1e-9)


def test_a_choice_among_several_agrees_with_choix(rng: np.random.Generator) -> None:
    scores = rng.normal(size=5)
    expected = -choix.log_likelihood_top1([(3, (0, 1, 4))], scores)
    got = choice(row(*scores[[3, 0, 1, 4]], -math.inf), target(1, 0, 0, 0, 0))
    assert got.item() == pytest.approx(expected)


def test_davidson_for_two_is_his_formula() -> None:
    a, b, nu = math.exp(0.7), math.exp(-0.4), 0.8
    total = a + b + nu * math.sqrt(a * b)
    tie = torch.tensor([math.log(nu)], dtype=torch.float64)
    scores = row(0.7, -0.4)
    assert davidson(scores, target(1, 0), NO, tie).item() == pytest.approx(-math.log(a / total))
    assert davidson(scores, target(0.5, 0.5), YES, tie).item() == pytest.approx(
        -math.log(nu * math.sqrt(a * b) / total)
    )


def test_rao_and_kupper_is_their_formula() -> None:
    a, b, theta = math.exp(0.7), math.exp(-0.4), 1.9
    tie = torch.tensor([math.log(math.expm1(math.log(theta)))], dtype=torch.float64)  # inverse softplus of log theta
    win, loss = a / (a + theta * b), b / (b + theta * a)
    scores = row(0.7, -0.4)
    assert rao_kupper(scores, target(1, 0), NO, tie).item() == pytest.approx(-math.log(win))
    assert rao_kupper(scores, target(0.5, 0.5), YES, tie).item() == pytest.approx(-math.log(1 - win - loss))


@pytest.fixture
def tournament(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """(M, 2) who met, among five, and (M,) what came of it: 1 the first won, 0 a tie, -1 the second won."""
    pairs = np.array(list(itertools.combinations(range(5), 2)) * 40)
    worth = np.array([0.9, 0.4, 0.0, -0.5, -0.8])
    outcome = worth[pairs[:, 0]] - worth[pairs[:, 1]] + rng.logistic(size=len(pairs))
    return pairs, np.where(np.abs(outcome) < 0.7, 0, np.sign(outcome)).astype(int)


def most_likely(loss: Callable[..., torch.Tensor], pairs: np.ndarray, outcomes: np.ndarray) -> tuple[np.ndarray, float]:
    """The scores (5,), the first of them 0, and the natural tie parameter that a likelihood of ours is highest at."""
    scores = torch.zeros(5, dtype=torch.float64, requires_grad=True)
    tie = torch.zeros(1, dtype=torch.float64, requires_grad=True)
    wanted = torch.as_tensor(np.stack([(outcomes + 1) / 2, (1 - outcomes) / 2], 1))
    optimizer = torch.optim.LBFGS([scores, tie], max_iter=200, tolerance_grad=1e-10, line_search_fn="strong_wolfe")

    def closure() -> torch.Tensor:
        optimizer.zero_grad()
        value = loss(scores[torch.as_tensor(pairs)][None], wanted, torch.as_tensor(outcomes == 0), tie).sum()
        value.backward()  # type: ignore[no-untyped-call]
        return value

    optimizer.step(closure)  # type: ignore[no-untyped-call]
    return (scores - scores[0]).detach().numpy(), float(tie.detach())


def test_davidson_is_highest_where_statsmodels_finds_his_log_linear_model(
    tournament: tuple[np.ndarray, np.ndarray],
) -> None:
    """Counts of a tournament are Poisson, with a level of its own for each pair (Fienberg and Larntz 1976)."""
    pairs, outcomes = tournament
    counts: dict[tuple[int, int, int], int] = dict.fromkeys(
        ((i, j, o) for i, j in itertools.combinations(range(5), 2) for o in (1, 0, -1)), 0
    )
    for (i, j), o in zip(pairs.tolist(), outcomes.tolist(), strict=True):
        counts[i, j, o] += 1
    levels = list(itertools.combinations(range(5), 2))
    design = np.zeros((len(counts), len(levels) + 4 + 1))
    for row, (i, j, o) in zip(design, counts, strict=True):
        row[levels.index((i, j))] = 1
        for who, share in ((i, (1 + o) / 2), (j, (1 - o) / 2)):
            if who:
                row[len(levels) + who - 1] = share
        row[-1] = o == 0
    theirs = sm.GLM(np.array(list(counts.values())), design, family=sm.families.Poisson()).fit(tol=1e-12).params
    scores, log_nu = most_likely(davidson, pairs, outcomes)
    np.testing.assert_allclose(scores[1:], theirs[len(levels) : -1], atol=1e-5)
    assert log_nu == pytest.approx(theirs[-1], abs=1e-5)


def test_rao_and_kupper_is_highest_where_statsmodels_finds_its_ordered_logit(
    tournament: tuple[np.ndarray, np.ndarray],
) -> None:
    """Win, tie and loss are levels of a cumulative logit in the difference; told both ways round, its thresholds are
    symmetric."""
    pairs, outcomes = tournament
    design = np.zeros((len(pairs), 5))
    rows = np.arange(len(pairs))
    design[rows, pairs[:, 0]], design[rows, pairs[:, 1]] = 1, -1
    both, told = np.concatenate([design, -design])[:, 1:], np.concatenate([outcomes, -outcomes])
    theirs = OrderedModel(told + 1, both, distr="logit").fit(method="bfgs", gtol=1e-9, disp=False).params
    scores, tie = most_likely(rao_kupper, pairs, outcomes)
    np.testing.assert_allclose(scores[1:], theirs[:4], atol=1e-4)
    assert np.logaddexp(0, tie) == pytest.approx(-theirs[4], abs=1e-4)


@pytest.mark.parametrize("size", [2, 3, 4])
def test_the_outcomes_of_davidson_are_all_that_can_happen(size: int, rng: np.random.Generator) -> None:
    scores, tie = row(*rng.normal(size=size)), torch.tensor([0.3], dtype=torch.float64)
    probability = 0.0
    for count in range(1, size + 1):
        for members in itertools.combinations(range(size), count):
            aim = target(*[(i in members) / count for i in range(size)])
            probability += math.exp(-davidson(scores, aim, torch.tensor([count > 1]), tie).item())
    assert probability == pytest.approx(1)


def test_candidates_that_are_not_there_change_nothing() -> None:
    tie = torch.tensor([0.3], dtype=torch.float64)
    narrow, wide = row(0.3, 1.0), row(0.3, 1.0, -math.inf)
    for aim, tied in (((1.0, 0.0), NO), ((0.5, 0.5), YES)):
        torch.testing.assert_close(
            davidson(narrow, target(*aim), tied, tie), davidson(wide, target(*aim, 0.0), tied, tie)
        )
    torch.testing.assert_close(choice(narrow, target(1, 0)), choice(wide, target(1, 0, 0)))


def test_ratings_have_the_likelihood_of_statsmodels_ordered_logit(rng: np.random.Generator) -> None:
    x, level = rng.normal(size=200), rng.integers(0, 4, 200)
    model = OrderedModel(level, x[:, None], distr=logistic)
    thresholds = np.array([-1.0, 0.2, 1.5])
    packed = np.array([0.8, thresholds[0], *np.log(np.diff(thresholds))])  # as statsmodels keeps them in order
    scores = torch.tensor(0.8 * x)[None]
    ours = rating(scores, torch.tensor(level), torch.tensor(thresholds)[None])
    assert ours.sum().item() == pytest.approx(-model.loglike(packed))


@given(shift=st.floats(-50, 50))
def test_a_shift_of_all_scores_changes_nothing(shift: float) -> None:
    scores, tie = row(0.7, -1.0, 0.2), torch.tensor([0.3], dtype=torch.float64)
    aim, half = target(1, 0, 0), target(0.5, 0.5, 0)
    torch.testing.assert_close(choice(scores + shift, aim), choice(scores, aim))
    torch.testing.assert_close(davidson(scores + shift, half, YES, tie), davidson(scores, half, YES, tie))
    pair = scores[..., :2]
    torch.testing.assert_close(
        rao_kupper(pair + shift, aim[:, :2], NO, tie), rao_kupper(pair, aim[:, :2], NO, tie), rtol=1e-6, atol=1e-9
    )
    level, thresholds = torch.tensor([0, 1, 2]), torch.tensor([[-1.0, 1.0]], dtype=torch.float64)
    torch.testing.assert_close(
        rating(scores[0] + shift, level, thresholds + shift), rating(scores[0], level, thresholds), rtol=1e-6, atol=1e-9
    )


def test_gradients_agree_with_finite_differences() -> None:
    generator = torch.Generator().manual_seed(0)
    scores = torch.randn(2, 3, 3, dtype=torch.float64, generator=generator).requires_grad_()
    tie = torch.tensor([0.3, -0.2], dtype=torch.float64, requires_grad=True)
    error = torch.tensor([[0.1, 0.2, 0.3], [0.2, 0.1, 0.4]], dtype=torch.float64, requires_grad=True)
    aim = torch.tensor([[1.0, 0, 0], [0.5, 0.5, 0], [0.3, 0.7, 0]], dtype=torch.float64)
    tied = torch.tensor([False, True, False])
    assert torch.autograd.gradcheck(lambda x, e: choice(x, aim, e), (scores, error))
    assert torch.autograd.gradcheck(lambda x, t, e: davidson(x, aim, tied, t, e), (scores, tie, error))
    pairs = scores[..., :2].detach().requires_grad_()
    assert torch.autograd.gradcheck(lambda x, t: rao_kupper(x, aim[:, :2], tied, t, 0.1), (pairs, tie))
    level = torch.tensor([0, 1, 2])
    thresholds = torch.tensor([[-1.0, 1.0], [0.0, 0.5]], dtype=torch.float64, requires_grad=True)
    rated = scores[..., 0].detach().requires_grad_()
    assert torch.autograd.gradcheck(lambda x, c, e: rating(x, level, c, e), (rated, thresholds, error))


TIE = torch.zeros(1, dtype=torch.float64)
OF_A_TIE: list[Callable[[torch.Tensor], torch.Tensor]] = [
    lambda x: choice(x, target(0.5, 0.5)),
    lambda x: davidson(x, target(0.5, 0.5), YES, TIE),
    lambda x: rao_kupper(x, target(0.5, 0.5), YES, TIE),
]


@pytest.mark.parametrize("loss", OF_A_TIE)
def test_a_tie_pulls_scores_together(loss: Callable[[torch.Tensor], torch.Tensor]) -> None:
    scores = row(2.0, 0.0).requires_grad_()
    loss(scores).sum().backward()  # type: ignore[no-untyped-call]
    assert scores.grad is not None
    assert scores.grad[0, 0, 0] > 0.01


def test_confident_mistakes_still_have_a_gradient_and_no_infinities() -> None:
    scores = torch.tensor([[[-500.0, 0.0], [500.0, 0.0]]], requires_grad=True)
    loss = choice(scores, torch.tensor([[1.0, 0.0], [0.0, 1.0]]))
    loss.sum().backward()  # type: ignore[no-untyped-call]
    torch.testing.assert_close(loss.detach(), torch.tensor([[500.0, 500.0]]))
    torch.testing.assert_close(scores.grad[0, :, 0], torch.tensor([-1.0, 1.0]))  # type: ignore[index]
    middle = rating(torch.tensor([[900.0]]), torch.tensor([1]), torch.tensor([[-1.0, 1.0]]))
    assert middle.item() == pytest.approx(899 - math.log(-math.expm1(-2)), rel=1e-4)


def test_an_error_rate_bounds_what_one_wrong_label_can_cost() -> None:
    cost = choice(torch.tensor([[[-1000.0, 0.0]]]), torch.tensor([[1.0, 0.0]]), 0.05)
    assert cost.item() == pytest.approx(-math.log(0.05))


def test_a_labeler_who_is_always_wrong_of_two_says_the_opposite() -> None:
    log_p = torch.log(torch.tensor([0.9, 0.1]))
    torch.testing.assert_close(with_errors(log_p, torch.tensor(1.0), 2).exp(), torch.tensor([0.1, 0.9]))
    blind = with_errors(torch.log(torch.tensor([0.7, 0.2, 0.1])), torch.tensor(2 / 3), 3)
    torch.testing.assert_close(blind.exp(), torch.full((3,), 1 / 3))


def test_members_are_averaged_on_their_own_weights_and_summed() -> None:
    losses, weight = torch.tensor([[1.0, 3.0], [10.0, 20.0]]), torch.tensor([[1.0, 1.0], [0.0, 2.0]])
    assert weighted_mean(losses, weight).item() == pytest.approx(2 + 20)
    assert weighted_mean(losses, torch.tensor([3.0, 1.0])).item() == pytest.approx(1.5 + 12.5)
