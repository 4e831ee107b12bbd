from itertools import combinations, pairwise

import numpy as np
import pytest

from prefrl.sample.queries import asked, disjoint, groups, newest, overlap, proposals, query_features, topped_up
from prefrl.types import Response, Segment


def dense(episodes: int, count: int, steps: int = 10) -> list[Segment]:
    """Segments that start at every step of a few short episodes."""
    filled = np.zeros((steps, 1), np.float32)
    return [Segment(filled, filled, f"round 0/{e}/0", start) for e in range(episodes) for start in range(count)]


def responses(prompt: str, count: int) -> list[Response]:
    return [Response(prompt, f"{prompt} {'x' * i}") for i in range(count)]


def test_queries_are_disjoint_of_one_context_and_of_the_size_asked_for(rng: np.random.Generator) -> None:
    pool = responses("a", 7) + responses("b", 4) + responses("c", 1)
    made = groups(pool, 3, rng)
    assert made.shape == (2 + 1, 3)
    assert len(np.unique(made)) == made.size
    assert all(len({pool[i].prompt for i in row}) == 1 for row in made)


@pytest.mark.parametrize(("episodes", "size"), [(1, 2), (3, 2), (3, 4), (5, 8)])
def test_segments_that_overlap_are_never_compared(episodes: int, size: int, rng: np.random.Generator) -> None:
    pool = dense(episodes, 60)
    made = groups(pool, size, rng)
    assert len(made) > 0.8 * episodes * 60 / size
    assert len(np.unique(made)) == made.size
    for row in [*made, *proposals(pool, size, 3, rng)]:
        assert not any(overlap(pool[i], pool[j]) for i, j in combinations(row, 2))


def test_segments_overlap_when_they_share_a_step_of_one_episode() -> None:
    first, *rest = dense(1, 12)
    assert [overlap(first, other) for other in rest] == [True] * 9 + [False] * 2
    assert [overlap(other, first) for other in rest] == [True] * 9 + [False] * 2
    assert not overlap(*dense(2, 1))
    assert not any(overlap(a, b) for a, b in pairwise(responses("a", 3)))


def test_a_pool_that_only_overlaps_gives_no_queries(rng: np.random.Generator) -> None:
    assert groups(dense(1, 10), 2, rng).shape == (0, 2)
    assert proposals(dense(1, 10), 2, 3, rng).shape == (0, 2)


def test_what_cannot_overlap_is_grouped_in_the_order_drawn() -> None:
    made = groups(responses("a", 11), 3, np.random.default_rng(5))
    rng = np.random.default_rng(5)
    order, places = rng.permutation(11), rng.permutation(3)
    expected = np.array([order[start : start + 3] for start in (0, 3, 6)])[places]
    np.testing.assert_array_equal(made, expected)


def test_proposals_are_distinct_and_try_each_candidate_about_as_often_as_asked(rng: np.random.Generator) -> None:
    made = proposals(responses("a", 40), 2, 6, rng)
    assert len(np.unique(made, axis=0)) == len(made)
    counts = np.bincount(made.ravel(), minlength=40)
    assert counts.max() <= 6
    assert counts.mean() > 5


def test_disjoint_takes_the_first_in_order_that_share_nothing() -> None:
    queries = np.array([[0, 1], [1, 2], [2, 3], [4, 5]])
    assert disjoint(queries, np.array([1, 0, 2, 3]), 4).tolist() == [1, 3]
    assert disjoint(queries, np.array([0, 1, 2, 3]), 4).tolist() == [0, 2, 3]
    assert disjoint(queries, np.array([0, 1, 2, 3]), 2).tolist() == [0, 2]


def test_too_few_queries_are_topped_up_from_what_is_left(rng: np.random.Generator) -> None:
    pool = responses("a", 6)
    full = topped_up(pool, np.array([[1, 4]]), 3, rng)
    assert full[0].tolist() == [1, 4]
    assert sorted(full.ravel().tolist()) == [0, 1, 2, 3, 4, 5]
    assert len(topped_up(pool, np.array([[1, 4]]), 2, rng)) == 2
    assert len(topped_up(pool[:3], np.array([[0, 1]]), 2, rng)) == 1


def test_the_newest_are_the_last_distinct_candidates() -> None:
    pool = responses("a", 5)
    assert newest([*pool, pool[0]], 0.5) == pool[2:]
    assert newest(pool, 1.0) == pool
    assert newest([], 0.5) == []


def test_a_querys_features_are_normalised_and_know_no_order() -> None:
    features = np.array([[0.0, 5.0], [2.0, 5.0], [4.0, 5.0]], np.float32)
    made = query_features(features, np.array([[0, 2], [2, 0], [0, 1]]))
    unit = np.sqrt(3 / 8)  # one over the std of 0, 2, 4; the constant feature says nothing
    np.testing.assert_allclose(made, [[0, 0, 2 * unit, 0], [0, 0, 2 * unit, 0], [-unit, 0, unit, 0]], atol=1e-12)


def test_rows_become_queries() -> None:
    pool = responses("a", 3)
    (query,) = asked(pool, np.array([[2, 0]]))
    assert set(query.candidates) == {pool[0], pool[2]}


def test_of_single_segments_none_is_asked_about_twice(rng: np.random.Generator) -> None:
    """Whoever shows what to do in a state has shown it."""
    seen, done = np.zeros((10, 1), np.float32), np.zeros((10, 1), np.float32)
    pool = [Segment(seen, done, f"e{e}", start) for e in range(2) for start in range(0, 41, 2)]
    chosen = [pool[i] for (i,) in groups(pool, 1, rng)]
    assert len(chosen) >= 4
    assert not any(overlap(a, b) for a, b in combinations(chosen, 2))
