from collections.abc import Callable

import numpy as np
import pytest

from prefrl.label.oracle import Oracle, OracleSettings
from prefrl.store import Store
from prefrl.types import Comparison, Query, Ranking, Segment

Ask = Callable[..., Query[Segment]]


def golds(query: Query[Segment]) -> list[np.ndarray]:
    return [c.gold for c in query.candidates if c.gold is not None]


def test_the_oracle_prefers_more_gold(make_query: Ask, rng: np.random.Generator) -> None:
    query = make_query(1.0, 5.0)
    judged = Oracle(OracleSettings()).judge(query, golds(query), rng)
    assert isinstance(judged, Comparison)
    assert judged.preference == float(query.candidates[0].gold.sum() == 5.0)  # type: ignore[union-attr]
    assert sorted(judged.shown) == [0, 1]


def test_the_oracle_ranks_more_than_two_with_ties(make_query: Ask, rng: np.random.Generator) -> None:
    query = make_query(0.0, 3.0, 3.05, 9.0)
    judged = Oracle(OracleSettings(tie_within=0.1)).judge(query, golds(query), rng)
    assert isinstance(judged, Ranking)
    by_gold = {round(float(g.sum()), 2): rank for g, rank in zip(golds(query), judged.ranks, strict=True)}
    assert by_gold == {9.0: 0, 3.05: 1, 3.0: 1, 0.0: 2}


def test_equal_gold_is_a_tie(make_query: Ask, rng: np.random.Generator) -> None:
    query = make_query(2.0, 2.0)
    judged = Oracle(OracleSettings()).judge(query, golds(query), rng)
    assert isinstance(judged, Comparison)
    assert judged.preference == 0.5


def test_mistakes_come_at_the_rate_asked_for(store: Store[Segment], make_query: Ask) -> None:
    queries = [make_query(0.0, 1.0) for _ in range(300)]
    store.ask(queries)
    Oracle(OracleSettings(mistake_rate=0.2)).answer(store, np.random.default_rng(1))
    truth = {q.id: float(q.candidates[0].gold.sum()) for q in queries}  # type: ignore[union-attr]
    wrong = [j.judgement.preference != truth[j.query.id] for j in store.judged() if isinstance(j.judgement, Comparison)]
    assert np.mean(wrong) == pytest.approx(0.2, abs=0.06)


def test_left_and_right_are_shown_at_random(store: Store[Segment], make_query: Ask) -> None:
    store.ask([make_query() for _ in range(200)])
    Oracle(OracleSettings()).answer(store, np.random.default_rng(0))
    assert np.mean([a.shown == (0, 1) for a in store.answers()]) == pytest.approx(0.5, abs=0.1)


def test_answers_do_not_depend_on_what_was_answered_before(store: Store[Segment], make_query: Ask) -> None:
    """A run that was killed half way through its answers gets the same ones when it goes on."""
    queries = [make_query(0.0, 1.0) for _ in range(20)]
    oracle = Oracle(OracleSettings(mistake_rate=0.5))
    whole = oracle_answer(oracle, queries, store, 20)
    again = Store[Segment](store.folder.parent / "again")
    with again:
        oracle_answer(oracle, queries[:7], again, 7)
        assert oracle_answer(oracle, queries, again, 20) == whole


def oracle_answer(
    oracle: Oracle, queries: list[Query[Segment]], store: Store[Segment], count: int
) -> dict[str, tuple[int, ...]]:
    store.ask(queries)
    oracle.answer(store, np.random.default_rng(5))
    answers = store.answers()
    assert len(answers) == count
    return {a.query: (*a.shown, int(isinstance(a, Comparison) and a.preference)) for a in answers}


def test_gold_that_is_missing_or_nan_is_an_error(store: Store[Segment], make_query: Ask) -> None:
    store.ask([make_query(0.0, float("nan"))])
    with pytest.raises(ValueError, match="finite gold"):
        Oracle(OracleSettings()).answer(store, np.random.default_rng(0))
