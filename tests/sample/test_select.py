from collections.abc import Callable
from itertools import combinations, pairwise
from typing import Any

import numpy as np
import pytest

from prefrl.sample.select import DisagreementSettings, UniformSettings, disagreement, groups, overlap
from prefrl.types import Response, Segment


class Fake:
    """A reward model whose members agree on candidates called "sure"."""

    members, fitted = 2, True

    def raw_member_scores(self, candidates: list[Response]) -> np.ndarray:
        first = np.array([len(c.text) for c in candidates], float)
        second = np.array([len(c.text) * (1 if c.prompt == "sure" else -1) for c in candidates], float)
        return np.stack([first, second])


class Settled(Fake):
    """Its settled scores are on a scale on which the members seem to disagree about "sure" the most."""

    def member_scores(self, candidates: list[Response]) -> np.ndarray:
        signs = np.array([1.0 if c.prompt == "sure" else 0.0 for c in candidates])
        scores: np.ndarray = np.stack([signs, -signs]) * 1000.0 * np.array([len(c.text) for c in candidates])
        return scores


def dense(episodes: int, count: int, steps: int = 10) -> list[Segment]:
    """Segments that start at every step of a few short episodes."""
    filled = np.zeros((steps, 1), np.float32)
    return [Segment(filled, filled, f"round 0/{e}/0", start) for e in range(episodes) for start in range(count)]


def responses(prompt: str, count: int) -> list[Response]:
    return [Response(prompt, f"{prompt} {'x' * i}") for i in range(count)]


def test_queries_are_disjoint_of_one_context_and_of_the_size_asked_for(rng: np.random.Generator) -> None:
    made = groups(responses("a", 7) + responses("b", 4) + responses("c", 1), 3, rng)
    assert len(made) == 2 + 1
    assert all(len({c.prompt for c in q.candidates}) == 1 and len(q.candidates) == 3 for q in made)
    ids = [c.id for q in made for c in q.candidates]
    assert len(set(ids)) == len(ids)


def test_a_candidate_that_was_sampled_twice_is_not_compared_with_itself(rng: np.random.Generator) -> None:
    assert groups(responses("a", 2) * 5, 2, rng)[1:] == []


def test_a_uniform_draw_gives_every_pair_the_same_chance(make_segment: Callable[..., Segment]) -> None:
    pool = [make_segment() for _ in range(4)]
    seen: dict[str, int] = {}
    for seed in range(600):
        selector: Any = UniformSettings().build()
        (query,) = selector.select(pool, Fake(), 1, np.random.default_rng(seed))
        seen[query.id] = seen.get(query.id, 0) + 1
    assert len(seen) == 6
    assert all(count == pytest.approx(100, abs=40) for count in seen.values())


def test_disagreement_asks_where_members_differ(rng: np.random.Generator) -> None:
    pool = responses("sure", 8) + responses("unsure", 8)
    selector: Any = DisagreementSettings().build()
    chosen = selector.select(pool, Fake(), 3, rng)
    assert all(q.candidates[0].prompt == "unsure" for q in chosen)


def test_disagreement_is_of_the_scores_that_were_fitted_not_of_settled_ones(rng: np.random.Generator) -> None:
    selector: Any = DisagreementSettings().build()
    chosen = selector.select(responses("sure", 8) + responses("unsure", 8), Settled(), 3, rng)
    assert all(q.candidates[0].prompt == "unsure" for q in chosen)


@pytest.mark.parametrize(("episodes", "size"), [(1, 2), (3, 2), (3, 4), (5, 8)])
def test_segments_that_overlap_are_never_compared(episodes: int, size: int, rng: np.random.Generator) -> None:
    made = groups(dense(episodes, 60), size, rng)
    assert len(made) > 0.8 * episodes * 60 / size
    assert not any(overlap(a, b) for q in made for a, b in combinations(q.candidates, 2))
    ids = [c.id for q in made for c in q.candidates]
    assert len(set(ids)) == len(ids)


def test_segments_overlap_when_they_share_a_step_of_one_episode() -> None:
    first, *rest = dense(1, 12)
    assert [overlap(first, other) for other in rest] == [True] * 9 + [False] * 2
    assert [overlap(other, first) for other in rest] == [True] * 9 + [False] * 2
    assert not overlap(*dense(2, 1))
    assert not any(overlap(a, b) for a, b in pairwise(responses("a", 3)))


def test_a_pool_that_only_overlaps_gives_no_queries(rng: np.random.Generator) -> None:
    assert groups(dense(1, 10), 2, rng) == []


def test_what_cannot_overlap_is_grouped_in_the_order_drawn() -> None:
    pool = responses("a", 11)
    made = groups(pool, 3, np.random.default_rng(5))
    rng = np.random.default_rng(5)
    order, places = rng.permutation(11), rng.permutation(3)
    expected = [{pool[i].id for i in order[start : start + 3]} for start in (0, 3, 6)]
    assert [{c.id for c in q.candidates} for q in made] == [expected[i] for i in places]


def test_before_the_first_fit_disagreement_draws_uniformly(rng: np.random.Generator) -> None:
    model, pool = Fake(), responses("sure", 8) + responses("unsure", 8)
    model.fitted = False
    by_disagreement: Any = DisagreementSettings().build()
    uniform: Any = UniformSettings().build()
    assert by_disagreement.select(pool, model, 3, rng) == uniform.select(pool, model, 3, np.random.default_rng(0))


def test_disagreement_is_the_spread_of_the_preference_by_hand() -> None:
    scores = np.array([[[0.0, 0.0]], [[100.0, -100.0]]])  # one member is undecided, the other is sure
    np.testing.assert_allclose(disagreement(scores), [0.25])
