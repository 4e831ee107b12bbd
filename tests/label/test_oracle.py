from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from prefrl import Config
from prefrl.components import ConfigError
from prefrl.envs.control import ControlSettings
from prefrl.envs.toys import PointSettings
from prefrl.judgements import Answer, Choice, Comparison, Ranking, Rating, Skip
from prefrl.label.crowd import Crowd, CrowdSettings
from prefrl.label.oracle import Oracle, OracleSettings
from prefrl.store import Store
from prefrl.types import Query, Response, Segment

Ask = Callable[..., Query[Segment]]
Pairs = Callable[[int], list[Query[Segment]]]


def judge(query: Query[Segment], rng: np.random.Generator, **settings: Any) -> Answer:
    """The answer of a teacher that knows of nothing else that was asked."""
    oracle = Oracle(OracleSettings(**settings))
    return oracle.judge(query, [c.gold for c in query.candidates if c.gold is not None], rng, oracle.limits(None))


def total(query: Query[Any]) -> np.ndarray:
    return np.array([c.gold.sum() for c in query.candidates])


def by_gold(query: Query[Segment], values: tuple[int, ...]) -> dict[float, int]:
    return {round(float(g), 2): value for g, value in zip(total(query), values, strict=True)}


def test_the_oracle_prefers_more_gold(make_query: Ask, rng: np.random.Generator) -> None:
    query = make_query(1.0, 5.0)
    judged = judge(query, rng)
    assert isinstance(judged, Comparison)
    assert judged.preference == float(total(query)[0] == 5.0)
    assert sorted(judged.shown) == [0, 1]


def test_the_oracle_ranks_more_than_two_with_ties(make_query: Ask, rng: np.random.Generator) -> None:
    query = make_query(0.0, 3.0, 3.05, 9.0)
    judged = judge(query, rng, tie_within=0.1)
    assert isinstance(judged, Ranking)
    assert by_gold(query, judged.ranks) == {9.0: 0, 3.05: 1, 3.0: 1, 0.0: 2}


def test_equal_gold_is_a_tie(make_query: Ask, rng: np.random.Generator) -> None:
    judged = judge(make_query(2.0, 2.0), rng)
    assert isinstance(judged, Comparison)
    assert judged.preference == 0.5


def test_a_mistake_turns_a_ranking_upside_down_and_keeps_its_ties(make_query: Ask, rng: np.random.Generator) -> None:
    query = make_query(0.0, 3.0, 3.05, 9.0)
    judged = judge(query, rng, tie_within=0.1, mistake_rate=1.0)
    assert isinstance(judged, Ranking)
    assert by_gold(query, judged.ranks) == {9.0: 2, 3.05: 1, 3.0: 1, 0.0: 0}


def test_a_query_without_a_good_candidate_is_skipped(make_query: Ask, rng: np.random.Generator) -> None:
    assert isinstance(judge(make_query(0.0, 1.0), rng, skip_below=2.0), Skip)
    assert isinstance(judge(make_query(0.0, 3.0), rng, skip_below=2.0), Comparison)


def test_a_myopic_teacher_looks_at_late_steps(make_segment: Callable[..., Segment], rng: np.random.Generator) -> None:
    early = Segment(*two_arrays(make_segment()), episode="e", start=0, gold=np.array([9.0, 0, 0, 0, 0]))
    late = Segment(*two_arrays(make_segment()), episode="l", start=0, gold=np.array([0.0, 0, 0, 0, 1]))
    query = Query((early, late))
    for discount, winner in ((1.0, early), (0.5, late)):  # 9 / 2^4 < 1
        judged = judge(query, rng, discount=discount)
        assert isinstance(judged, Comparison)
        assert query.candidates[int(judged.preference == 0.0)] is winner


def test_a_teacher_that_sees_height_prefers_what_swings_higher_and_needs_no_gold(rng: np.random.Generator) -> None:
    task = ControlSettings(env="Acrobot-v1").build()
    oracle, hanging = OracleSettings(sees="height").build(task), np.zeros((5, 4))
    raised = hanging + np.array([1.0, 0.5, 0.0, 0.0])
    low, high = (
        Segment(np.zeros((5, 6), np.float32), np.zeros((5, 3), np.float32), name, 0, states)
        for name, states in (("low", hanging), ("high", raised))
    )
    nothing = [np.full(5, np.nan)] * 2
    for query in (Query((low, high)), Query((high, low))):
        judged = oracle.judge(query, nothing, rng, oracle.limits(None))
        assert isinstance(judged, Comparison)
        assert query.candidates[int(judged.preference == 0.0)] is high
    blind = Query((low, replace(high, states=None)))
    with pytest.raises(ValueError, match="without simulator states"):
        oracle.judge(blind, nothing, rng, oracle.limits(None))


def two_arrays(segment: Segment) -> tuple[Any, Any]:
    return segment.observations, segment.actions


def test_the_best_of_several_is_chosen(make_query: Ask, rng: np.random.Generator) -> None:
    query = make_query(0.0, 3.0, 9.0)
    judged = judge(query, rng, judgement="choice")
    assert isinstance(judged, Choice)
    assert total(query)[judged.best] == pytest.approx(9.0)
    worst = judge(query, rng, judgement="choice", mistake_rate=1.0)
    assert isinstance(worst, Choice)
    assert total(query)[worst.best] == pytest.approx(0.0)


def test_one_of_several_equal_best_is_chosen_at_random(make_query: Ask, rng: np.random.Generator) -> None:
    query = make_query(5.0, 5.0, 0.0)
    best = [judge(query, rng, judgement="choice") for _ in range(200)]
    counts = np.bincount([b.best for b in best if isinstance(b, Choice)], minlength=3)
    assert counts[total(query) == 0] == 0
    assert np.all(counts[total(query) > 1] > 60)


def test_a_ranking_follows_plackett_luce(make_query: Ask, rng: np.random.Generator) -> None:
    """Against the product of softmaxes over what is left, for every order of three."""
    query = make_query(0.0, 0.5, 1.5)
    worth = np.exp(2.0 * total(query))
    draws = [judge(query, rng, rationality=2.0) for _ in range(2000)]
    ranks = [d.ranks for d in draws if isinstance(d, Ranking)]
    for first in range(3):
        for second in {0, 1, 2} - {first}:
            expected = worth[first] / worth.sum() * worth[second] / (worth.sum() - worth[first])
            share = np.mean([r[first] == 0 and r[second] == 1 for r in ranks])
            assert share == pytest.approx(expected, abs=0.035)


def test_a_pair_follows_bradley_terry(make_query: Ask, rng: np.random.Generator) -> None:
    query = make_query(0.0, 1.0)
    draws = [judge(query, rng, rationality=1.5) for _ in range(1500)]
    right = np.mean([d.preference == float(total(query)[0] > 0.5) for d in draws if isinstance(d, Comparison)])
    assert right == pytest.approx(1 / (1 + np.exp(-1.5)), abs=0.035)


def test_position_bias_follows_what_was_shown_first(make_query: Ask, rng: np.random.Generator) -> None:
    query = make_query(0.0, 1.0, 2.0)
    judged = judge(query, rng, position_bias=1.0)
    assert isinstance(judged, Ranking)
    assert [judged.ranks[i] for i in judged.shown] == [0, 1, 2]
    pair = make_query(0.0, 1.0)
    draws = [judge(pair, rng, position_bias=0.4) for _ in range(2000)]
    first = np.mean([d.preference == float(d.shown[0] == 0) for d in draws if isinstance(d, Comparison)])
    assert first == pytest.approx(0.4 + 0.6 * 0.5, abs=0.04)
    assert isinstance(tie := judge(make_query(1.0, 1.0), rng, position_bias=1.0), Comparison)
    assert tie.preference == 0.5


def test_mistakes_come_at_the_rate_asked_for(store: Store[Segment], make_pairs: Pairs) -> None:
    queries = make_pairs(300)
    store.ask(queries)
    Oracle(OracleSettings(mistake_rate=0.2)).answer(store, np.random.default_rng(1))
    truth = {q.id: float(total(q)[0]) for q in queries}
    wrong = [j.judgement.preference != truth[j.query.id] for j in store.judged() if isinstance(j.judgement, Comparison)]
    assert np.mean(wrong) == pytest.approx(0.2, abs=0.06)


def test_left_and_right_are_shown_at_random(store: Store[Segment], make_pairs: Pairs) -> None:
    store.ask(make_pairs(200))
    Oracle(OracleSettings()).answer(store, np.random.default_rng(0))
    assert np.mean([a.shown == (0, 1) for a in store.answers()]) == pytest.approx(0.5, abs=0.1)


def test_answers_do_not_depend_on_what_was_answered_before(store: Store[Segment], make_query: Ask) -> None:
    """A run that was killed half way through its answers gets the same ones when it goes on."""
    queries = [make_query(0.0, 1.0) for _ in range(20)]
    oracle = Oracle(OracleSettings(mistake_rate=0.5))
    whole = oracle_answer(oracle, queries, store, 20)
    again = Store[Segment](store.folder.parent / "again")
    with again:
        oracle_answer(oracle, queries[:7], again, 7)
        assert oracle_answer(oracle, queries, again, 20) == whole


def test_calibrated_answers_hang_on_what_was_asked_alone(
    tmp_path: Path, make_query: Ask, rng: np.random.Generator
) -> None:
    """The same set in another order, with some of it judged by somebody else already, gives the same answers."""
    queries = [make_query(*rng.normal(size=2)) for _ in range(24)]
    oracle = Oracle(OracleSettings(error_rate=0.3, tie_rate=0.2, skip_rate=0.2))
    with Store[Segment](tmp_path / "whole") as one, Store[Segment](tmp_path / "part") as other:
        one.ask(queries)
        oracle.answer(one, np.random.default_rng(5))
        other.ask(queries[::-1])
        other.answer([Comparison(q.id, 1.0, "me") for q in queries[:6]])
        oracle.answer(other, np.random.default_rng(5))
        left = {q.id for q in queries[6:]}
        assert {a.query: a for a in one.answers() if a.query in left} == {
            a.query: a for a in other.answers() if a.labeler == "oracle"
        }


def oracle_answer(
    oracle: Oracle, queries: list[Query[Segment]], store: Store[Segment], count: int
) -> dict[str, tuple[int, ...]]:
    store.ask(queries)
    oracle.answer(store, np.random.default_rng(5))
    answers = store.answers()
    assert len(answers) == count
    return {a.query: (*a.shown, int(isinstance(a, Comparison) and a.preference)) for a in answers}


def test_what_one_skips_is_asked_of_another_in_its_place(store: Store[Segment], make_query: Ask) -> None:
    queries = [make_query(0.0, gold) for gold in (9.0, 1.0, 8.0)]
    store.ask(queries)
    picky = Oracle(OracleSettings(name="picky", skip_below=5.0))
    picky.answer(store, np.random.default_rng(0))
    assert store.counts() == {"asked": 3, "answered": 2, "skipped": 1}
    assert store.open_queries("picky") == []
    assert [q.id for q in store.open_queries("other")] == [queries[1].id]
    store.ask([later := make_query(0.0, 2.0)])
    assert [q.id for q in store.open_queries("other")] == [queries[1].id, later.id]
    Oracle(OracleSettings(name="other")).answer(store, np.random.default_rng(0))
    assert {a.labeler for a in store.answers() if a.query == queries[1].id} == {"picky", "other"}


def test_gold_that_is_missing_or_nan_is_an_error(store: Store[Segment], make_query: Ask) -> None:
    store.ask([make_query(0.0, float("nan"))])
    for settings in (OracleSettings(), OracleSettings(error_rate=0.1)):
        with pytest.raises(ValueError, match=r"query .*: a simulated teacher needs finite gold"):
            Oracle(settings).answer(store, np.random.default_rng(0))
    assert store.answers() == []


def test_one_candidate_can_only_be_rated(make_query: Ask, rng: np.random.Generator) -> None:
    with pytest.raises(ValueError, match="can only be rated"):
        judge(make_query(1.0), rng)
    assert isinstance(judge(make_query(1.0), rng, judgement="rating"), Rating)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"rationality": 1.0, "error_rate": 0.1}, "rationality and error_rate"),
        ({"skip_below": 0.0, "skip_rate": 0.1}, "skip_below and skip_rate"),
        ({"tie_within": 1.0, "tie_epsilon": 0.1}, "tie_within and tie_epsilon"),
        ({"bpref_compat": True}, "skip_epsilon and tie_epsilon"),
        ({"judgement": "rating", "position_bias": 0.1}, "a rating has none"),
        ({"sees": "height", "tie_epsilon": 0.1}, "shares of gold"),
        ({"error_rate": 0.6}, "less than or equal to 0.49"),
    ],
)
def test_settings_that_contradict_each_other_are_refused(settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        OracleSettings(**settings)


def test_settings_that_do_not_suit_the_task_are_refused() -> None:
    task: Any = type("Text", (), {"kind": "text", "name": "t"})()
    with pytest.raises(ConfigError, match="has one step, so expected 1"):
        OracleSettings(discount=0.9).build(task)
    with pytest.raises(ConfigError, match="only texts differ in length"):
        OracleSettings(length_bias=0.1).build(PointSettings().build())
    with pytest.raises(ConfigError, match=r"labeler.sees=height: expected a task whose heights are known \(Acrobot-v1"):
        OracleSettings(sees="height").build(PointSettings().build())


RATES = {"a": 0.0, "b": 0.0, "c": 1.0}
CROWD = CrowdSettings(
    annotators=tuple(OracleSettings(name=name, mistake_rate=rate) for name, rate in RATES.items()), overlap=2
)


def crowd(settings: CrowdSettings) -> Crowd:
    return settings.build(PointSettings().build())


def test_every_query_is_judged_by_as_many_as_asked_for(store: Store[Segment], make_query: Ask) -> None:
    queries = [make_query(0.0, 1.0) for _ in range(60)]
    store.ask(queries)
    crowd(CROWD).answer(store, np.random.default_rng(0))
    found = store.answers()
    assert all(len({a.labeler for a in found if a.query == q.id}) == 2 for q in queries)
    assert store.open_queries() == []
    counts = [sum(a.labeler == name for a in found) for name in "abc"]
    assert sum(counts) == 120
    assert min(counts) > 25
    truth = {q.id: float(total(q)[0] > 0.5) for q in queries}
    for answer in found:
        assert isinstance(answer, Comparison)
        assert answer.preference == (1 - truth[answer.query] if answer.labeler == "c" else truth[answer.query])


def test_annotators_do_not_make_the_same_random_mistakes(store: Store[Segment], make_query: Ask) -> None:
    store.ask([make_query(0.0, 1.0) for _ in range(60)])
    pair = tuple(OracleSettings(name=name, mistake_rate=0.5) for name in "ab")
    crowd(CrowdSettings(annotators=pair, overlap=2)).answer(store, np.random.default_rng(0))
    said = {(a.query, a.labeler): a.preference for a in store.answers() if isinstance(a, Comparison)}
    same = [said[query, "a"] == said[query, "b"] for query, name in said if name == "a"]
    assert 0.25 < np.mean(same) < 0.75


def test_who_skips_is_replaced_and_what_all_skip_stays_open(store: Store[Segment], make_query: Ask) -> None:
    queries = [make_query(0.0, gold) for gold in (9.0, 1.0, 9.0, 1.0)]
    store.ask(queries)
    picky = OracleSettings(name="picky", skip_below=5.0)
    alone = crowd(CrowdSettings(annotators=(picky,)))
    alone.answer(store, np.random.default_rng(0))
    alone.answer(store, np.random.default_rng(1))
    assert [q.id for q in store.open_queries("crowd")] == [queries[1].id, queries[3].id]
    assert store.counts() == {"asked": 4, "answered": 2, "skipped": 2}
    crowd(CrowdSettings(annotators=(picky, OracleSettings(name="easy")))).answer(store, np.random.default_rng(2))
    assert store.open_queries() == []


def test_a_crowd_gives_the_same_answers_again(tmp_path: Path, make_query: Ask) -> None:
    queries = [make_query(0.0, 1.0) for _ in range(12)]
    found = []
    for name, order in (("one", queries), ("two", queries[::-1])):
        with Store[Segment](tmp_path / name) as store:
            store.ask(order)
            crowd(CROWD).answer(store, np.random.default_rng(3))
            found.append({(a.query, a.labeler): a for a in store.answers()})
    assert found[0] == found[1]


def test_a_crowd_is_told_apart_by_its_names() -> None:
    config = Config.load("control/toy", ["labeler.kind=crowd", "labeler.annotators=[{name: a}, {name: b}]"])
    assert Config.parse(config.model_dump(mode="json")) == config
    with pytest.raises(ConfigError, match="annotators need a name each"):
        Config.load("control/toy", ["labeler.kind=crowd", "labeler.annotators=[{}, {}]"])
    with pytest.raises(ConfigError, match="overlap must be at most the number of annotators, 1, got 2"):
        Config.load("control/toy", ["labeler.kind=crowd", "labeler.annotators=[{}]", "labeler.overlap=2"])


def test_a_long_answer_seems_better_to_a_teacher_with_a_length_bias(text_store: Store[Response]) -> None:
    """Gold and length disagree everywhere: a bias below 1 leaves the gold the winner, one above 1 the length."""
    queries = [Query((Response(f"p{i}", "x" * (10 + 2 * i), gold=np.array([1.0])),
                      Response(f"p{i}", "x", gold=np.array([2.0])))) for i in range(10)]  # fmt: skip
    text_store.ask(queries)
    long = {q.id: int(np.argmax([len(c.text) for c in q.candidates])) for q in queries}
    for bias, share in ((0.1, 0.0), (4.0, 1.0), (-4.0, 0.0)):
        name = f"bias{bias}"
        oracle = Oracle(OracleSettings(name=name, length_bias=bias))
        oracle.answer(text_store, np.random.default_rng(0))
        said = [a for a in text_store.answers() if a.labeler == name and isinstance(a, Comparison)]
        assert np.mean([a.preference == float(long[a.query] == 0) for a in said]) == share
        for answer in said:
            text_store.retract(answer.query, name)
