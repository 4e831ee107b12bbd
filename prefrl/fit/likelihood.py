"""How probable judgements are, given scores: the losses put together, with what is learned beside the reward."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from prefrl.fit import losses
from prefrl.fit.metrics import Answering
from prefrl.fit.settings import FittingSettings, Ties
from prefrl.fit.terms import Choices, Ratings, Terms
from prefrl.seeding import to_numpy
from prefrl.types import Floats, Metrics

START = 0.1
"""The error rate that a labeler is taken to have before anything is learned; below chance, or signs could turn."""
PRIOR = 1.0
"""Judgements without an error, and with one, that each labeler is taken to have given before (a beta prior)."""


class Likelihood:
    """One likelihood over judgements of every kind, on one reward for each member.

    Beside the scores it has parameters of its own, for each member apart: how readily labelers call a tie, where a
    rating scale's levels begin, and how often each labeler errs. They start anew with every fit.
    """

    def __init__(self, members: int, terms: Terms, fitting: FittingSettings) -> None:
        # Without ties, the limit that none are called.
        self._ties: Ties = fitting.ties if terms.choices.tied.any() else "half"
        self._error_rate, self._labelers = fitting.error_rate, terms.labelers
        where, start = terms.labeler.device, math.log(START / (1 - START))
        self.tie = torch.zeros(members, device=where, requires_grad=self._ties != "half")
        # Logarithms of the gaps, so that thresholds increase whatever values these take.
        # A discriminator's score is its logit: what a threshold could add is in the network's own offset.
        piles = fitting.shown_as == "piles" and terms.scale == 2
        start_level, learned_level = 0.0 if piles else -1.0, terms.scale > 0 and not piles
        self.first_threshold = torch.full((members, 1), start_level, device=where, requires_grad=learned_level)
        self.gaps = torch.zeros(members, max(terms.scale - 2, 0), device=where, requires_grad=terms.scale > 2)
        shape, learned = (members, len(terms.labelers)), fitting.reliability == "learned"
        self.errors = torch.full(shape, start, device=where, requires_grad=learned)

    def parameters(self) -> list[Tensor]:
        """What is learned beside the reward; empty where judgements need nothing."""
        return [p for p in (self.tie, self.first_threshold, self.gaps, self.errors) if p.requires_grad]

    def losses(self, terms: Terms, scores: Tensor) -> Tensor:
        """(E, S + R) negative log-likelihoods of all choices, then all ratings, from (E, N) scores."""
        chosen = self._choices(terms.choices, scores, terms.labeler)
        if not len(terms.ratings.items):
            return chosen
        return torch.cat([chosen, self._ratings(terms.ratings, scores, terms.labeler)], 1)

    def prior(self) -> Tensor:
        """(E,) negative log-density of the learned error rates' prior, in judgements' worth of nats."""
        if not self.errors.requires_grad:
            return self.errors.new_zeros(len(self.errors))
        # log(1 - e) + log e: a right answer and a wrong one.
        both = torch.nn.functional.logsigmoid(self.errors) + torch.nn.functional.logsigmoid(-self.errors)
        return -PRIOR * both.sum(1)

    def metrics(self) -> Metrics:
        """What was learned beside the reward, as means over members."""
        found = {}
        if self.tie.requires_grad:
            found["tie"] = float(self._natural_tie().mean())
        if self.errors.requires_grad:
            rates = self.errors.detach().sigmoid().mean(0).tolist()
            found |= {f"error_rate/{name}": rate for name, rate in zip(self._labelers, rates, strict=True)}
        return found

    def answering(self, terms: Terms) -> Answering:
        """How scores become answers of two, with the error of each judgement (J,) in the members' mean."""
        tie: Floats | float = to_numpy(self._natural_tie().double())[:, None] if self.tie.requires_grad else 0.0
        outcomes = 2 if self._ties == "half" else 3
        blind = self.errors.new_tensor(self._error_rate * (outcomes - 1) / outcomes)
        # (E, labelers) -> (J,): the labeler's rate at each of their judgements.
        rates = self.errors.detach().sigmoid() if self.errors.requires_grad else blind.expand_as(self.errors)
        return Answering(self._ties, tie, to_numpy(rates.mean(0)[terms.labeler].double()))

    def _natural_tie(self) -> Tensor:
        """(E,) nu, or the threshold."""
        return (
            torch.nn.functional.softplus(self.tie.detach()) if self._ties == "rao_kupper" else self.tie.detach().exp()
        )

    def thresholds(self) -> Tensor:
        """(E, levels - 1), increasing."""
        return torch.cat([self.first_threshold, self.first_threshold + self.gaps.exp().cumsum(1)], 1)

    def _choices(self, rows: Choices, scores: Tensor, labeler: Tensor) -> Tensor:
        found = scores[:, rows.items]  # (E, S, K)
        if not rows.pairs:
            found = found.masked_fill(~rows.present, -torch.inf)
        error = self._error(rows, labeler)
        if self._ties == "half":
            return losses.choice(found, rows.target, error)
        of_ties = losses.davidson if self._ties == "davidson" else losses.rao_kupper
        return of_ties(found, rows.target, rows.tied, self.tie, error)

    def _outcomes(self, rows: Choices | Ratings) -> Tensor:
        """(rows,) how many answers there could be: one for each level, or each candidate, and with ties each set."""
        if isinstance(rows, Ratings):
            return torch.full_like(rows.level, self.thresholds().shape[1] + 1)
        candidates = rows.present.sum(1)
        return candidates if self._ties == "half" else 2**candidates - 1

    def _ratings(self, rows: Ratings, scores: Tensor, labeler: Tensor) -> Tensor:
        error = self._error(rows, labeler)
        return losses.rating(scores[:, rows.items], rows.level, self.thresholds(), error)

    def _error(self, rows: Choices | Ratings, labeler: Tensor) -> Tensor | float:
        """(E, rows) how often each answer is wrong; a share of blind answers hits the right one now and then."""
        if self.errors.requires_grad:
            return self.errors.sigmoid()[:, labeler[rows.judgement]]
        if self._error_rate == 0.0:
            return 0.0
        outcomes = self._outcomes(rows)
        blind: Tensor = self._error_rate * (outcomes - 1) / outcomes  # a blind answer is right once in n
        return blind[None]


def weights(terms: Terms, of_judgement: Tensor) -> Tensor:
    """(E, S + R) how much each term counts, from the weight (E, J) of each judgement."""
    parts = (terms.choices, terms.ratings)
    return torch.cat([part.weight * of_judgement[:, part.judgement] for part in parts], 1)


def per_judgement(terms: Terms, values: Tensor) -> tuple[Tensor, Tensor]:
    """(E, S + R) values -> (E, J) sums of the terms of each judgement, and (J,) how many terms there are."""
    at = torch.cat([terms.choices.judgement, terms.ratings.judgement])
    sums = values.new_zeros(len(values), len(terms.labeler)).index_add(1, at, values)
    return sums, at.bincount(minlength=len(terms.labeler))
