"""The desk: who is asked what next, and never too many of the same."""

from __future__ import annotations

import time
from collections import Counter

import pytest
from web_service import Clock

from prefrl.page.desk import APART, Desk
from prefrl.page.questions import Given, Past, Policy, Question


def asked(count: int, batch: int = 1, purpose: str = "label", begin: int = 0) -> list[Question]:
    return [Question(f"{purpose}-{batch}-{n}", 1000 * batch + n, batch, 2, purpose) for n in range(begin, count)]  # type: ignore[arg-type]


def desk(questions: list[Question], *people: str, clock: Clock | None = None, **policy: float) -> Desk:
    made = Desk(Policy(**policy), clock or Clock())  # type: ignore[arg-type]
    made.load(questions, [], 0, int(policy.get("overlap", 1)))
    for name in people:
        made.tell(name, Past())
    return made


def label_all(made: Desk, name: str, answers: int = 1) -> list[Given]:
    """Answer whatever comes, one at a time."""
    done: list[Given] = []
    while True:
        held, new = made.pick(name, 1)
        if not (held or new):
            return done
        done += [*held, *new]
        made.answered(done[-1], answers)


def test_the_newest_batch_comes_first_and_then_the_order_of_asking() -> None:
    made = desk([*asked(2, 1), *asked(2, 2)], "ann")
    assert [g.query for g in made.pick("ann", 4)[1]] == ["label-2-0", "label-2-1", "label-1-0", "label-1-1"]


def test_questions_asked_later_are_given_out_too() -> None:
    made = desk(asked(1), "ann")
    assert len(label_all(made, "ann")) == 1
    made.add(asked(3, 1, begin=1) + asked(1, 2))
    assert [g.query for g in label_all(made, "ann")] == ["label-2-0", "label-1-1", "label-1-2"]


def test_a_question_is_held_by_no_more_people_than_it_needs() -> None:
    made = desk(asked(5), "ann", "ben", "cid", overlap=2)
    given = [g for name in ("ann", "ben", "cid") for g in made.pick(name, 5)[1]]
    assert set(Counter(g.query for g in given).values()) == {2}
    assert len({(g.query, g.annotator) for g in given}) == 10


def test_what_one_holds_comes_again_in_the_same_order_and_nothing_else() -> None:
    made = desk(asked(9), "ann")
    _, new = made.pick("ann", 3)
    assert made.pick("ann", 3) == (new, [])
    assert made.pick("ann", 2)[0] == new[:2]


def test_a_lease_that_ran_out_goes_to_somebody_else_and_a_late_answer_counts() -> None:
    clock = Clock()
    made = desk(asked(1), "ann", "ben", clock=clock, lease_seconds=60)
    first = made.pick("ann", 1)[1][0]
    assert made.pick("ben", 1) == ([], [])
    clock.now += 61
    second = made.pick("ben", 1)[1][0]
    assert second.query == first.query
    assert made.pick("ann", 1) == ([], [])
    made.answered(first, 1)
    assert made.counts().answered == 1
    made.answered(second, 2)
    assert made.counts().answered == 1


def test_a_lease_that_ran_out_comes_back_to_who_held_it_if_nobody_else_came() -> None:
    clock = Clock()
    made = desk(asked(1), "ann", "ben", clock=clock, lease_seconds=60)
    given = made.pick("ann", 1)[1]
    clock.now += 3600
    assert made.pick("ann", 1) == (given, [])
    assert made.pick("ben", 1) == ([], [])


def test_a_sign_of_life_keeps_a_lease() -> None:
    clock = Clock()
    made = desk(asked(1), "ann", "ben", clock=clock, lease_seconds=60)
    given = made.pick("ann", 1)[1][0]
    for _ in range(5):
        clock.now += 50
        made.extend("ann", [given.id, "no such assignment"])
    assert made.pick("ben", 1) == ([], [])


def test_a_lease_that_was_renewed_outlives_its_first_expiry_and_ends_at_its_second() -> None:
    clock = Clock()
    made = desk(asked(1), "ann", "ben", clock=clock, lease_seconds=60)
    given = made.pick("ann", 1)[1][0]
    clock.now += 50
    made.extend("ann", [given.id])
    clock.now += 59
    assert made.pick("ben", 1) == ([], [])
    clock.now += 1
    assert [one.query for one in made.pick("ben", 1)[1]] == [given.query]


def test_a_skipped_question_goes_to_somebody_else_and_never_back() -> None:
    made = desk(asked(1), "ann", "ben")
    made.answered(made.pick("ann", 1)[1][0], 0, skipped=True)
    assert made.pick("ann", 1) == ([], [])
    assert made.stuck(["ann"]) == 1
    assert made.stuck(["ann", "ben"]) == 0
    made.answered(made.pick("ben", 1)[1][0], 1)
    assert made.stuck(["ann", "ben"]) == 0
    assert made.counts().answered == 1


def test_a_question_that_was_given_and_left_is_not_stuck() -> None:
    clock = Clock()
    made = desk(asked(2), "ann", clock=clock, lease_seconds=60)
    given = made.pick("ann", 2)[1]
    clock.now += 61
    assert made.stuck(["ann"]) == 0
    assert made.pick("ann", 2) == (given, [])
    made.answered(given[0], 0, skipped=True)
    assert made.stuck(["ann"]) == 1
    assert made.stuck([]) == 0


def test_a_question_that_needs_other_people_is_not_stuck() -> None:
    made = desk(asked(1), "ann", "ben", overlap=2)
    made.answered(made.pick("ann", 1)[1][0], 1)
    assert made.stuck(["ann"]) == 0
    made.answered(made.pick("ben", 1)[1][0], 1, skipped=True)
    assert made.stuck(["ben"]) == made.stuck(["ann", "ben"]) == 0


def test_a_skip_that_is_taken_back_leaves_nothing_stuck() -> None:
    clock = Clock()
    made = desk(asked(1), "ann", clock=clock)
    given = made.pick("ann", 1)[1][0]
    made.answered(given, 0, skipped=True)
    assert made.stuck(["ann"]) == 1
    made.reopened(given, Question(given.query, 1000, 1, 2, "label", 0, "ann"))
    clock.now += 1000
    assert made.stuck(["ann"]) == 0


def test_an_answer_that_is_taken_back_is_the_next_question_of_the_same_person() -> None:
    made = desk(asked(2), "ann", "ben")
    given = made.pick("ann", 1)[1][0]
    made.answered(given, 1)
    made.pick("ann", 1)
    made.reopened(given, Question(given.query, 1000, 1, 2, "label", 0, "ann"))
    assert made.pick("ann", 1)[0] == [given]
    assert made.counts().answered == 0
    assert made.pick("ben", 2) == ([], [])
    made.answered(given, 1)
    assert made.counts().answered == 1


def test_an_answer_that_is_taken_back_and_left_goes_to_others() -> None:
    clock = Clock()
    made = desk(asked(3), "ann", "ben", clock=clock)
    given = made.pick("ann", 1)[1][0]
    made.answered(given, 1)
    assert len(label_all(made, "ben")) == 2
    made.reopened(given, Question(given.query, 1000, 1, 2, "label", 0, "ann"))
    clock.now += 1000
    assert [g.query for g in label_all(made, "ben")] == [given.query]


def test_what_could_not_be_written_down_was_never_given() -> None:
    made = desk([*asked(4), *asked(1, purpose="check")], "ann", check_share=0.5)
    before = made.progress("ann")
    new = made.pick("ann", 4)[1]
    made.abandon(new)
    assert made.progress("ann") == before
    assert {g.query for g in label_all(made, "ann") if g.purpose == "label"} == {f"label-1-{n}" for n in range(4)}


def test_after_a_restart_people_get_back_what_they_held() -> None:
    given = Given("a" * 32, "label-1-0", "ann", "label", (1, 0))
    made = Desk(Policy(overlap=1), Clock())
    held = asked(2)
    held[0].names = "ann"
    made.load(held, [given], 3, 1)
    made.tell("ben", Past())
    made.tell("ann", Past(given=1))
    assert [g.query for g in made.pick("ben", 4)[1]] == ["label-1-1"]
    assert made.pick("ann", 1) == ([given], [])
    assert made.counts().asked == 5


def test_after_a_restart_what_was_taken_back_still_comes_first_though_others_have_answered() -> None:
    held = [Given(f"{n}" * 32, f"label-1-{n}", "ann", "label", (0, 1)) for n in range(3)]
    made = Desk(Policy(overlap=1), Clock())
    questions = asked(2)
    for question in questions:
        question.names = "ann"
    made.load(questions, held, 1, 1, taken_back=[held[1], held[2]])
    made.tell("ann", Past(given=3))
    assert made.pick("ann", 3) == ([held[2], held[1], held[0]], [])


def test_checks_come_now_and_then_and_once_to_each_person() -> None:
    made = desk([*asked(400), *asked(5, purpose="check")], "ann", "ben", check_share=0.1)
    for name in ("ann", "ben"):
        checks = [g.query for g in label_all(made, name, answers=0) if g.purpose == "check"]
        assert sorted(checks) == [f"check-1-{n}" for n in range(5)]


def test_repeats_are_ones_own_answers_of_a_while_ago_with_the_sides_turned_round() -> None:
    made = desk(asked(300), "ann", repeat_share=0.2)
    done = label_all(made, "ann")
    place = {g.query: n for n, g in enumerate(done) if g.purpose == "label"}
    repeats = [(n, g) for n, g in enumerate(done) if g.purpose == "repeat"]
    assert 30 < len(repeats) < 90
    assert len({g.query for _, g in repeats}) == len(repeats)
    for n, g in repeats:
        assert n - place[g.query] > APART
        assert g.shown == done[place[g.query]].shown[::-1]


def test_sides_hang_on_seed_question_and_person_alone() -> None:
    def sides(seed: int, name: str) -> list[tuple[int, ...]]:
        return [g.shown for g in desk(asked(200), name, seed=seed).pick(name, 200)[1]]

    assert sides(0, "ann") == sides(0, "ann")
    assert sides(0, "ann") != sides(1, "ann")
    assert sides(0, "ann") != sides(0, "ben")
    assert 70 < sum(shown == (0, 1) for shown in sides(0, "ann")) < 130


def test_progress_counts_what_one_could_still_be_given() -> None:
    made = desk(asked(4), "ann", "ben", overlap=2)
    assert made.progress("ann") == (0, 0, 4, 4)
    made.answered(made.pick("ann", 1)[1][0], 1)
    assert made.progress("ann") == (1, 0, 4, 3)
    assert made.progress("ben") == (0, 0, 4, 4)
    label_all(made, "ben", answers=2)
    assert made.progress("ann") == (1, 4, 4, 0)


@pytest.mark.slow
def test_the_next_question_is_found_at_once_among_a_hundred_thousand() -> None:
    made = desk(asked(100_000), "ann", "ben", overlap=3)
    skipped = made.pick("ann", 20_000)[1]
    begin = time.process_time()
    for given in skipped:
        made.answered(given, 0)  # free again for everybody but ann
    for _ in range(2000):
        made.answered(made.pick("ben", 1)[1][0], 1)
        made.answered(made.pick("ann", 1)[1][0], 1)
    assert time.process_time() - begin < 3.0
