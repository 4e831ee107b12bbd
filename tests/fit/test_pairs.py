import numpy as np

from prefrl.fit.pairs import batch, compared
from prefrl.judgements import Comparison, Judged, Ranking, Rating
from prefrl.types import Query, Response


def response(text: str) -> Response:
    return Response("p", text)


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


def test_a_judgements_weight_is_shared_by_its_pairs() -> None:
    three = Query(tuple(response(t) for t in "abc"))
    made = batch([Judged(three, Ranking(three.id, (0, 1, 2), weight=3.0))])
    np.testing.assert_allclose(made.weight, 2.0)


def test_ratings_of_single_candidates_are_compared_where_there_is_nothing_else() -> None:
    def rated(text: str, level: int, labeler: str = "ann", weight: float = 1.0) -> Judged[Response]:
        query = Query((Response(f"prompt of {text}", text),))
        return Judged(query, Rating(query.id, (level,), 5, labeler, weight=weight))

    judged = [rated(str(i), i % 5) for i in range(40)]
    made = compared(judged)
    assert len(made) == 20, "each stands in one comparison"
    assert sorted(made.edges.flatten().tolist()) == list(range(40))
    levels = {c.id: j.judgement.levels[0] for c, j in zip(made.candidates, judged, strict=True)}  # type: ignore[union-attr]
    for (first, second), preference in zip(made.edges, made.preference, strict=True):
        one, other = (levels[made.candidates[i].id] for i in (first, second))
        assert one != other
        assert preference == float(one > other)
    assert not len(compared([rated("a", 1), rated("b", 1)])), "equal levels say nothing"
    assert not len(compared([rated("a", 1), rated("b", 2, "ben")])), "one may be strict, and the other mild"
    assert not len(compared([rated("a", 1), rated("b", 2)], [True, False])), "one is held out"
    assert compared([rated("a", 1, weight=1.0), rated("b", 2, weight=3.0)]).weight.tolist() == [2.0]
    two = Query((response("a"), response("b")))
    pair = Judged(two, Comparison(two.id, 1.0))
    assert compared([*judged, pair]).edges.tolist() == batch([*judged, pair]).edges.tolist()
