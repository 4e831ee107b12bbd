"""A report card as people read it: in words, and as a page."""

import json
import xml.etree.ElementTree as ElementTree
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from linear_reward import LinearReward
from run_folders import wild_card

from prefrl.evaluate.card import Bucket, ReportCard
from prefrl.evaluate.grade import Subject, grade
from prefrl.judgements import Comparison, Judged
from prefrl.report.card_words import groups, headline, span
from prefrl.report.facts import gather
from prefrl.report.records import read
from prefrl.report.report import render_card, write_report
from prefrl.report.words import verdict
from prefrl.stats.estimates import Estimate, undefined
from prefrl.types import Query, Response


@pytest.fixture
def card() -> ReportCard:
    return wild_card()


def test_the_headline_says_what_it_rests_on(card: ReportCard) -> None:
    assert headline(card).startswith("It names the winner of ")
    assert headline(card).endswith(" of 40 held-out comparisons.")
    everything = card.model_copy(update={"about": card.about.model_copy(update={"held_out": False})})
    assert "trained on or not" in headline(everything)


def test_every_number_is_told_or_explained(card: ReportCard) -> None:
    told = dict(groups(card))
    assert list(told) == [
        "Accuracy",
        "Calibration",
        "Length",
        "Gold",
        "Members",
        "Self-test",
        "Labelers",
        "Drift between rounds",
    ]
    for row in (row for rows in told.values() for row in rows):
        assert row.value or row.note.startswith("not defined: "), row


def test_one_reason_for_many_numbers_is_given_once() -> None:
    query = Query((Response("p", "aa"), Response("p", "bb")))
    one = grade(Subject(LinearReward([1.0]), [Judged(query, Comparison(query.id, 1.0))]), np.random.default_rng(0))
    told = dict(groups(one))
    assert [(row.name, row.note) for row in told["Length"]] == [
        ("nothing to measure", "not defined: all candidates have length 2")
    ]
    assert [row.name for row in told["Gold"]] == ["nothing to measure"]
    reasons = told["Gold"][0].note.removeprefix("not defined: ").split("; ")
    assert len(reasons) == len(set(reasons)) > 1
    assert "Members" not in told


def test_ranges_are_shown_as_people_read_them() -> None:
    ranges = [(0.0, 8.0), (0.75, 1.594), (2.0, 2.0)]
    shown = [span(Bucket(low=low, high=high, accuracy=undefined("-"))) for low, high in ranges]
    assert shown == ["0 to 8", "0.75 to 1.59", "2"]


def test_the_page_is_harmless_and_whole(card: ReportCard) -> None:
    page = render_card(card)
    assert "<script" not in page
    assert "&lt;script&gt;alert(1)" in page
    assert not set(page) & set("\u202e\x1b")
    assert "{{ 7*7 }}" in page
    figures = [part.split("</svg>")[0] + "</svg>" for part in page.split("<svg")[1:]]
    assert len(figures) == 7
    for figure in figures:
        ElementTree.fromstring("<svg" + figure)
        assert "#0101" not in figure
    ids = [part.split('"')[0] for part in page.split(' id="')[1:]]
    assert len(ids) == len(set(ids))


def test_the_report_of_a_run_tells_of_the_card_that_lies_in_its_folder(card: ReportCard, tmp_path: Path) -> None:
    assert "How good is the reward model?" not in write_report(tmp_path).read_text("utf-8")
    (tmp_path / "card.json").write_text(card.model_dump_json())
    page = write_report(tmp_path).read_text("utf-8")
    assert "How good is the reward model?" in page
    assert "<script" not in page
    assert "Accuracy by margin" in page


@pytest.mark.parametrize(
    ("low", "held_out", "warned"), [(0.31, True, True), (0.5, True, True), (0.51, True, False), (0.31, False, False)]
)
def test_a_reward_that_may_be_a_coin_is_said_to_be_one(
    low: float, held_out: bool, warned: bool, card: ReportCard, tmp_path: Path
) -> None:
    about = card.about.model_copy(update={"held_out": held_out})
    accuracy = Estimate(value=0.6, low=low, high=0.8, count=20)
    (tmp_path / "card.json").write_text(
        card.model_copy(update={"about": about, "accuracy": accuracy}).model_dump_json()
    )
    told = "On 20 held-out comparisons the reward is not clearly better than a coin (60\N{NO-BREAK SPACE}% right)"
    assert (told in verdict(gather(read(tmp_path)))) is warned
    gold = {"gold_before": 0.1, "gold_after": 0.9, "gold_best": 0.9}  # it knew enough
    (tmp_path / "summary.json").write_text(json.dumps(gold))
    assert told not in verdict(gather(read(tmp_path)))


@pytest.mark.parametrize("wild", [None, "x", -1e308, 10**400, [1], {"value": "NaN"}, {"value": 1e300}])
def test_a_card_that_makes_no_sense_is_named_and_left_out(wild: Any, card: ReportCard, tmp_path: Path) -> None:
    content = json.loads(card.model_dump_json())
    (tmp_path / "card.json").write_text(json.dumps(content | {"accuracy": wild}))
    record = read(tmp_path)
    assert record.card is None
    assert "card.json: cannot be read" in record.missing


def test_a_page_names_a_card_that_makes_no_sense(tmp_path: Path) -> None:
    (tmp_path / "card.json").write_text("{}")
    page = write_report(tmp_path).read_text("utf-8")
    assert "card.json: cannot be read" in page
    assert "How good is the reward model?" not in page
