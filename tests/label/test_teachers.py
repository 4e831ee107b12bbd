"""Noise that is asked for as a rate comes at that rate, whatever scale the gold is on."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from prefrl.judgements import Answer, Comparison, Ranking, Rating, Skip
from prefrl.label import teachers
from prefrl.label.oracle import Oracle, OracleSettings
from prefrl.label.teachers import Limits, Survey
from prefrl.types import Query, Response

Draw = Callable[[np.random.Generator, tuple[int, int]], np.ndarray]
GOLDS: dict[str, Draw] = {
    "normal": lambda rng, size: rng.normal(size=size),
    "tiny and shifted": lambda rng, size: 1e6 + 1e-3 * rng.normal(size=size),
    "huge and negative": lambda rng, size: -1e5 * rng.exponential(size=size),
    "heavy tails": lambda rng, size: rng.standard_t(2, size=size),
    "two humps": lambda rng, size: rng.normal(size=size) + 20 * rng.integers(0, 2, size=size),
}


def asked(golds: np.ndarray, fresh: int | None = None, first: bool = True) -> Survey[Response]:
    """Queries with these golds (Q, K); the last `fresh` of them are new, all by default."""
    queries = [
        Query(tuple(Response(str(i), str(k), gold=np.array([g])) for k, g in enumerate(row)))
        for i, row in enumerate(golds)
    ]
    gold = {q.id: [c.gold for c in q.candidates if c.gold is not None] for q in queries}
    return Survey(queries, gold, frozenset(q.id for q in queries[-(fresh or len(queries)) :]), first)


def answers(found: Survey[Response], **settings: Any) -> tuple[list[Answer], Limits]:
    oracle = Oracle(OracleSettings(**settings))
    limits = oracle.limits(found)
    rngs = np.random.default_rng(0).spawn(len(found.queries))
    said = [oracle.judge(q, found.gold[q.id], r, limits) for q, r in zip(found.queries, rngs, strict=True)]
    return said, limits


def rates(found: Survey[Response], said: list[Answer]) -> dict[str, float]:
    """Shares: of queries skipped, of judged pairs tied, of decided pairs in the wrong order."""
    tied, wrong = [], []
    for query, answer in zip(found.queries, said, strict=True):
        gold = [float(g.sum()) for g in found.gold[query.id]]
        if isinstance(answer, Comparison):
            ranks = (1, 0) if answer.preference < 0.5 else (0, int(answer.preference > 0.5))
        elif isinstance(answer, Ranking):
            ranks = answer.ranks  # type: ignore[assignment]
        else:
            continue
        pairs = [(i, j) for i in range(len(gold)) for j in range(i)]
        tied += [ranks[i] == ranks[j] for i, j in pairs]
        wrong += [(ranks[i] < ranks[j]) != (gold[i] > gold[j]) for i, j in pairs if ranks[i] != ranks[j]]
    skipped = np.mean([isinstance(a, Skip) for a in said])
    return {"skip": float(skipped), "tie": float(np.mean(tied)), "error": float(np.mean(wrong))}


@pytest.mark.parametrize("name", GOLDS)
@pytest.mark.parametrize(("size", "queries"), [(2, 600), (4, 200)])
def test_errors_ties_and_skips_come_at_the_rates_asked_for(
    name: str, size: int, queries: int, rng: np.random.Generator
) -> None:
    found = asked(GOLDS[name](rng, (queries, size)))
    said, _ = answers(found, error_rate=0.15, tie_rate=0.2, skip_rate=0.1)
    measured = rates(found, said)
    assert measured["skip"] == pytest.approx(0.1, abs=1 / queries)
    assert measured["tie"] == pytest.approx(0.2, abs=0.01)
    assert measured["error"] == pytest.approx(0.15, abs=0.05)


@pytest.mark.parametrize("rate", [0.01, 0.05, 0.3, 0.45])
def test_the_error_rate_holds_from_nearly_none_to_nearly_half(rate: float, rng: np.random.Generator) -> None:
    found = asked(rng.normal(size=(1000, 2)))
    said, _ = answers(found, error_rate=rate)
    assert rates(found, said)["error"] == pytest.approx(rate, abs=0.03)


def test_a_fixed_rationality_means_another_error_rate_on_every_task(rng: np.random.Generator) -> None:
    """Why rates are offered: beta = 1 is nearly an oracle on one scale of gold and a coin on another."""
    golds = rng.normal(size=(400, 2))
    errors = [rates(a, answers(a, rationality=1.0)[0])["error"] for a in (asked(golds * 50), asked(golds / 50))]
    assert errors[0] < 0.03
    assert errors[1] > 0.4


@given(
    st.lists(st.lists(st.integers(-5, 5), min_size=3, max_size=3), min_size=1, max_size=30),
    st.floats(0.0, 0.99),
    st.floats(1e-3, 1e3),
)
def test_thresholds_never_exceed_their_rate_and_follow_the_scale(
    golds: list[list[int]], rate: float, scale: float
) -> None:
    block = np.array(golds, float) * scale
    below = teachers.skip_threshold([block], rate)
    assert np.mean(block.max(1) < below) <= rate + 1e-9
    within = teachers.tie_threshold([block], rate)
    tied = teachers.gaps([teachers.tie_groups(block, within)]) == 0
    exact = teachers.gaps([teachers.tie_groups(block, 0.0)]) == 0
    assert np.mean(tied) <= max(rate, np.mean(exact)) + 1e-9


def test_ties_of_equal_gold_alone_leave_the_threshold_at_zero() -> None:
    assert teachers.tie_threshold([np.array([[1.0, 1.0], [1.0, 1.0], [0.0, 1.0]])], 0.5) == 0.0


def test_rationality_solves_the_expected_error() -> None:
    beta = teachers.rationality_for([np.array([[0.0, 1.0], [0.0, 3.0], [2.0, 2.0]])], 0.0, 0.2)
    assert beta is not None
    assert (1 / (1 + np.exp(beta)) + 1 / (1 + np.exp(3 * beta))) / 2 == pytest.approx(0.2)
    assert teachers.rationality_for([np.array([[1.0, 1.0]])], 0.0, 0.2) is None
    with pytest.raises(ValueError, match="no query asked has two candidates"):
        teachers.rationality_for([np.array([[1.0]])], 0.0, 0.2)


def test_tie_groups_reach_from_the_best_of_each() -> None:
    block = np.array([[0.0, 1.0, 2.0, 3.0], [5.0, 5.0, 0.0, 4.5]])
    assert teachers.tie_groups(block, 1.0).tolist() == [[1, 1, 0, 0], [0, 0, 1, 0]]
    assert teachers.group_means(block, teachers.tie_groups(block, 1.0))[1].tolist() == [14.5 / 3, 14.5 / 3, 0, 14.5 / 3]


def test_late_steps_count_most_for_a_myopic_teacher() -> None:
    assert teachers.discounted([np.array([1.0, 2.0, 4.0])], 0.5).tolist() == [0.25 + 1.0 + 4.0]


def test_levels_of_a_rating_are_given_equally_often(rng: np.random.Generator) -> None:
    found = asked(rng.exponential(size=(500, 2)))
    said, _ = answers(found, judgement="rating", scale=4)
    levels = np.concatenate([a.levels for a in said if isinstance(a, Rating)])
    assert np.bincount(levels).tolist() == [250] * 4
    gold = np.concatenate([[g.sum() for g in found.gold[q.id]] for q in found.queries])
    assert max(gold[levels == 1]) <= min(gold[levels == 2])
    turned, _ = answers(found, judgement="rating", scale=4, mistake_rate=1.0)
    assert np.concatenate([a.levels for a in turned if isinstance(a, Rating)]).tolist() == (3 - levels).tolist()


def test_noisy_ratings_order_pairs_as_wrongly_as_asked_for(rng: np.random.Generator) -> None:
    """A fine scale shows the order of the noisy values themselves."""
    found = asked(rng.normal(size=(1000, 2)))
    said, _ = answers(found, judgement="rating", scale=400, error_rate=0.2)
    levels = np.array([a.levels for a in said if isinstance(a, Rating)])
    gold = np.array([[g.sum() for g in found.gold[q.id]] for q in found.queries])
    decided = levels[:, 0] != levels[:, 1]
    wrong = (levels[:, 0] > levels[:, 1]) != (gold[:, 0] > gold[:, 1])
    assert np.mean(wrong[decided]) == pytest.approx(0.2, abs=0.04)


def test_the_familys_fault_lets_a_tenth_of_the_threshold_through(rng: np.random.Generator) -> None:
    """With epsilon = 0.1 and a mean of 10, thresholds are 1 in every session, but 0.1 after the first in the fault."""
    golds = rng.normal(10.0, 4.0, (700, 2))
    epsilons = {"skip_epsilon": 0.1, "tie_epsilon": 0.1}
    measured = {}
    for compat in (False, True):
        for first in (True, False):
            found = asked(golds, first=first)
            said, limits = answers(found, bpref_compat=compat, **epsilons)
            assert limits.skip_below == limits.tie_within
            measured[compat, first] = (limits.tie_within, rates(found, said)["tie"])
    mean = golds.mean()
    assert [measured[key][0] / mean for key in measured] == pytest.approx([0.1, 0.1, 0.1, 0.01])
    assert measured[True, True] == measured[False, True] == measured[False, False]
    correct = float(np.mean(np.abs(golds[:, 0] - golds[:, 1]) <= 0.1 * mean))
    assert measured[False, False][1] == pytest.approx(correct)
    assert measured[True, False][1] < correct / 5  # about 14 % of pairs are ties, 1.4 % with the fault


def test_adaptive_thresholds_follow_the_session_alone(rng: np.random.Generator) -> None:
    old, new = rng.normal(1.0, 0.1, (50, 2)), rng.normal(100.0, 0.1, (50, 2))
    limits = Oracle(OracleSettings(skip_epsilon=0.5)).limits(asked(np.concatenate([old, new]), fresh=50, first=False))
    assert limits.skip_below == pytest.approx(0.5 * new.mean())


def test_adaptive_thresholds_on_negative_gold_are_an_error_and_off_in_the_familys_code() -> None:
    found = asked(np.array([[-1.0, -2.0]]))
    with pytest.raises(ValueError, match="use skip_rate and tie_rate"):
        answers(found, skip_epsilon=0.1)
    said, limits = answers(found, skip_epsilon=0.1, tie_epsilon=0.1, bpref_compat=True)
    assert isinstance(said[0], Comparison)
    assert (limits.skip_below, limits.tie_within) == (-np.inf, 0.0)


def test_the_survey_knows_every_query_once_and_which_session_it_is(store: Any, make_query: Any) -> None:
    first, second = make_query(), make_query()
    store.ask([first])
    assert teachers.survey(store, "oracle").first
    store.answer([Comparison(first.id, 1.0, "a"), Comparison(first.id, 0.0, "b")])
    store.ask([second])
    found = teachers.survey(store, "oracle")
    assert [q.id for q in found.queries] == sorted([first.id, second.id])
    assert set(found.fresh) == {second.id}
    assert not found.first
    store.answer([Skip(second.id, labeler="oracle")])
    assert [q.id for q in teachers.survey(store, "oracle").queries] == sorted([first.id, second.id])
