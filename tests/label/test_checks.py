"""Check questions from large gaps of gold."""

from collections.abc import Callable
from itertools import combinations

import numpy as np
import pytest

from prefrl.label.checks import Checks, clear_queries, pick_checks
from prefrl.store import Store
from prefrl.types import Query, Response, Segment

Generator = np.random.Generator
Make = Callable[..., Segment]


def filled(store: Store[Segment], make_segment: Make, golds: np.ndarray, size: int = 2) -> list[Query[Segment]]:
    segments = [make_segment(gold=float(g)) for g in golds]
    queries = [Query(tuple(segments[i : i + size])) for i in range(0, len(segments), size)]
    store.ask(queries)
    return queries


def gap(store: Store[Segment], query: Query[Segment]) -> float:
    worth = sorted(float(g.sum()) for g in store.gold(query.candidates))
    return worth[-1] - worth[-2]


@pytest.mark.parametrize("size", [2, 4])
def test_the_best_candidate_of_a_check_is_far_ahead(
    store: Store[Segment], make_segment: Make, rng: Generator, size: int
) -> None:
    golds = rng.normal(size=32)
    asked = filled(store, make_segment, golds, size)
    found = pick_checks(store, asked, 3, rng)
    random = [np.sort(rng.choice(golds, size, replace=False)) for _ in range(4000)]
    least = np.quantile([row[-1] - row[-2] for row in random], 0.88)
    assert len(found.queries) == len(found.expected) == 3
    assert found.reason == ""
    for query, best in zip(found.queries, found.expected, strict=True):
        assert len(query.candidates) == size
        assert gap(store, query) > least
        assert np.argmax([g.sum() for g in store.gold(query.candidates)]) == best


def test_checks_are_new_queries_over_different_candidates(
    store: Store[Segment], make_segment: Make, rng: Generator
) -> None:
    asked = filled(store, make_segment, rng.normal(size=32))
    found = pick_checks(store, asked, 3, rng)
    assert not {q.id for q in found.queries} & {q.id for q in asked}
    candidates = [c.id for q in found.queries for c in q.candidates]
    assert len(set(candidates)) == len(candidates)
    store.ask(found.queries, purpose="check", expected=found.expected)
    assert {q.id for q in store.open_queries()} == {q.id for q in asked}


def test_equal_seeds_pick_equal_checks(store: Store[Segment], make_segment: Make, rng: Generator) -> None:
    asked = filled(store, make_segment, rng.normal(size=32))
    first, again, other = (pick_checks(store, asked, 3, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert [q.id for q in first.queries] == [q.id for q in again.queries]
    assert first.expected == again.expected
    assert [q.id for q in first.queries] != [q.id for q in other.queries]


def test_segments_of_one_episode_never_meet(rng: Generator) -> None:
    arrays = np.zeros((5, 3), np.float32)
    segments = [Segment(arrays, arrays, episode=str(i % 4), start=i) for i in range(40)]
    found = clear_queries(segments, rng.normal(size=40), (2, 10), (), rng)
    assert len(found.queries) == 10
    for query in found.queries:
        assert len({c.episode for c in query.candidates}) == 2
    alone = [Segment(arrays, arrays, episode="one", start=i) for i in range(40)]
    assert "there are 0 groups" in clear_queries(alone, rng.normal(size=40), (2, 10), (), rng).reason


def test_responses_meet_within_their_prompt_only(rng: Generator) -> None:
    responses = [Response(f"p{i % 6}", f"text {i}") for i in range(60)]
    found = clear_queries(responses, rng.normal(size=60), (3, 8), (), rng)
    assert len(found.queries) == 8
    assert len({q.candidates[0].context for q in found.queries}) > 1


@pytest.mark.parametrize(
    ("golds", "reason"),
    [
        ([np.nan] * 20, "gold is known of 0 candidates, and a check needs 2"),
        ([1.0] * 20, "gold differs too little for an answer to be clear"),
        ([1e6, 1e6 + 1e-6] * 10, "gold differs too little for an answer to be clear"),
        ([1.0, 2.0, 3.0, 4.0], "there are 6 groups of 2 comparable candidates, and 10 are needed"),
    ],
)
def test_without_clear_differences_there_are_none_and_the_reason_is_said(
    store: Store[Segment], make_segment: Make, rng: Generator, golds: list[float], reason: str
) -> None:
    asked = filled(store, make_segment, np.array(golds))
    assert pick_checks(store, asked, 3, rng) == Checks([], [], reason)


def test_candidates_without_gold_are_left_out(store: Store[Segment], make_segment: Make, rng: Generator) -> None:
    nothing = [Query((make_segment(), make_segment())) for _ in range(5)]
    store.ask(nothing)
    assert "gold is known of 0" in pick_checks(store, nothing, 3, rng).reason
    asked = filled(store, make_segment, np.r_[rng.normal(size=30), np.nan, np.inf])
    unknown = {c.id for q in [*nothing, asked[-1]] for c in q.candidates}
    found = pick_checks(store, nothing + asked, 3, rng)
    assert len(found.queries) == 3
    assert unknown.isdisjoint(c.id for q in found.queries for c in q.candidates)


def test_what_was_asked_is_not_asked_again(rng: Generator) -> None:
    responses = [Response("p", str(i)) for i in range(8)]
    asked = {Query(pair).id for pair in combinations(responses, 2)}
    found = clear_queries(responses, rng.normal(size=8), (2, 3), asked, rng)
    assert (found.queries, found.reason) == ([], "0 of 3: no other clear ones are left that were not asked")


def test_nothing_asked_and_single_candidates_make_no_checks(store: Store[Segment], rng: Generator) -> None:
    assert pick_checks(store, [], 3, rng).reason == "nothing was asked yet"
    assert "no best one" in clear_queries([Response("p", "a")], np.ones(1), (1, 3), (), rng).reason
