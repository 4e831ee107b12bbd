"""Many people at once, over HTTP: each question gets exactly as many different people as it should."""

from __future__ import annotations

from benchmark_runs import measured


def test_twelve_people_who_answer_at_once_leave_three_answers_of_different_people_to_each_question() -> None:
    found = measured("label_load", "--people", "12", "--labels", "20", "--think", "0", seconds=120)
    assert found["errors"] == 0
    assert found["labels"] == 12 * 20
    assert (found["wrong_overlap"], found["twice"]) == (0, 0)
