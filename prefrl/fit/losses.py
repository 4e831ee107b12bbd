"""Likelihoods of judgements, on scores and edges alone: one loss serves pairs, rankings, control, text, ensembles."""

from __future__ import annotations

import math

import torch
from torch import Tensor
from torch.nn.functional import logsigmoid


def preference_logits(scores: Tensor, edges: Tensor) -> Tensor:
    """(E, N) scores and (M, 2) edges -> (E, M): how much better the first candidate of each edge is."""
    return scores[:, edges[:, 0]] - scores[:, edges[:, 1]]


def bradley_terry(logits: Tensor, preference: Tensor, error_rate: float = 0.0) -> Tensor:
    """(E, M) negative log-likelihoods of soft preferences (M,) under Bradley and Terry 1952.

    A tie is a preference of 0.5. With `error_rate` e, an answer is a coin flip with probability e (Christiano et al.
    2017, section 2.2.3), so that one wrong label cannot drive scores to infinity. Stable for logits of any size.
    """
    first, second = log_preference(logits, error_rate), log_preference(-logits, error_rate)
    return -(preference * first + (1 - preference) * second)


def log_preference(logits: Tensor, error_rate: float = 0.0) -> Tensor:
    """log P(first is judged better): log sigmoid, mixed with a coin flip."""
    if error_rate == 0.0:
        return logsigmoid(logits)
    floor = torch.full_like(logits, math.log(error_rate / 2))
    return torch.logaddexp(logsigmoid(logits) + math.log1p(-error_rate), floor)


def weighted_mean(losses: Tensor, weight: Tensor) -> Tensor:
    """(E, M) losses and weights (M,) or (E, M) -> one number: the sum of the members' weighted means."""
    weight = weight.expand_as(losses)
    return ((losses * weight).sum(1) / weight.sum(1).clamp(min=1e-12)).sum()
