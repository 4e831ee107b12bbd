"""Judgements: what makes no sense is refused, and a judgement fits its query."""

from collections.abc import Callable

import numpy as np
import pytest

from prefrl.judgements import (
    Answer,
    Choice,
    Comparison,
    Demonstrated,
    Demonstration,
    Judged,
    Ranking,
    Rating,
    Skip,
    best_of,
    check_fits,
    columns,
    implied_pairs,
    moved,
)
from prefrl.types import Query, Response


def response(text: str, prompt: str = "p", gold: float | None = None) -> Response:
    return Response(prompt, text, gold=None if gold is None else np.array([gold]))


@pytest.mark.parametrize("preference", [-0.1, 1.1, float("nan")])
def test_a_preference_outside_its_range_is_refused(preference: float) -> None:
    with pytest.raises(ValueError, match=r"\[0, 1\]"):
        Comparison("q", preference)


def test_a_judgement_of_another_query_is_refused() -> None:
    one, other = (Query((response("a"), response(text))) for text in ("b", "c"))
    with pytest.raises(ValueError, match=f"query {one.id[:12]} got a judgement of query {other.id[:12]}"):
        Judged(one, Comparison(other.id, 1.0))


@pytest.mark.parametrize(
    ("answer", "sizes"),
    [
        (Comparison("q", 1.0), {2}),
        (Ranking("q", (0, 1, 1)), {3}),
        (Choice("q", 1), {2, 3, 4}),
        (Rating("q", (4,), 5), {1}),
        (Skip("q"), {1, 2, 3, 4}),
    ],
)
def test_an_answer_fits_queries_of_its_own_size_only(answer: Answer, sizes: set[int]) -> None:
    for size in (1, 2, 3, 4):
        if size in sizes:
            check_fits(answer, size)
        else:
            with pytest.raises(ValueError, match=f"has {size} candidates"):
                check_fits(answer, size)


@pytest.mark.parametrize(
    "make",
    [
        lambda: Ranking("q", (0,)),
        lambda: Choice("q", -1),
        lambda: Rating("q", (5,), 5),
        lambda: Rating("q", (), 5),
        lambda: Comparison("q", 1.0, weight=0.0),
        lambda: Ranking("q", (0, 1), weight=float("nan")),
        lambda: Ranking("q", (0, float("nan"))),  # type: ignore[arg-type]
        lambda: Ranking("q", (0, 1.5)),  # type: ignore[arg-type]
        lambda: Rating("q", (1.9, 3.2), 5),  # type: ignore[arg-type]
        lambda: Choice("q", 0.5),  # type: ignore[arg-type]
    ],
)
def test_judgements_that_say_nothing_are_refused(make: Callable[[], Answer]) -> None:
    with pytest.raises(ValueError, match="got"):
        make()


def test_a_ranking_implies_all_pairs_ties_included() -> None:
    assert implied_pairs(Ranking("q", (0, 1, 1)), 3) == [(0, 1, 1.0), (0, 2, 1.0), (1, 2, 0.5)]
    assert implied_pairs(Comparison("q", 0.7), 2) == [(0, 1, 0.7)]


def test_the_best_of_a_few_beats_each_other_and_a_rating_compares_levels() -> None:
    assert implied_pairs(Choice("q", 1), 3) == [(1, 0, 1.0), (1, 2, 1.0)]
    assert implied_pairs(Rating("q", (2, 0, 2), 3), 3) == [(0, 1, 1.0), (0, 2, 0.5), (1, 2, 0.0)]
    assert implied_pairs(Rating("q", (2,), 3), 1) == []


def test_a_demonstration_answers_a_query_of_one_candidate_with_one_of_its_context() -> None:
    own, better, other = Response("p", "so so"), Response("p", "good"), Response("q", "good")
    query = Query((own,))
    shown = Demonstration(query.id, better.id)
    assert Demonstrated(query, better, shown).like.text == "good"
    with pytest.raises(ValueError, match="another context"):
        Demonstrated(query, other, Demonstration(query.id, other.id))
    with pytest.raises(ValueError, match="got a demonstration of query"):
        Demonstrated(query, own, shown)
    with pytest.raises(ValueError, match="has 2 candidates"):
        check_fits(shown, 2)
    with pytest.raises(ValueError, match="weight"):
        Demonstration(query.id, better.id, weight=0.0)


def test_a_demonstration_judges_nothing() -> None:
    shown = Demonstration("q", "c", "ann")
    assert shown.reason == "demonstration"
    assert best_of(shown) is None
    assert moved(shown, (0,)) == shown
    assert columns(shown) == {"like": "c"}
