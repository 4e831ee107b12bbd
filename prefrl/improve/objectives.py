"""The policy-gradient core: pure functions over masked (B, L) tensors, shared by control and text.

A row is an episode, or a response: its steps are actions, or tokens. `mask` (B, L) is 1 on real steps and 0 on
padding. REINFORCE, RLOO, GRPO and PPO are choices of baseline, advantage, clip and KL placement from this file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

Reduction: TypeAlias = Literal["token", "sequence", "constant"]
MAX_LOG_RATIO = 20.0
"""Log-ratios are clamped to this before exp, so that one improbable token cannot make infinities."""


@dataclass(frozen=True)
class Objective:
    """What a gradient step minimises; a weight of 0 leaves its term out."""

    clip: float | None = None
    """How far the ratio of new to old probability counts; None for the plain policy gradient."""
    policy: bool = True
    """False: the critic alone learns."""
    value: float = 0.0
    """Weight of the critic's loss."""
    value_clip: float | None = None
    """How far a value may go from the batch's before its loss no longer falls; None for the plain loss."""
    entropy: float = 0.0
    """Weight of the entropy bonus."""
    kl: float = 0.0
    """Weight of the exact KL of each step to the starting policy, for policies that know it (DPOK, Fan et al. 2023)."""
    reduction: Reduction = "token"
    """How the steps of the policy's terms are averaged; the critic's and the entropy's are means over steps."""
    max_grad_norm: float = math.inf
    """A gradient that is longer is shortened to this."""


# --- Masked statistics ------------------------------------------------------------------------------------------


def masked_sum(x: Tensor, mask: Tensor) -> Tensor:
    """The sum over real steps. Padding may hold anything, NaN included."""
    return torch.where(mask.bool(), x, 0.0).sum()  # not x * mask: NaN times 0 is NaN


def masked_mean(x: Tensor, mask: Tensor) -> Tensor:
    """The mean over real steps; 0 where there are none."""
    return masked_sum(x, mask) / mask.sum().clamp(min=1)


def masked_whiten(x: Tensor, mask: Tensor, eps: float = 1e-8) -> Tensor:
    """Shift and scale to mean 0 and unit (biased) variance over real steps; padding becomes 0."""
    mean = masked_mean(x, mask)
    variance = masked_mean((x - mean) ** 2, mask)
    # eps under the root: where all steps are alike they become 0, not NaN.
    return torch.where(mask.bool(), (x - mean) * torch.rsqrt(variance + eps), 0.0)


def reduce(x: Tensor, mask: Tensor, how: Reduction, rows: int, steps: int) -> Tensor:
    """One number from per-step losses (B, L), of a minibatch of `rows` sequences that have `steps` real steps.

    - token: the mean over all real steps (DAPO, PPO). Long rows weigh more.
    - sequence: the mean over rows of each row's mean (GRPO). A step of a long row weighs less.
    - constant: the sum divided by the number of rows (REINFORCE, RLOO). No length bias: the gradient of the expected
      return itself.

    What the parts of a minibatch come to adds up to what the whole does.
    """
    if how == "token":
        return masked_sum(x, mask) / steps
    if how == "sequence":
        # The clamp: a row without a real step has no mean, and adds 0.
        return (torch.where(mask.bool(), x, 0.0).sum(1) / mask.sum(1).clamp(min=1)).sum() / rows
    return masked_sum(x, mask) / rows


# --- Rewards, returns, advantages -------------------------------------------------------------------------------


def step_rewards(scores: Tensor, kl: Tensor, mask: Tensor, beta: float) -> Tensor:
    """(B, L) rewards of responses: -beta x kl at each token, and the score (B,) at the last real one.

    Ziegler et al. 2019, equation 2, with the KL written per token (estimator k1).
    """
    last = (mask.sum(1).long() - 1).clamp(min=0)  # (B,); an empty row points at 0, and gets no score below
    rewards = torch.where(mask.bool(), -beta * kl, 0.0)
    return rewards.scatter_add(1, last[:, None], (scores * mask.any(1))[:, None].to(rewards.dtype))


def gae(
    rewards: Tensor, values: Tensor, next_values: Tensor, ends: Tensor, discount: float, trace: float | Tensor
) -> Tensor:
    """(B, L) generalised advantages (Schulman et al. 2016, equation 16).

    `next_values` is the value of what each step led to: 0 after a termination, the value of the final observation
    after a truncation. `ends` is 1 where an episode stops, for either reason. `trace` may differ from step to step,
    (B, L): it is that of what the step leads to. Padding must be 0 in every argument.
    """
    delta = rewards + discount * next_values - values
    # Any end cuts the trace: what comes after a time limit is another episode, though its value still bootstraps.
    keep = discount * trace * (1.0 - ends.to(delta.dtype))
    running, found = torch.zeros_like(delta[:, 0]), []  # (B,)
    for here, kept in reversed([*zip(delta.unbind(1), keep.unbind(1), strict=True)]):
        running = here + kept * running
        found.append(running)
    return torch.stack(found[::-1], 1)


# A score that is NaN was not given: it counts in no baseline, and what has it gets advantage 0.


def win_rates(scores: Tensor) -> Tensor:
    """(P, K) scores of K responses to each of P prompts -> how often each beats one of its prompt's.

    By Bradley and Terry, from the scores as they are: a beats b with s(score_a - score_b). A response ties with itself;
    `leave_one_out` takes that out again, and leaves the win rate against the others minus a half.
    """
    apart = scores[:, :, None] - scores[:, None, :]  # (P, K, K)
    won = torch.where(_known(apart), apart.sigmoid(), 0.0).sum(2) / _known(scores).sum(1, keepdim=True).clamp(min=1)
    return torch.where(_known(scores), won, math.nan)


def log_quantiles(scores: Tensor, start: Tensor) -> Tensor:
    """(B,) scores and (N,) scores of the starting policy's responses -> log of the share of those that each beats.

    At a price of 1 / (n - 1) a nat its optimum is the best of n (Sessa et al. 2024, BOND), where scores are spread
    alike for all prompts: in the paper the share is of each prompt's own. A tie counts half, and half a response is
    taken to lie below all others, so that every logarithm is finite.
    """
    ranked = start[_known(start)].sort().values
    beaten = (torch.searchsorted(ranked, scores) + torch.searchsorted(ranked, scores, right=True)) / 2
    return torch.where(_known(scores), torch.log((beaten + 0.5) / (len(ranked) + 1)), math.nan)


def leave_one_out(scores: Tensor) -> Tensor:
    """(P, K) scores of K responses to each of P prompts, minus the mean of the other K - 1 (RLOO, Ahmadian 2024)."""
    if scores.shape[1] < 2:
        raise ValueError(f"leave-one-out needs at least 2 responses a prompt, got {scores.shape[1]}")
    count = _known(scores).sum(1, keepdim=True)
    # x_i - (sum - x_i) / (K - 1) = (x_i - mean) K / (K - 1): no sum over the others for each i.
    return _centred(scores, 1) * (count / (count - 1).clamp(min=1))  # one alone has no others: it is centred to 0


def group_normalised(scores: Tensor, eps: float = 1e-4) -> Tensor:
    """(P, K) scores minus their group's mean, over its (unbiased) std plus eps (GRPO, Shao et al. 2024).

    A group of equal scores gets exactly 0.
    """
    if scores.shape[1] < 2:
        raise ValueError(f"group normalisation needs at least 2 responses a prompt, got {scores.shape[1]}")
    centred = _centred(scores, 1)
    count = _known(scores).sum(1, keepdim=True)
    std = (centred.square().sum(1, keepdim=True) / (count - 1).clamp(min=1)).sqrt()
    # The mean of equal numbers can differ from them in its last bit, which a std of 0 plus eps would blow up.
    return torch.where(all_equal(scores)[:, None], 0.0, centred / (std + eps))


def batch_scaled(scores: Tensor, eps: float = 1e-4) -> Tensor:
    """(P, K) scores minus their group's mean, over the (unbiased) std of all of them plus eps: a group in which little
    differs stays small (Hu et al. 2025, REINFORCE++ with group baselines). Where no score differs all are 0."""
    known = scores[_known(scores)]
    spread = known.std() if len(known) > 1 else known.new_zeros(())
    return torch.where(all_equal(scores)[:, None], 0.0, _centred(scores, 1) / (spread + eps))


def batch_centred(scores: Tensor) -> Tensor:
    """(P, K) scores minus the mean of all (REINFORCE with a constant baseline)."""
    return _centred(scores, (0, 1))


def all_equal(scores: Tensor) -> Tensor:
    """(P,) whether the scores of a group, those that were given, do not differ."""
    low, high = (torch.where(_known(scores), scores, x) for x in (math.inf, -math.inf))
    return low.amin(1) >= high.amax(1)


def _known(scores: Tensor) -> Tensor:
    return ~scores.isnan()


def _centred(scores: Tensor, over: int | tuple[int, int]) -> Tensor:
    """Minus the mean of those that were given; 0 for the others."""
    known = _known(scores)
    total = torch.where(known, scores, 0.0).sum(over, keepdim=True)
    return torch.where(known, scores - total / known.sum(over, keepdim=True).clamp(min=1), 0.0)


# --- Losses, one number a step ----------------------------------------------------------------------------------


def log_ratio(logp: Tensor, old_logp: Tensor, mask: Tensor) -> Tensor:
    """log pi(a) - log pi_old(a), clamped; 0 on padding, whatever it holds."""
    # Padding goes first: a clamp lets NaN through.
    return torch.where(mask.bool(), logp - old_logp, 0.0).clamp(-MAX_LOG_RATIO, MAX_LOG_RATIO)


def policy_gradient(logp: Tensor, advantages: Tensor) -> Tensor:
    """REINFORCE (Williams 1992): minus log pi(a) x advantage, whose gradient is the policy gradient."""
    return -logp * advantages.detach()


def clipped_surrogate(log_ratios: Tensor, advantages: Tensor, clip: float) -> Tensor:
    """PPO's pessimistic surrogate, negated (Schulman et al. 2017, equation 7).

    At ratio 1 its gradient is that of `policy_gradient`.
    """
    ratio = log_ratios.exp()
    return -torch.minimum(ratio * advantages, ratio.clamp(1 - clip, 1 + clip) * advantages)


def value_loss(values: Tensor, returns: Tensor) -> Tensor:
    """Half the squared error."""
    return 0.5 * (values - returns) ** 2


# --- Losses of preferences, one number a pair or a response -------------------------------------------------------
# A response's gain is log pi(y|x) - log ref(y|x), and a pair's gap the first one's gain minus the second one's.
# `preference` in [0, 1] is for the first of a pair, and `smoothing` the share of them that are taken to be wrong.


def dpo_loss(margins: Tensor, preference: Tensor, smoothing: float) -> Tensor:
    """(M,) losses of pairs from beta x their gaps (M,).

    Rafailov et al. 2023, equation 7, with soft targets (cDPO, Mitchell 2023).
    """
    right = _right(preference, smoothing)
    # log(1 - s(h)) as logsigmoid(-h): the other way it is log 0 for a large margin.
    return -(right * logsigmoid(margins) + (1 - right) * logsigmoid(-margins))


def ipo_loss(gaps: Tensor, preference: Tensor, smoothing: float, beta: float) -> Tensor:
    """(M,) squared distances of gaps (M,) from 1 / (2 beta), or from minus that where the second is better.

    Azar et al. 2024, equation 17. A soft preference p is p times the one and 1 - p times the other: the expectation
    over answers, which is least at a gap of (2p - 1) / (2 beta).
    """
    right, target = _right(preference, smoothing), 1 / (2 * beta)
    return right * (gaps - target) ** 2 + (1 - right) * (gaps + target) ** 2


def kto_loss(gains: Tensor, desirable: Tensor, point: Tensor, beta: float) -> Tensor:
    """(B,) losses of single responses from their gains (B,): 1 minus how good each one's gain is felt to be.

    Ethayarajh et al. 2024, equation 8, before its weights: s(beta (gain - point)) is the value of a response that is
    `desirable` (B,), s(beta (point - gain)) that of another. No gradient passes through the reference point.
    """
    lead = gains - point.detach()
    return torch.sigmoid(-beta * torch.where(desirable, lead, -lead))  # 1 - s(x) is s(-x)


def cpl_loss(first: Tensor, second: Tensor, preference: Tensor, bias: float) -> Tensor:
    """(M,) losses of pairs of segments from their scores (M,): alpha x the discounted sums of log pi(a|s).

    Hejna et al. 2024, equation 5, with the conservative bias of equation 6: the score of the worse one counts `bias`
    times, so that it does not help to make both improbable. A soft preference p is p times the loss with the first as
    the better one, plus 1 - p times the loss with the second.
    """
    ahead, behind = logsigmoid(first - bias * second), logsigmoid(second - bias * first)
    return -(preference * ahead + (1 - preference) * behind)


def expectile_loss(errors: Tensor, expectile: float) -> Tensor:
    """Squares that weigh `expectile` above 0 and 1 - `expectile` below (Kostrikov et al. 2022, equation 4)."""
    return torch.where(errors > 0, expectile, 1 - expectile) * errors**2


def _right(preference: Tensor, smoothing: float) -> Tensor:
    """(M,) the probability that the first of a pair is better."""
    return preference * (1 - smoothing) + (1 - preference) * smoothing


# --- KL(pi || ref) from samples of pi ----------------------------------------------------------------------------
# With d = log pi(a) - log ref(a). As a number k1 and k3 are unbiased. As a loss none will do: k1's gradient is 0 in
# expectation, k3's is that of the other direction, KL(ref || pi), and d^2 / 2 of each step by itself (k2) does not
# charge a choice for the KL of the steps that it leads to. So k1, summed over a sequence, is a cost like any other.


def kl_k1(logp: Tensor, ref_logp: Tensor) -> Tensor:
    """d: unbiased, can be negative, high variance. For use in the reward."""
    return logp - ref_logp


def kl_k3(logp: Tensor, ref_logp: Tensor) -> Tensor:
    """exp(-d) - 1 + d: unbiased, never negative, low variance. For reports."""
    d = (logp - ref_logp).clamp(-MAX_LOG_RATIO, MAX_LOG_RATIO)
    return torch.expm1(-d) + d


@dataclass(frozen=True)
class AdaptiveKL:
    """A KL coefficient steered to a target in nats per sequence (Ziegler et al. 2019, section 2.2)."""

    beta: float = 0.15
    target: float = 6.0
    horizon: float = 10_000.0
    """Sequences over which the coefficient reacts."""

    def update(self, kl: float, sequences: int) -> AdaptiveKL:
        """`kl`: the mean KL per sequence (not per token) over the last `sequences`."""
        # The paper's clip: one batch far off the target moves beta no further than one 20 % off.
        error = min(max(kl / self.target - 1.0, -0.2), 0.2)
        return replace(self, beta=self.beta * (1.0 + error * sequences / self.horizon))
