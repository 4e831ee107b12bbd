from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from prefrl.sample.select import DisagreementSettings, UniformSettings, disagreement, groups
from prefrl.types import Response, Segment


class Fake:
    """A reward model whose members agree on candidates called "sure"."""

    members, fitted = 2, True

    def member_scores(self, candidates: list[Response]) -> np.ndarray:
        first = np.array([len(c.text) for c in candidates], float)
        second = np.array([len(c.text) * (1 if c.prompt == "sure" else -1) for c in candidates], float)
        return np.stack([first, second])


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


def test_before_the_first_fit_disagreement_draws_uniformly(rng: np.random.Generator) -> None:
    model, pool = Fake(), responses("sure", 8) + responses("unsure", 8)
    model.fitted = False
    by_disagreement: Any = DisagreementSettings().build()
    uniform: Any = UniformSettings().build()
    assert by_disagreement.select(pool, model, 3, rng) == uniform.select(pool, model, 3, np.random.default_rng(0))


def test_disagreement_is_the_spread_of_the_preference_by_hand() -> None:
    scores = np.array([[[0.0, 0.0]], [[100.0, -100.0]]])  # one member is undecided, the other is sure
    np.testing.assert_allclose(disagreement(scores), [0.25])
