import numpy as np

from prefrl.graph import batch, implied_pairs
from prefrl.types import Choice, Comparison, Judged, Query, Ranking, Rating, Response


def response(text: str) -> Response:
    return Response("p", text)


def test_a_ranking_implies_all_pairs_ties_included() -> None:
    assert implied_pairs(Ranking("q", (0, 1, 1)), 3) == [(0, 1, 1.0), (0, 2, 1.0), (1, 2, 0.5)]
    assert implied_pairs(Comparison("q", 0.7), 2) == [(0, 1, 0.7)]


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


def test_the_best_of_a_few_beats_each_other_and_a_rating_compares_levels() -> None:
    assert implied_pairs(Choice("q", 1), 3) == [(1, 0, 1.0), (1, 2, 1.0)]
    assert implied_pairs(Rating("q", (2, 0, 2), 3), 3) == [(0, 1, 1.0), (0, 2, 0.5), (1, 2, 0.0)]
    assert implied_pairs(Rating("q", (2,), 3), 1) == []


def test_a_judgements_weight_is_shared_by_its_pairs() -> None:
    three = Query(tuple(response(t) for t in "abc"))
    made = batch([Judged(three, Ranking(three.id, (0, 1, 2), weight=3.0))])
    np.testing.assert_allclose(made.weight, 2.0)
