"""What people's answers come to, by hand; people who do not look among them."""

import time
from typing import Any

import numpy as np
import pytest
from made_log import NOW, Made, sweep

from prefrl.judgements import Answer, Choice, Comparison, Ranking, Rating, Skip, best_of
from prefrl.page import tallies
from prefrl.page.api import AnnotatorRow
from prefrl.page.ledger import LEFT, RIGHT, TIE, UNKNOWN, first_shown, said
from prefrl.stats.intervals import position_test, share

Generator = np.random.Generator


@pytest.fixture
def made() -> Made:
    return Made()


# --- one answer ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("answer", "size", "first", "winner"),
    [
        (Comparison("q", 1.0, shown=(0, 1)), 2, LEFT, 0),
        (Comparison("q", 1.0, shown=(1, 0)), 2, RIGHT, 0),
        (Comparison("q", 0.3, shown=(1, 0)), 2, LEFT, 1),
        (Comparison("q", 0.5, shown=(1, 0)), 2, TIE, None),
        (Comparison("q", 1.0), 2, UNKNOWN, 0),
        (Ranking("q", (2, 0, 1), shown=(2, 0, 1)), 3, LEFT, 1),
        (Ranking("q", (0, 0, 1), shown=(0, 1, 2)), 3, TIE, None),
        (Choice("q", 1, shown=(0, 1, 2)), 3, RIGHT, 1),
        (Choice("q", 1, shown=(0, 2, 1)), 3, UNKNOWN, 1),
        (Rating("q", (1, 3), 5, shown=(1, 0)), 2, LEFT, 1),
        (Rating("q", (3,), 5, shown=(0,)), 1, UNKNOWN, 0),
        (Skip("q", shown=(0, 1)), 2, UNKNOWN, None),
    ],
)
def test_what_one_answer_says_of_places_and_of_the_best(answer: Answer, size: int, first: int, winner: Any) -> None:
    assert first_shown(said(answer, size), answer.shown) == first
    assert best_of(answer) == winner


# --- one person ----------------------------------------------------------------------------------------------------


def test_answers_skips_and_times_of_a_person(made: Made) -> None:
    a, b, c, d = made.ask(4)
    made.compare(a, "ann", 1.0, seconds=2.0)
    made.compare(b, "ann", 0.5, seconds=4.0)
    made.add("skip", c, "ann", {"reason": "skip", "shown": [0, 1]})
    made.add("skip", d, "ann", {"reason": "incomparable", "shown": [0, 1]})
    made.compare(a, "ben", 1.0)
    found = made.person("ann")
    assert (found.answers, found.skips) == (3, 1)
    assert found.median_seconds == 3.0
    assert found.too_fast == 1, "clips of 5 seconds: 2 are too few, 4 are not"
    assert (found.left.value, found.left.count) == (1.0, 1)
    assert (found.ties.value, found.ties.count) == (0.5, 2)
    assert found.per_hour == pytest.approx(3600)


def test_what_was_taken_back_counts_no_longer(made: Made) -> None:
    (a,) = made.ask()
    made.compare(a, "ann", 1.0)
    made.add("retract", a, "ann")
    assert made.person("ann").answers == 0
    made.compare(a, "ann", 0.0)
    again = made.person("ann")
    assert (again.answers, again.left.value) == (1, 0.0)


def test_nothing_is_defined_of_somebody_who_did_nothing(made: Made) -> None:
    made.ask()
    found = made.person("ann")
    assert (found.answers, found.skips, found.median_seconds, found.per_hour) == (0, 0, None, None)
    reasons = [found.left.why, found.ties.why, found.checks.why]
    assert reasons == ["no pair was decided", "no pair was judged", "no check question was answered"]


def test_checks_need_the_expected_candidate_strictly_best(made: Made) -> None:
    checks = made.ask(4, purpose="check", expected=1)
    for query, preference in zip(checks, (0.0, 0.2, 0.5, 1.0), strict=True):
        made.compare(query, "ann", preference, shown=(1, 0))
    (skipped, given_up) = made.ask(2, purpose="check", expected=0)
    made.add("skip", skipped, "ann", {"reason": "skip"})
    made.add("skip", given_up, "ann", {"reason": "incomparable"})
    (ranked,) = made.ask(1, size=3, purpose="check", expected=2)
    made.add("ranking", ranked, "ann", {"ranks": [1, 1, 0]})
    found = made.person("ann").checks
    assert (found.value, found.count) == (0.5, 6)


def test_repeats_are_compared_with_what_stands_strength_aside(made: Made) -> None:
    a, b, c, d, e = made.ask(5)
    for query, before, after in ((a, 1.0, 0.7), (b, 1.0, 0.0), (c, 0.5, 0.5)):
        made.compare(query, "ann", before)
        made.repeat(query, "ann", after)
    made.compare(d, "ann", 1.0)
    made.add("repeat", d, "ann", {"answer": {"kind": "skip", "reason": "skip"}})
    made.add("skip", e, "ann", {"reason": "incomparable"})
    made.add("repeat", e, "ann", {"answer": {"kind": "skip", "reason": "incomparable"}})
    made.repeat(a, "ben", 0.0)
    ledger = made.ledger()
    assert tallies.repeated(ledger) == {ledger.people["ann"]: (3, 4)}
    assert made.person("ann").answers == 5, "repeats are no answers"
    assert made.person("ann").left.count == 5, "but they say where a person looks first"


def test_speed_leaves_pauses_out() -> None:
    assert tallies.per_hour(np.array([0.0, 36.0, 72.0, 50_000.0, 50_036.0])) == pytest.approx(100)
    assert tallies.per_hour(np.array([0.0, 5000.0])) is None
    assert tallies.per_hour(np.array([7.0, 7.0])) is None


# --- adversaries ---------------------------------------------------------------------------------------------------


def row_of(made: Made, name: str, rng: Generator) -> AnnotatorRow:
    ledger = made.ledger()
    same = share(*tallies.repeated(ledger).get(ledger.people[name], (0, 0)))
    each = made.agreement(rng)[1][ledger.people[name]]
    more: Any = vars(made.person(name)) | {"left": None, "ties": None, "checks": None}
    for part in ("left", "ties", "checks"):
        more[part] = getattr(made.person(name), part)
    return AnnotatorRow(
        name=name, role="annotator", state="active", repeats=same, agreement=each, last_seen=None, **more
    )


def test_constant_left_is_found_in_a_hundred_answers(made: Made, rng: Generator) -> None:
    made.ask(100)
    sweep(made, "lefty", lambda _: 1.0)
    left = made.person("lefty").left
    assert (left.value, left.count) == (1.0, 100)
    assert (position_test(100, 100) or 1) < 0.01
    assert any("left side" in words for words in tallies.concerns(row_of(made, "lefty", rng)))


def test_a_slight_bias_to_one_side_is_found_and_a_fair_person_left_alone(made: Made, rng: Generator) -> None:
    made.ask(100)
    sweep(made, "biased", lambda i: float(i % 10 < 7))
    sweep(made, "fair", lambda i: float(i % 2))
    assert any("left side" in words for words in tallies.concerns(row_of(made, "biased", rng)))
    assert tallies.concerns(row_of(made, "fair", rng)) == []


def test_random_answers_agree_with_nobody_beyond_chance(made: Made, rng: Generator) -> None:
    made.ask(200)
    for name in ("one", "other", "a third"):
        sweep(made, name, np.random.default_rng(len(name)).integers(2, size=200).astype(float).tolist().__getitem__)
    everybody, _ = made.agreement(rng)
    for found in (everybody.cohen, everybody.fleiss, everybody.krippendorff):
        assert found.value is not None
        assert found.low is not None
        assert found.low < 0 < (found.high or 0)


def test_a_fast_bot_is_found(made: Made, rng: Generator) -> None:
    made.ask(50)
    sweep(made, "bot", lambda i: float(i % 2), seconds=0.1)
    assert made.person("bot").too_fast == 50
    assert any("faster than half a clip in 50 of 50" in words for words in tallies.concerns(row_of(made, "bot", rng)))


def test_who_fails_checks_and_contradicts_themselves_is_found(made: Made, rng: Generator) -> None:
    made.ask(30)
    sweep(made, "careless", lambda i: float(i % 2))
    for query in made.ask(20, purpose="check", expected=0):
        made.compare(query, "careless", 0.0, shown=(int(query[1:]) % 2, 1 - int(query[1:]) % 2))
    for i in range(30):
        at = next(e for e in made.events if e["kind"] == "comparison" and e["subject"] == f"q{i}")
        made.repeat(f"q{i}", "careless", 1 - at["body"]["preference"], at["body"]["shown"])
    words = " ".join(tallies.concerns(row_of(made, "careless", rng)))
    assert "checks answered as expected: 0% of 20" in words
    assert "repeats answered as expected: 0% of 30" in words


def test_unanimous_people_agree_fully_and_kappas_say_why_they_are_missing(made: Made, rng: Generator) -> None:
    made.ask(40)
    for name in ("ann", "ben"):
        sweep(made, name, lambda _: 1.0, flip=False)
    everybody, each = made.agreement(rng)
    assert everybody.raw.value == 1.0
    for found in (everybody.cohen, everybody.fleiss, everybody.krippendorff):
        assert found.value is None
        assert "alike" in found.why
    assert [m.value for m in each.values()] == [1.0, 1.0]


def test_a_single_person_agrees_with_nobody(made: Made, rng: Generator) -> None:
    made.ask(40)
    sweep(made, "alone", lambda i: float(i % 2))
    everybody, each = made.agreement(rng)
    for found in (everybody.raw, everybody.cohen, everybody.fleiss, everybody.krippendorff):
        assert (found.value, found.why) == (None, "there is only one rater")
    assert "nobody else" in next(iter(each.values())).why
    assert everybody.intransitive.value is None


def test_an_empty_log_has_figures_without_numbers(made: Made, rng: Generator) -> None:
    everybody, each = made.agreement(rng)
    assert (everybody.raw.why, each) == ("there are no answers", {})


# --- between people ------------------------------------------------------------------------------------------------


def test_checks_skips_and_repeats_are_no_part_of_agreement(made: Made, rng: Generator) -> None:
    made.ask(20)
    for name, right in (("ann", 1.0), ("ben", 0.0)):
        sweep(made, name, ([right] * 20).__getitem__, flip=False)
    for query in made.ask(10, purpose="check", expected=0):
        made.compare(query, "ann", 1.0)
        made.compare(query, "ben", 1.0)
    made.repeat("q0", "ben", 1.0)
    found = made.agreement(rng)[0].raw
    assert (found.value, found.count) == (0.0, 20)


def test_alpha_is_ordinal_where_there_are_strengths(made: Made, rng: Generator) -> None:
    made.ask(60)
    truth = rng.choice([0.05, 0.27, 0.73, 0.95], size=60)
    near = np.where(rng.random(60) < 0.5, truth, 0.5 + (truth - 0.5) * 0.6)
    sweep(made, "ann", lambda i: float(truth[i]), flip=False)
    sweep(made, "ben", lambda i: float(near[i]), flip=False)
    found = made.agreement(rng)[0]
    assert found.raw.value == found.fleiss.value == 1.0, "they never differ on the side"
    assert found.krippendorff.value is not None
    assert 0.7 < found.krippendorff.value < 1.0


def test_rankings_count_as_pairs_that_hang_together(made: Made, rng: Generator) -> None:
    for query in made.ask(30, size=3):
        made.add("ranking", query, "ann", {"ranks": [0, 1, 2]})
        made.add("ranking", query, "ben", {"ranks": [0, 2, 1]})
    found = made.agreement(rng)[0].raw
    assert found.value == pytest.approx(2 / 3)
    assert found.count == 90
    assert found.low is not None
    assert found.low < 0.52, "Wilson's interval over 30 rankings, not over 90 pairs"


def test_circles_of_answers_are_seen(made: Made, rng: Generator) -> None:
    for t in range(10):
        for i, j, preference in ((0, 1, 1.0), (1, 2, 1.0), (0, 2, 0.0 if t < 4 else 1.0)):
            made.add("query", id=f"{t}-{i}{j}", body={"candidates": [f"{t}-{i}", f"{t}-{j}"]})
            made.compare(f"{t}-{i}{j}", "ann", preference)
    found = made.agreement(rng)[0].intransitive
    assert (found.value, found.count) == (0.4, 10)


# --- over time -----------------------------------------------------------------------------------------------------


def test_throughput_is_by_the_minute_at_first_and_by_the_hour_later() -> None:
    now = NOW.timestamp()
    unit, found = tallies.throughput(np.array([now - 130, now - 10, now - 5]), now)
    assert (unit, [count for _, count in found]) == ("minute", [1, 0, 2, 0])
    assert found[-1][0] == NOW.isoformat()
    unit, found = tallies.throughput(np.array([now - 90_000 * 10, now - 7300, now - 10]), now)
    assert (unit, len(found), sum(count for _, count in found)) == ("hour", 48, 2)
    assert tallies.throughput(np.zeros(0), now) == ("minute", [(NOW.isoformat(), 0)])


def test_a_hundred_thousand_answers_are_counted_within_seconds(rng: Generator) -> None:
    count, overlap = 33_334, 3
    query = np.repeat(np.arange(float(count)), overlap)
    who = rng.permuted(np.tile(np.arange(12.0), (count, 1)), axis=1)[:, :overlap].ravel()
    rows = {"query": query, "person": who, "purpose": 0 * who, "word": 0 * who}
    sides = {"one": rng.integers(2000, size=count)[query.astype(int)], "other": 2000 + query}
    pairs = {
        "row": np.arange(len(query)),
        "item": query,
        "preference": rng.choice([0, 0.5, 1], size=len(query)),
        **sides,
    }
    start = time.process_time()
    found, each = tallies.agreement(rows, pairs, np.ones(len(query), np.bool_), rng)
    assert time.process_time() - start < 4.0, "half a second on an idle core"
    assert (found.raw.count, len(each)) == (count, 12)
