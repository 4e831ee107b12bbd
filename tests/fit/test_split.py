from collections.abc import Callable

import numpy as np
import pytest

from prefrl.fit.split import prefers, split
from prefrl.judgements import Comparison, Judged, Judgement, Ranking, Rating
from prefrl.types import Query, Segment


def compare(query: Query[Segment]) -> Judged[Segment]:
    return Judged(query, Comparison(query.id, 1.0))


@pytest.fixture
def judged(make_query: Callable[..., Query[Segment]]) -> list[Judged[Segment]]:
    return [compare(make_query()) for _ in range(300)]


def test_held_out_judgements_share_no_candidate_with_the_rest(make_segment: Callable[..., Segment]) -> None:
    pool = [make_segment() for _ in range(60)]
    rng = np.random.default_rng(0)
    queries = {q.id: q for q in (Query((pool[i], pool[j])) for i, j in (rng.choice(60, 2, False) for _ in range(40)))}
    some = [compare(q) for q in queries.values()]
    held_out = split(some, 0.3)
    assert 0 < held_out.sum() < len(some)
    sides: list[set[str]] = [set(), set()]
    for one, out in zip(some, held_out, strict=True):
        sides[int(out)] |= {c.id for c in one.query.candidates}
    assert not sides[0] & sides[1]


def test_what_was_held_out_once_is_never_trained_on_later(judged: list[Judged[Segment]]) -> None:
    def ids(count: int) -> set[str]:
        out = split(judged[:count], 0.2)
        return {one.query.id for one, held in zip(judged[:count], out, strict=True) if held}

    assert ids(100) <= ids(200) <= ids(300)
    assert len(ids(300)) == pytest.approx(60, abs=25)


def test_a_split_that_would_leave_nothing_to_train_on_holds_out_nothing(judged: list[Judged[Segment]]) -> None:
    one = [next(j for j in judged if int(j.query.id[:8], 16) < 0.5 * 2**32)]
    assert not split(one, 0.5).any()


def test_a_component_of_more_than_half_of_all_is_trained_on(
    judged: list[Judged[Segment]], make_segment: Callable[..., Segment]
) -> None:
    hub = [make_segment() for _ in range(40)]
    star = [compare(Query((hub[0], other))) for other in hub[1:]]
    assert split(star + judged[:10], 0.999).tolist() == [False] * 39 + [True] * 10


def test_all_judgements_of_one_query_are_on_one_side(make_query: Callable[..., Query[Segment]]) -> None:
    queries = [make_query(0.0) for _ in range(40)] * 2
    some = [Judged(q, Rating(q.id, (i % 3,), 3, str(i))) for i, q in enumerate(queries)]
    held_out = split(some, 0.3)
    assert held_out.any()
    np.testing.assert_array_equal(held_out[:40], held_out[40:])


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda id: Comparison(id, 0.5), False),
        (lambda id: Comparison(id, 0.6), True),
        (lambda id: Ranking(id, (0, 0)), False),
        (lambda id: Ranking(id, (0, 1)), True),
        (lambda id: Rating(id, (1, 1), 3), False),
        (lambda id: Rating(id, (1, 2), 3), True),
    ],
)
def test_ties_prefer_nothing(
    make_query: Callable[..., Query[Segment]], make: Callable[[str], Judgement], expected: bool
) -> None:
    query = make_query()
    assert prefers([Judged(query, make(query.id))]) is expected
