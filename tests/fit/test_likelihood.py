"""What was shown told from the learner's own by a discriminator: by hand, and at its optimum."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from prefrl.components import ConfigError
from prefrl.config import Config
from prefrl.fit.likelihood import Likelihood
from prefrl.fit.settings import FittingSettings, check_shown
from prefrl.fit.terms import terms
from prefrl.judgements import Demonstrated, Demonstration, Judged, Rating
from prefrl.store import Store
from prefrl.types import Query, Segment

NO_CLONE = ("learner.clone.epochs=0", "learner.clone.keep=0")
PILES = FittingSettings(shown_as="piles")


def step(state: int) -> Segment:
    """A step in one of a few states, that differs from nothing but other states."""
    return Segment(np.eye(3, dtype=np.float32)[[state]], np.zeros((1, 2), np.float32), f"state {state}", 0)


def told_apart(own: int, like: int, weight: float = 1.0) -> list[Judged[Segment]]:
    query, shown = Query((step(own),)), step(like)
    return Demonstrated(query, shown, Demonstration(query.id, shown.id, "ann", weight=weight)).told_apart(0.5)


def test_what_was_shown_and_what_it_answers_count_each_for_itself() -> None:
    own, shown = told_apart(0, 1, weight=3.0)
    assert [own.query.candidates[0].episode, shown.query.candidates[0].episode] == ["state 0", "state 1"]
    assert [one.judgement for one in (own, shown)] == [
        Rating(one.query.id, (level,), 2, "ann", weight=1.5) for level, one in enumerate((own, shown))
    ]
    assert told_apart(2, 2) == []


def test_the_loss_of_a_discriminator_is_the_logistic_one_of_each_step_by_hand() -> None:
    """-log D of what is shown, -log(1 - D) of the learner's own, with D = sigmoid(score); nothing else is learned."""
    judged = told_apart(0, 1)
    found = terms(judged, [one.query.candidates[0].id for one in judged], "half", "plackett_luce")
    likelihood = Likelihood(2, found, PILES)
    losses = likelihood.losses(found, torch.tensor([[0.7, 2.0], [-0.4, -1.0]]))
    expected = [[np.log1p(np.exp(a)), np.log1p(np.exp(-b))] for a, b in ((0.7, 2.0), (-0.4, -1.0))]
    np.testing.assert_allclose(losses, expected, rtol=1e-6)
    assert likelihood.parameters() == []


def test_at_the_optimum_a_score_is_the_log_ratio_of_how_often_a_step_was_shown_and_done() -> None:
    """Goodfellow et al. 2014, proposition 1, on three states: done 3, 2 and 1 times, and shown once, twice, 3 times."""
    own, shown = [0, 0, 0, 1, 1, 2], [1, 2, 2, 0, 2, 1]
    judged = [one for pair in zip(own, shown, strict=True) for one in told_apart(*pair)]
    found = terms(judged, [step(state).id for state in range(3)], "half", "plackett_luce")
    scores = torch.zeros(1, 3, dtype=torch.float64, requires_grad=True)
    optimizer, likelihood = torch.optim.LBFGS([scores], line_search_fn="strong_wolfe"), Likelihood(1, found, PILES)

    def loss() -> float:
        optimizer.zero_grad()
        value = likelihood.losses(found, scores).sum()
        value.backward()  # type: ignore[no-untyped-call]
        return float(value.detach())

    optimizer.step(loss)  # type: ignore[no-untyped-call]
    np.testing.assert_allclose(scores.detach()[0], np.log([1 / 3, 2 / 2, 3 / 1]), atol=1e-4)


@pytest.mark.parametrize(
    "changes",
    [["labeler.kind=oracle", "select.candidates=2"], ["reward.kind=linear"]],
    ids=["nobody shows", "no offset"],
)
def test_piles_are_refused_where_nothing_is_told_apart(changes: list[str], tmp_path: Path) -> None:
    config = Config.load("control/pendulum-adversarial", ["fitting.shown_as=piles", *NO_CLONE, *changes])
    with Store[Segment](tmp_path) as store, pytest.raises(ConfigError, match=r"fitting\.shown_as"):
        config.build(store)


def test_piles_are_refused_where_demonstrations_do_not_count() -> None:
    with pytest.raises(ConfigError, match=r"nothing shown counts.* fitting\.demonstrations=1"):
        check_shown(FittingSettings(shown_as="piles", demonstrations=0.0), shows=True)
