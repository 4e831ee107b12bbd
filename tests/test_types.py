import numpy as np
import pytest

from prefrl.types import (
    Comparison,
    Judged,
    Query,
    Ranking,
    Response,
    Segment,
    Steps,
    batch,
    gold_score,
    implied_pairs,
)


def response(text: str, prompt: str = "p", gold: float | None = None) -> Response:
    return Response(prompt, text, gold=None if gold is None else np.array([gold]))


def test_the_id_of_a_candidate_is_its_content_and_not_its_gold() -> None:
    assert response("a", gold=1.0).id == response("a", gold=2.0).id == response("a").id
    assert response("a").id != response("b").id != response("b", prompt="q").id
    x = np.ones((2, 3), np.float32)
    segment = Segment(x, x, "e", 0)
    assert segment.id == Segment(x.copy(order="F"), x, "e", 0, gold=np.ones(2)).id
    assert segment.id != Segment(x.astype(np.float64), x, "e", 0).id


def test_text_that_is_no_valid_unicode_still_has_an_id() -> None:
    assert len(response("\ud800").id) == 64


def test_a_query_does_not_depend_on_the_order_in_which_it_was_made() -> None:
    a, b = response("a"), response("b")
    assert Query((a, b)).candidates == Query((b, a)).candidates
    assert Query((a, b)).id == Query((b, a)).id


@pytest.mark.parametrize(
    ("candidates", "message"),
    [
        ((response("a"),), "at least 2"),
        ((response("a"), response("a")), "with itself"),
        ((response("a"), response("b", prompt="q")), "one context"),
    ],
)
def test_queries_that_make_no_sense_are_refused(candidates: tuple[Response, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Query(candidates)


@pytest.mark.parametrize("preference", [-0.1, 1.1, float("nan")])
def test_a_preference_outside_its_range_is_refused(preference: float) -> None:
    with pytest.raises(ValueError, match=r"\[0, 1\]"):
        Comparison("q", preference)


def test_a_segment_with_unequal_lengths_is_refused() -> None:
    with pytest.raises(ValueError, match="equal length"):
        Segment(np.zeros((3, 1)), np.zeros((2, 1)), "e", 0)


def test_a_ranking_implies_all_pairs_ties_included() -> None:
    assert implied_pairs(Ranking("q", (0, 1, 1))) == [(0, 1, 1.0), (0, 2, 1.0), (1, 2, 0.5)]
    assert implied_pairs(Comparison("q", 0.7)) == [(0, 1, 0.7)]


def test_a_batch_holds_each_candidate_once_and_a_ranking_counts_as_its_candidates_less_one() -> None:
    a, b, c, d = (response(t) for t in "abcd")
    three, two = Query((a, b, c)), Query((a, d))
    made = batch([Judged(three, Ranking(three.id, (0, 1, 2))), Judged(two, Comparison(two.id, 1.0))])
    assert {x.id for x in made.candidates} == {x.id for x in (a, b, c, d)}
    assert len(made) == 4
    assert made.group.tolist() == [0, 0, 0, 1]
    np.testing.assert_allclose(made.weight, [2 / 3, 2 / 3, 2 / 3, 1])
    assert made.subset(np.array([True, False, False, True])).group.tolist() == [0, 1]


def test_a_batch_of_nothing_is_empty_and_well_shaped() -> None:
    made = batch(list[Judged[Response]]())
    assert made.edges.shape == (0, 2)
    assert len(made) == 0


def test_gold_is_only_there_where_it_was_attached() -> None:
    assert gold_score(response("a", gold=0.5)) == 0.5
    with pytest.raises(ValueError, match="carries no gold"):
        gold_score(response("a"))


def test_steps_add_up_by_purpose() -> None:
    assert Steps(1, 2, 3).add(learn=10).add(query=20, evaluate=30) == (11, 22, 33)
