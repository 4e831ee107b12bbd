"""Likelihoods of judgements, on scores alone: one set of losses for control, text and ensembles.

Variants: Luce's choice (for pairs Bradley and Terry's, stage by stage Plackett's), with ties after Davidson, one
parameter for all sizes of a tie, or after Rao and Kupper, for pairs only; ratings are McCullagh's cumulative logits.
Any of them may allow for wrong answers. Left out: margins, and ties or rating thresholds of each labeler's own.

Shapes: E members, S choices among at most K candidates each, R ratings. All are stable for scores of any size, and
unchanged when all scores (and, for ratings, the thresholds) are shifted together.
"""

from __future__ import annotations

from functools import cache

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid

from prefrl.types import Integers


def preference_logits(scores: Tensor, edges: Integers) -> Tensor:
    """(E, N) scores and (M, 2) edges -> (E, M): how much better the first candidate of each edge is."""
    first, second = torch.as_tensor(edges, device=scores.device).unbind(1)
    return scores[:, first] - scores[:, second]


def choice(scores: Tensor, target: Tensor, error: Tensor | float = 0.0) -> Tensor:
    """(E, S, K) scores, -inf where there is no candidate, and (S, K) targets -> (E, S) negative log-likelihoods.

    The candidate chosen among K is drawn with probability softmax(scores) (Luce 1959). For K = 2 this is Bradley and
    Terry 1952, and a soft preference p is the target (p, 1 - p); one stage of a ranking is that of Plackett 1975.
    `error`: see `with_errors`.
    """
    log_p = scores.log_softmax(-1)
    if isinstance(error, Tensor) or error:
        log_p = with_errors(log_p, error, scores.isfinite().sum(-1, keepdim=True))
    return cross_entropy(log_p, target)


def davidson(scores: Tensor, target: Tensor, tied: Tensor, tie: Tensor, error: Tensor | float = 0.0) -> Tensor:
    """As `choice`, where the answer may also be that several candidates are equally best.

    A set T of n candidates is best with a weight of nu^(n - 1) times the geometric mean of exp(scores) over T, and
    `tie` (E,) is log nu. For two candidates this is Davidson 1970; for more, Firth, Kosmidis and Turner 2019 (section
    2), who fit one such parameter for each n. `tied` (S,): the target's candidates are tied; else it is a choice.
    """
    sets = _subsets(scores.shape[-1]).to(scores)  # (2^K - 1, K)
    sizes = sets.sum(1)
    # -inf is filled first: times the 0 of a set without that candidate it would be NaN.
    mean = scores.masked_fill(~scores.isfinite(), 0.0) @ (sets / sizes[:, None]).T  # (E, S, 2^K - 1)
    absent = (~scores.isfinite()).to(scores.dtype) @ sets.T > 0  # (E, S, 2^K - 1): a set needs all of its candidates
    total = (mean + tie[:, None, None] * (sizes - 1)).masked_fill(absent, -torch.inf)
    norm, outcomes = total.logsumexp(-1, keepdim=True), (~absent).sum(-1, keepdim=True)
    log_p = with_errors(scores - norm, error, outcomes)
    # (E, S): the target is 1 / n on the tied set, so the sum is the logarithm of its geometric mean.
    joint = (target * scores.masked_fill(target == 0, 0.0)).sum(-1) + tie[:, None] * ((target > 0).sum(-1) - 1)
    log_joint = with_errors((joint - norm[..., 0])[..., None], error, outcomes)[..., 0]
    return torch.where(tied, -log_joint, cross_entropy(log_p, target))


def rao_kupper(scores: Tensor, target: Tensor, tied: Tensor, tie: Tensor, error: Tensor | float = 0.0) -> Tensor:
    """(E, S, 2) scores -> (E, S): as `davidson` for pairs, after Rao and Kupper 1967.

    Only who is better by more than a threshold wins: P(first wins) = sigmoid(difference - threshold), and what is left
    is a tie. `tie` (E,) is the threshold's inverse softplus, which keeps it positive.
    """
    difference, threshold = scores[..., 0] - scores[..., 1], torch.nn.functional.softplus(tie)[:, None]
    wins = torch.stack([logsigmoid(difference - threshold), logsigmoid(-difference - threshold)], -1)
    # 1 - P(first) - P(second) = P(first) P(second) (exp(2 threshold) - 1), which takes no difference of near numbers.
    tie_ = wins.sum(-1) + torch.log(torch.expm1(2 * threshold))
    log_p = with_errors(torch.cat([wins, tie_[..., None]], -1), error, 3)
    return torch.where(tied, -log_p[..., 2], cross_entropy(log_p[..., :2], target))


def rating(scores: Tensor, level: Tensor, thresholds: Tensor, error: Tensor | float = 0.0) -> Tensor:
    """(E, R) scores, (R,) levels from 0 and increasing thresholds (E, levels - 1) -> (E, R), a cumulative logit model.

    P(level <= k) = sigmoid(thresholds[k] - score) (McCullagh 1980).
    """
    ends = thresholds.new_full((len(thresholds), 1), torch.inf)
    bounds = torch.cat([-ends, thresholds, ends], 1)  # (E, levels + 1): the outer levels have no end
    below, above = bounds[:, level] - scores, bounds[:, level + 1] - scores
    # log(s(a) - s(b)) = log s(a) + log s(-b) + log(1 - exp(b - a)): s(a) - s(b) would round to 0 far out.
    log_p = logsigmoid(above) + logsigmoid(-below) + torch.log(-torch.expm1(below - above))
    return -with_errors(log_p[..., None], error, bounds.shape[1] - 1)[..., 0]


def with_errors(log_p: Tensor, error: Tensor | float, outcomes: Tensor | int) -> Tensor:
    """log of the probability of an answer (..., K) that is, with probability `error`, one of the other outcomes.

    Which of them is uniform. An answer drawn blindly with probability e (Christiano et al. 2017, section 2.2.3) is the
    error e (n - 1) / n; an error above that is an adversary's. So one wrong answer cannot drive scores to infinity.
    """
    if isinstance(error, float) and error == 0.0:
        return log_p
    error = error[..., None] if isinstance(error, Tensor) else error
    others = error / (outcomes - 1)
    # p (1 - error) + (1 - p) others: meant and said, or another one meant and this one said.
    return torch.log((1 - error - others) * log_p.exp() + others)


def cross_entropy(log_p: Tensor, target: Tensor) -> Tensor:
    """(E, S, K) and (S, K) -> (E, S). What has no target may be impossible."""
    if log_p.shape[-1] > 2:
        log_p = log_p.masked_fill(target == 0, 0.0)  # 0 times -inf is NaN; the two of a pair are always there
    return -(target * log_p).sum(-1)


def weighted_mean(losses: Tensor, weight: Tensor) -> Tensor:
    """(E, M) losses and weights (M,) or (E, M) -> one number: the sum of the members' weighted means."""
    weight = weight.expand_as(losses)
    # The clamp: a bootstrap can leave a member nothing of a minibatch.
    return ((losses * weight).sum(1) / weight.sum(1).clamp(min=1e-12)).sum()


@cache
def _subsets(size: int) -> Tensor:
    """(2^K - 1, K) of 0 and 1: every set of K candidates but the empty one."""
    return ((torch.arange(1, 2**size)[:, None] >> torch.arange(size)) & 1).float()  # bit k: is candidate k in the set?
