"""The policy-gradient core against closed forms and exact enumeration: a vocabulary of 3, sequences of length 3."""

import itertools
import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from prefrl.improve import objectives as o

V, L = 3, 3
SEQUENCES = torch.tensor(list(itertools.product(range(V), repeat=L)))
PREFIXES = [prefix for t in range(L) for prefix in itertools.product(range(V), repeat=t)]
ROWS = torch.tensor([[PREFIXES.index(tuple(s[:t].tolist())) for t in range(L)] for s in SEQUENCES])
MASK = torch.ones(len(SEQUENCES), L)
BETA = 0.3


def make(seed: int) -> Tensor:
    """A policy without structure: logits for each of the 13 prefixes."""
    return torch.randn(len(PREFIXES), V, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def token_logp(theta: Tensor) -> Tensor:
    """(27, 3): log-probabilities of every token of every sequence."""
    return theta.log_softmax(-1)[ROWS, SEQUENCES]


def probability(theta: Tensor) -> Tensor:
    return token_logp(theta).sum(1).exp()


THETA, REF = make(0).requires_grad_(), make(1)
REWARD = torch.randn(len(SEQUENCES), generator=torch.Generator().manual_seed(2), dtype=torch.float64)
P = probability(THETA).detach()


def exact_objective(theta: Tensor) -> Tensor:
    """E[r] - beta KL(pi || ref), by enumeration."""
    logp, ref = token_logp(theta).sum(1), token_logp(REF).sum(1)
    return (logp.exp() * (REWARD - BETA * (logp - ref))).sum()


def gradient(value: Tensor) -> Tensor:
    return torch.autograd.grad(value, THETA)[0]


def expected(losses: Tensor) -> Tensor:
    """The expectation under the policy's own samples, whose probabilities are constants to the estimator."""
    return (P * losses).sum()


def kl_rewards() -> Tensor:
    kl = o.kl_k1(token_logp(THETA).detach(), token_logp(REF))
    return o.step_rewards(REWARD, kl, MASK, BETA)


def to_go(rewards: Tensor) -> Tensor:
    """(B, L): the sum of the rewards from each step on."""
    return rewards.flip(1).cumsum(1).flip(1)


def test_reinforce_with_kl_in_the_reward_has_the_exact_gradient() -> None:
    loss = expected(o.policy_gradient(token_logp(THETA), to_go(kl_rewards())).sum(1))
    torch.testing.assert_close(gradient(loss), -gradient(exact_objective(THETA)))


def test_whole_sequence_advantages_have_the_exact_gradient_too() -> None:
    scores = kl_rewards().sum(1, keepdim=True).expand(-1, L)
    loss = expected(o.policy_gradient(token_logp(THETA), scores).sum(1))
    torch.testing.assert_close(gradient(loss), -gradient(exact_objective(THETA)))


def test_leave_one_out_is_unbiased_over_all_pairs_of_samples() -> None:
    scores = kl_rewards().sum(1)
    pairs = torch.tensor(list(itertools.product(range(len(P)), repeat=2)))
    advantages = o.leave_one_out(scores[pairs])
    logp = token_logp(THETA).sum(1)[pairs]
    loss = (P[pairs].prod(1) * o.policy_gradient(logp, advantages).mean(1)).sum()
    torch.testing.assert_close(gradient(loss), -gradient(exact_objective(THETA)))


def test_the_clipped_surrogate_at_ratio_one_has_the_policy_gradient() -> None:
    advantages = torch.randn(len(P), L, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    logp = token_logp(THETA)
    ratios = o.log_ratio(logp, logp.detach(), MASK)
    clipped = gradient(o.clipped_surrogate(ratios, advantages, 0.2).sum())
    torch.testing.assert_close(clipped, gradient(o.policy_gradient(token_logp(THETA), advantages).sum()))


def test_the_optimum_is_the_reference_tilted_by_the_reward() -> None:
    logp = (token_logp(REF).sum(1) + REWARD / BETA).log_softmax(0)
    tilted = torch.empty_like(THETA)
    for row, prefix in enumerate(PREFIXES):
        below = (
            (SEQUENCES[:, : len(prefix)] == torch.tensor(prefix)).all(1) if prefix else torch.ones(27, dtype=torch.bool)
        )
        for token in range(V):
            tilted[row, token] = logp[below & (SEQUENCES[:, len(prefix)] == token)].logsumexp(0)
    best = tilted.detach().requires_grad_()
    torch.testing.assert_close(probability(best), logp.exp())
    torch.testing.assert_close(torch.autograd.grad(exact_objective(best), best)[0], torch.zeros_like(best))


def exact_kl(a: Tensor, b: Tensor) -> Tensor:
    return (probability(a) * (token_logp(a) - token_logp(b)).sum(1)).sum()


def sequence_logp(theta: Tensor) -> Tensor:
    return token_logp(theta).sum(1)


def test_k1_and_k3_are_unbiased_estimates_of_the_kl() -> None:
    for estimator in (o.kl_k1, o.kl_k3):
        value = expected(estimator(sequence_logp(THETA), sequence_logp(REF)))
        torch.testing.assert_close(value, exact_kl(THETA, REF))
    assert (o.kl_k3(sequence_logp(THETA), sequence_logp(REF)) >= 0).all()


def test_the_kl_summed_over_a_sequence_is_learned_from_as_a_reward_is() -> None:
    apart = o.kl_k1(token_logp(THETA), token_logp(REF)).detach().sum(1, keepdim=True)
    loss = expected(-o.policy_gradient(token_logp(THETA), apart).sum(1))
    torch.testing.assert_close(gradient(loss), gradient(exact_kl(THETA, REF)))


def test_as_a_loss_neither_k1_nor_k3_will_do() -> None:
    ref = sequence_logp(REF)
    zero = torch.zeros_like(THETA)
    torch.testing.assert_close(gradient(expected(o.kl_k1(sequence_logp(THETA), ref))), zero)
    reverse = gradient(exact_kl(REF, THETA))
    torch.testing.assert_close(gradient(expected(o.kl_k3(sequence_logp(THETA), ref))), reverse)


def naive_gae(
    rewards: Tensor, values: Tensor, following: Tensor, ends: Tensor, discount: float, trace: float
) -> Tensor:
    """The definition: sums of discounted TD residuals up to the end of the episode."""
    out = torch.zeros_like(rewards)
    for b, t in itertools.product(range(rewards.shape[0]), range(rewards.shape[1])):
        weight = 1.0
        for k in range(t, rewards.shape[1]):
            out[b, t] += weight * (rewards[b, k] + discount * following[b, k] - values[b, k])
            if ends[b, k]:
                break
            weight *= discount * trace
    return out


@given(seed=st.integers(0, 1000), discount=st.sampled_from([0.0, 0.9, 1.0]), trace=st.sampled_from([0.0, 0.95, 1.0]))
@settings(max_examples=30, deadline=None)
def test_gae_is_its_definition(seed: int, discount: float, trace: float) -> None:
    g = torch.Generator().manual_seed(seed)
    rewards, values, following = torch.randn(3, 2, 6, generator=g, dtype=torch.float64)
    ends = torch.rand(2, 6, generator=g) < 0.3
    got = o.gae(rewards, values, following, ends, discount, trace)
    torch.testing.assert_close(got, naive_gae(rewards, values, following, ends, discount, trace))


def test_gae_without_discount_or_trace_decay_is_return_minus_value() -> None:
    rewards, values = torch.randn(2, 2, 5, dtype=torch.float64)
    following = torch.cat([values[:, 1:], torch.zeros(2, 1, dtype=torch.float64)], 1)
    ends = torch.zeros(2, 5)
    ends[:, -1] = 1
    got = o.gae(rewards, values, following, ends, 1.0, 1.0)
    torch.testing.assert_close(got, to_go(rewards) - values)


def test_a_time_limit_bootstraps_and_a_termination_does_not() -> None:
    rewards, values, ends = torch.ones(2, 1), torch.zeros(2, 1), torch.ones(2, 1)
    following = torch.tensor([[10.0], [0.0]])  # truncated; terminated
    torch.testing.assert_close(o.gae(rewards, values, following, ends, 0.9, 1.0), torch.tensor([[10.0], [1.0]]))


def test_step_rewards_put_the_score_on_the_last_real_token() -> None:
    kl, mask = torch.tensor([[1.0, 2.0, 9.0], [1.0, 2.0, 3.0]]), torch.tensor([[1.0, 1, 0], [1, 1, 1]])
    got = o.step_rewards(torch.tensor([10.0, 20.0]), kl, mask, 0.5)
    torch.testing.assert_close(got, torch.tensor([[-0.5, 9.0, 0.0], [-0.5, -1.0, 18.5]]))


def test_step_rewards_of_an_empty_response_are_zero() -> None:
    got = o.step_rewards(torch.tensor([10.0]), torch.ones(1, 3), torch.zeros(1, 3), 0.5)
    torch.testing.assert_close(got, torch.zeros(1, 3))


def test_reductions_by_hand_and_their_length_bias() -> None:
    x, mask = torch.tensor([[1.0, 1.0, 1.0, 1.0], [3.0, math.nan, math.nan, math.nan]]), torch.ones(2, 4)
    mask[1, 1:] = 0
    assert o.reduce(x, mask, "token", 2, 5).item() == pytest.approx(7 / 5)
    assert o.reduce(x, mask, "sequence", 2, 5).item() == pytest.approx((1 + 3) / 2)
    assert o.reduce(x, mask, "constant", 2, 5).item() == pytest.approx(7 / 2)
    for how in ("token", "sequence", "constant"):
        parts = [o.reduce(x[i : i + 1], mask[i : i + 1], how, 2, 5) for i in range(2)]
        torch.testing.assert_close(sum(parts), o.reduce(x, mask, how, 2, 5))


def test_masked_statistics_ignore_what_padding_holds() -> None:
    x, mask = torch.tensor([[1.0, 2.0, 3.0, math.nan]]), torch.tensor([[1.0, 1, 1, 0]])
    assert o.masked_mean(x, mask).item() == pytest.approx(2)
    white = o.masked_whiten(x, mask)
    scale = math.sqrt(1.5)
    torch.testing.assert_close(white, torch.tensor([[-scale, 0.0, scale, 0.0]]))


def test_groups_of_equal_scores_get_exactly_no_advantage() -> None:
    scores = torch.tensor([[0.1, 0.1, 0.1], [1.0, 2.0, 3.0]])
    normalised = o.group_normalised(scores, eps=0.0)
    assert (normalised[0] == 0).all()
    torch.testing.assert_close(normalised[1], torch.tensor([-1.0, 0.0, 1.0]))
    torch.testing.assert_close(o.leave_one_out(scores)[1], torch.tensor([1 - 2.5, 0.0, 3 - 1.5]))


@pytest.mark.parametrize("advantage", [o.leave_one_out, o.group_normalised])
def test_one_response_a_prompt_is_an_error(advantage: object) -> None:
    assert callable(advantage)
    with pytest.raises(ValueError, match="at least 2 responses"):
        advantage(torch.ones(4, 1))


def test_the_surrogate_stops_paying_outside_the_clip() -> None:
    ratios = torch.tensor([0.5, 1.0, 1.5]).log().requires_grad_()
    up = o.clipped_surrogate(ratios, torch.ones(3), 0.2)
    torch.testing.assert_close(up, torch.tensor([-0.5, -1.0, -1.2]))
    down = o.clipped_surrogate(ratios, -torch.ones(3), 0.2)
    torch.testing.assert_close(down, torch.tensor([0.8, 1.0, 1.5]))
    assert torch.autograd.grad(up.sum(), ratios)[0][2] == 0


def test_log_ratios_are_bounded_and_zero_on_padding() -> None:
    got = o.log_ratio(torch.tensor([[1000.0, math.nan]]), torch.zeros(1, 2), torch.tensor([[1.0, 0.0]]))
    torch.testing.assert_close(got, torch.tensor([[o.MAX_LOG_RATIO, 0.0]]))


def test_the_adaptive_coefficient_moves_towards_its_target_and_no_faster_than_allowed() -> None:
    start = o.AdaptiveKL(beta=0.1, target=6.0, horizon=1000)
    assert start.update(6.0, 100).beta == pytest.approx(0.1)
    assert start.update(600.0, 100).beta == pytest.approx(0.1 * (1 + 0.2 * 0.1))
    assert start.update(0.0, 100).beta == pytest.approx(0.1 * (1 - 0.2 * 0.1))


def test_win_rates_by_hand() -> None:
    nan = float("nan")
    found = o.win_rates(torch.tensor([[0.0, 2.0, -1.0], [5.0, nan, 5.0], [nan, 3.0, nan]], dtype=torch.float64))
    s = torch.tensor([0.0, 1.0, 2.0, 3.0], dtype=torch.float64).sigmoid()
    others = torch.stack([((1 - s[2]) + s[1]) / 2, (s[2] + s[3]) / 2, ((1 - s[1]) + (1 - s[3])) / 2])
    torch.testing.assert_close(found[0], (2 * others + 0.5) / 3)
    torch.testing.assert_close(o.leave_one_out(found[:1])[0], others - 0.5)
    torch.testing.assert_close(found[1:], found.new_tensor([[0.5, nan, 0.5], [nan, 0.5, nan]]), equal_nan=True)
    assert float(found[0].mean()) == pytest.approx(0.5)  # what one wins another loses


def test_log_quantiles_by_hand() -> None:
    nan = float("nan")
    found = o.log_quantiles(torch.tensor([0.0, 2.0, 5.0, nan]), torch.tensor([3.0, nan, 1.0, 2.0]))
    torch.testing.assert_close(found.exp(), torch.tensor([0.5 / 4, 2.0 / 4, 3.5 / 4, nan]), equal_nan=True)


@pytest.mark.parametrize("n", [2, 8])
def test_the_optimum_for_log_quantiles_is_the_best_of_n(n: int) -> None:
    scores = torch.randn(4000, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    tilted = ((n - 1) * o.log_quantiles(scores, scores)).softmax(0)  # the start is uniform on these, beta = 1 / (n - 1)
    share = torch.arange(4001, dtype=torch.float64) / 4000
    best = torch.empty(4000, dtype=torch.float64).scatter_(0, scores.argsort(), (share**n).diff())
    assert float((tilted - best).abs().sum()) < 2e-3  # twice the total variation


def test_what_was_not_scored_is_in_no_baseline() -> None:
    """By hand: as if it were not there."""
    scores = torch.tensor([[1.0, 3.0, math.nan], [math.nan, 5.0, math.nan]])
    assert o.leave_one_out(scores).tolist() == [[-2.0, 2.0, 0.0], [0.0, 0.0, 0.0]]
    assert o.batch_centred(scores).tolist() == [[-2.0, 0.0, 0.0], [0.0, 2.0, 0.0]]
    two = o.group_normalised(torch.tensor([[1.0, 3.0]]))
    torch.testing.assert_close(o.group_normalised(scores)[:1, :2], two)
    torch.testing.assert_close(o.batch_scaled(scores)[0], torch.tensor([-1.0, 1.0, 0.0]) / (2 + 1e-4))
    assert o.all_equal(scores).tolist() == [False, True]


def test_a_trace_of_one_within_plans_makes_decisions_of_them() -> None:
    """Plans of 2, 3 and 1 steps: advantages are those of three decisions, whose rewards are sums over their steps."""
    rng, discount, trace = np.random.default_rng(0), 0.9, 0.8
    rewards, values = rng.normal(size=(1, 6)), rng.normal(size=(1, 7))
    into = np.array([[1.0, trace, 1.0, 1.0, trace, trace]])  # what each step leads to: within a plan, or a new one
    ends = torch.zeros(1, 6, dtype=torch.bool)
    given, here, following = (torch.from_numpy(x) for x in (rewards, values[:, :-1], values[:, 1:]))
    found = o.gae(given, here, following, ends, discount, torch.from_numpy(into))[0, [0, 2, 5]]
    expected, running = [], 0.0
    for start, steps in ((5, 1), (2, 3), (0, 2)):
        reward = sum(discount**k * rewards[0, start + k] for k in range(steps))
        delta = reward + discount**steps * values[0, start + steps] - values[0, start]
        running = delta + discount**steps * trace * running
        expected.append(running)
    np.testing.assert_allclose(found, expected[::-1], rtol=1e-9)
