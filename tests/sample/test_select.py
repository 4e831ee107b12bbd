from collections.abc import Callable
from itertools import combinations
from typing import Any

import numpy as np
import pytest

from prefrl.components import TABLE, settings_class
from prefrl.sample.acquisition import information
from prefrl.sample.queries import overlap
from prefrl.sample.select import ScoredSettings, UnscoredSettings
from prefrl.types import Floats, Response, Segment

KINDS = ["uniform", "coverage", "disagreement", "entropy", "information"]
DIVERSE = ["none", "k_medoids", "dpp", "batch"]
SCORED = ["disagreement", "entropy", "information"]
ALL = [{"kind": k} for k in KINDS] + [{"kind": k, "diversify": d} for k in SCORED for d in DIVERSE[1:]]


class Fake:
    """A reward model whose members agree on candidates called "sure", and who put "unsure" in opposite orders."""

    members, fitted, calls = 2, True, 0

    def raw_member_scores(self, candidates: list[Response]) -> Floats:
        self.calls += 1
        first = np.array([len(c.text) for c in candidates], float)
        second = np.array([len(c.text) * (1 if c.prompt == "sure" else -1) for c in candidates], float)
        return np.stack([first, second])[: self.members]

    def score(self, candidates: list[Response]) -> Floats:
        return np.array([len(c.text) for c in candidates], float)

    def member_scores(self, candidates: list[Response]) -> Floats:
        """Settled scores are on a scale on which the members seem to disagree about "sure" the most."""
        signs = np.array([1.0 if c.prompt == "sure" else 0.0 for c in candidates])
        scores: Floats = np.stack([signs, -signs]) * 1000.0 * np.array([len(c.text) for c in candidates])
        return scores

    def features(self, candidates: list[Response]) -> Floats:
        return np.array([[len(c.text), c.prompt == "sure"] for c in candidates], np.float32)


class Looking:
    """A reward model of segments: three members, each looking at one coordinate of the first observation."""

    members, fitted = 3, True

    def raw_member_scores(self, candidates: list[Segment]) -> Floats:
        return 3 * self.features(candidates).T

    def features(self, candidates: list[Segment]) -> Floats:
        return np.stack([c.observations[0, :3] for c in candidates])


def build(**settings: Any) -> Any:
    return settings_class("selectors", settings["kind"]).model_validate(settings).build()  # type: ignore[attr-defined]


def responses(prompt: str, count: int) -> list[Response]:
    return [Response(prompt, f"{prompt} {'x' * i}") for i in range(count)]


MIXED = responses("sure", 12) + responses("unsure", 12)


def test_every_kind_of_the_table_is_known_here() -> None:
    assert sorted(TABLE["selectors"]) == sorted(KINDS)


@pytest.mark.parametrize("settings", ALL, ids=str)
@pytest.mark.parametrize("size", [2, 3])
def test_every_selector_asks_what_can_be_compared_each_candidate_once(
    settings: dict[str, str], size: int, rng: np.random.Generator, make_segment: Callable[..., Segment]
) -> None:
    pool = [make_segment() for _ in range(40)]
    pool += [Segment(c.observations, c.actions, "one", start) for start, c in enumerate(pool[:20])]
    chosen = build(**settings, candidates=size).select(pool + pool[:5], Looking(), 6, rng)
    ids = [c.id for q in chosen for c in q.candidates]
    assert len(ids) == len(set(ids)) == 6 * size
    assert not any(overlap(a, b) for q in chosen for a, b in combinations(q.candidates, 2))


@pytest.mark.parametrize("settings", ALL, ids=str)
def test_equal_seeds_give_equal_queries(settings: dict[str, str]) -> None:
    first, second = (build(**settings).select(MIXED, Fake(), 4, np.random.default_rng(7)) for _ in range(2))
    assert [q.id for q in first] == [q.id for q in second]


@pytest.mark.parametrize("settings", ALL, ids=str)
def test_a_pool_gives_all_it_has_where_more_is_asked(settings: dict[str, str], rng: np.random.Generator) -> None:
    assert len(build(**settings).select(responses("unsure", 8), Fake(), 10, rng)) == 4
    assert build(**settings).select(responses("unsure", 1), Fake(), 10, rng) == []
    assert build(**settings).select([], Fake(), 10, rng) == []


@pytest.mark.parametrize("kind", ["disagreement", "information"])
@pytest.mark.parametrize("diversify", DIVERSE)
def test_scored_kinds_ask_where_members_differ(kind: str, diversify: str, rng: np.random.Generator) -> None:
    pool = [*MIXED, *(Response("unsure", "y" * (20 + i)) for i in range(12))]
    chosen = build(kind=kind, diversify=diversify, shortlist=2).select(pool, Fake(), 3, rng)
    assert all(q.candidates[0].prompt == "unsure" for q in chosen)


def test_disagreement_is_of_the_scores_that_were_fitted_not_of_settled_ones(rng: np.random.Generator) -> None:
    reward = Fake()
    chosen = build(kind="disagreement").select(MIXED, reward, 3, rng)
    assert all(q.candidates[0].prompt == "unsure" for q in chosen)
    assert reward.calls == 1  # each candidate was scored once


@pytest.mark.parametrize("settings", ALL[2:], ids=str)
def test_before_the_first_fit_scores_are_noise_so_the_draw_is_uniform(settings: dict[str, str]) -> None:
    reward = Fake()
    reward.fitted = False
    chosen = build(**settings).select(MIXED, reward, 3, np.random.default_rng(0))
    assert chosen == build(kind="uniform").select(MIXED, reward, 3, np.random.default_rng(0))


def test_one_member_alone_leaves_the_draw_uniform_unless_its_entropy_is_asked(rng: np.random.Generator) -> None:
    reward = Fake()
    reward.members = 1
    uniform = build(kind="uniform").select(MIXED, reward, 3, np.random.default_rng(0))
    for settings in ({"kind": "information"}, {"kind": "disagreement"}, {"kind": "entropy", "diversify": "batch"}):
        assert build(**settings).select(MIXED, reward, 3, np.random.default_rng(0)) == uniform
    chosen = build(kind="entropy", proposals=30).select(MIXED, reward, 3, rng)
    assert all(abs(len(a.text) - len(b.text)) == 1 for q in chosen for a, b in [q.candidates])


def test_coverage_spreads_out_even_before_the_first_fit(rng: np.random.Generator) -> None:
    reward = Fake()
    reward.fitted = False
    pool = responses("sure", 60) + [Response("unsure", "x" * (500 + i)) for i in range(2)]
    chosen = build(kind="coverage").select(pool, reward, 2, rng)
    assert {q.candidates[0].prompt for q in chosen} == {"sure", "unsure"}


def test_only_the_newest_share_is_asked_about(rng: np.random.Generator) -> None:
    for kind in KINDS:
        chosen = build(kind=kind, newest=0.5).select(MIXED, Fake(), 4, rng)
        assert {c.prompt for q in chosen for c in q.candidates} == {"unsure"}


def test_a_uniform_draw_gives_every_pair_the_same_chance(make_segment: Callable[..., Segment]) -> None:
    pool = [make_segment() for _ in range(4)]
    seen: dict[str, int] = {}
    for seed in range(600):
        (query,) = build(kind="uniform").select(pool, Fake(), 1, np.random.default_rng(seed))
        seen[query.id] = seen.get(query.id, 0) + 1
    assert len(seen) == 6
    assert all(count == pytest.approx(100, abs=40) for count in seen.values())


def test_more_proposals_find_more_informative_queries(make_segment: Callable[..., Segment]) -> None:
    pool, reward = [make_segment() for _ in range(60)], Looking()

    def found(proposals: int) -> float:
        selector = build(kind="information", proposals=proposals)
        chosen = selector.select(pool, reward, 5, np.random.default_rng(0))
        scores = np.stack([reward.raw_member_scores(list(q.candidates)) for q in chosen], 1)
        return float(information(scores).mean())

    assert found(12) > found(1)


@pytest.mark.parametrize("fitted", [True, False])
def test_of_the_answers_to_a_prompt_the_better_one_is_shown_once_there_is_a_reward(fitted: bool) -> None:
    reward, pool = Fake(), [*responses("a", 6), *responses("b", 6)]
    reward.fitted = fitted
    best = build(kind="uniform", candidates=1, best_of=3)
    shown = [best.select(pool, reward, 4, np.random.default_rng(seed)) for seed in range(20)]
    assert all(len(query.candidates) == 1 for queries in shown for query in queries)
    # Of six texts in two groups of three, the longest is the best of one, and the two shortest are the best of none.
    texts = [{query.candidates[0].text for query in queries} for queries in shown]
    assert all({"a xxxxx", "b xxxxx"} <= some for some in texts) is fitted
    assert any({"a ", "a x", "b ", "b x"} & some for some in texts) is not fitted
    assert {len(queries) for queries in shown} == {4}


def test_settings_say_what_a_kind_cannot_do() -> None:
    with pytest.raises(ValueError, match="diversify"):
        UnscoredSettings.model_validate({"kind": "uniform", "diversify": "dpp"})
    with pytest.raises(ValueError, match="shortlist"):
        ScoredSettings(shortlist=1)
