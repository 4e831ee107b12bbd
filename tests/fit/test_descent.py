from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from prefrl.fit.descent import UNJUDGED, Problem, _Descent, ensemble_loss
from prefrl.fit.likelihood import Likelihood
from prefrl.fit.settings import FittingSettings
from prefrl.fit.terms import terms
from prefrl.judgements import Choice, Comparison, Judged, Ranking, Rating
from prefrl.types import Query, Segment


class Given:
    """One member, and a score for each candidate."""

    members = 1

    def __init__(self, scores: Sequence[float]) -> None:
        self._scores = torch.nn.Parameter(torch.tensor([scores]))

    def scores(self, stacked: dict[str, torch.Tensor]) -> torch.Tensor:
        return self._scores[:, stacked["at"]]

    def parameters(self) -> list[torch.nn.Parameter]:
        return [self._scores]


def problem(scores: Sequence[float], judged: Sequence[Judged[Segment]], **settings: Any) -> Problem[Segment]:
    """A fit of `scores` for the candidates in the order in which they were judged."""
    candidates = {c.id: c for one in judged for c in one.query.candidates}
    every = terms(judged, list(candidates), "half", "plackett_luce")
    reward: Any = Given(scores)
    return Problem(
        reward=reward,
        candidates=list(candidates.values()),
        judged=len(candidates),
        stacked={"at": torch.arange(len(candidates))},
        every=every,
        train=every,
        test=every.subset(torch.zeros(len(judged), dtype=torch.bool)),
        likelihood=Likelihood(1, every, FittingSettings(**settings)),
        weight=torch.ones(1, len(judged)),
        fitting=FittingSettings(**settings),
    )


def kept(found: Problem[Segment]) -> list[float]:
    return _Descent(found, np.random.default_rng(0))._trusted()[1][0].tolist()


def test_a_loss_on_some_judgements_scores_their_candidates_alone(make_segment: Callable[..., Segment]) -> None:
    judged = [Judged(q, Comparison(q.id, 1.0)) for q in (Query((make_segment(), make_segment())) for _ in range(3))]
    found = problem([1.0, 0.0, 4.0, 0.0, 3.0, 9.0], judged)
    part, scored = found.every.subset(torch.arange(3) == 1), []
    scores = found.reward.scores

    def watched(stacked: Any) -> torch.Tensor:
        scored.extend(stacked["at"].tolist())
        return scores(stacked)

    found.reward.scores = watched  # type: ignore[method-assign]
    assert ensemble_loss(found, part) == pytest.approx(np.log1p(np.exp(-4.0)), rel=1e-5)
    assert scored == [2, 3]


def test_before_anything_is_known_the_best_of_many_is_trusted_as_much_as_a_pair(
    make_segment: Callable[..., Segment],
) -> None:
    queries = [Query(tuple(make_segment() for _ in range(size))) for size in (2, 4, 8) for _ in range(5)]
    choices = [Judged(q, Choice(q.id, 0)) for q in queries]
    assert kept(problem([0.0] * 70, choices, denoise="filter")) == [1.0] * 15


def test_an_improbable_tie_is_left_out_for_it_cannot_be_turned_round(make_segment: Callable[..., Segment]) -> None:
    queries = [Query((make_segment(), make_segment())) for _ in range(30)]
    judged = [Judged(q, Comparison(q.id, 0.5 if i == 0 else float(i > 1))) for i, q in enumerate(queries)]
    assert kept(problem([40.0, 0.0, 40.0, 0.0] + [5.0, 0.0] * 28, judged, denoise="flip")) == [0.0] + [1.0] * 29


def test_the_prior_of_error_rates_is_weighed_against_all_that_was_judged(make_segment: Callable[..., Segment]) -> None:
    three = Query(tuple(make_segment() for _ in range(3)))
    one = problem([1.0, 0.5, 0.0], [Judged(three, Ranking(three.id, (0, 1, 2), weight=5.0))], reliability="learned")
    mean = one.loss(one.train, one.weight, torch.Generator())
    total = one.total(one.reward.scores(one.stacked)) + one.likelihood.prior()
    torch.testing.assert_close(mean, total[0] / 10)  # two choices, each of weight 5


@pytest.mark.parametrize("kind", ["comparison", "ranking", "rating"])
def test_pseudo_labels_are_counted_by_judgement_whatever_its_kind(
    make_segment: Callable[..., Segment], kind: str
) -> None:
    queries = [Query(tuple(make_segment() for _ in range(2 if kind == "comparison" else 4))) for _ in range(5)]
    made: dict[str, Callable[[Query[Segment]], Any]] = {
        "comparison": lambda q: Comparison(q.id, 1.0),
        "ranking": lambda q: Ranking(q.id, (0, 1, 1, 1)),
        "rating": lambda q: Rating(q.id, (0, 1, 2, 2), 3),
    }
    judged = [Judged(q, made[kind](q)) for q in queries]
    one = problem([0.0] * len({c.id for q in queries for c in q.candidates}), judged, pseudo_labels=1.0)
    one = replace(one, candidates=[*one.candidates, *(make_segment() for _ in range(10))])
    assert len(one._unjudged(one.train, torch.Generator())) == UNJUDGED * 5
