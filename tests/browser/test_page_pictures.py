"""Pictures side by side: two or four of them, judged by keys alone."""

from __future__ import annotations

from pathlib import Path

import pytest
from browser.house import Open, digits, fill
from browser.visitor import Visit
from playwright.sync_api import expect

from prefrl.judgements import Comparison, Ranking, Skip

pytestmark = pytest.mark.browser
KEYS = ("1", "2", "ArrowLeft", "ArrowRight", "0", "x", "s")
PREFERENCE = {"1": 1.0, "ArrowLeft": 1.0, "2": 0.0, "ArrowRight": 0.0, "0": 0.5}
"""For the first slot."""


def test_twenty_pairs_are_judged_by_keys(tmp_path: Path, open_house: Open, visit: Visit) -> None:
    house = open_house(fill(tmp_path / "pictures", digits(20)), kind="pictures", strength=False)
    ann = visit(house.link("ann"))
    given: dict[str, tuple[str, int]] = {}
    for number in range(20):
        id = ann.question()
        if number == 0:
            expect(ann.page.locator(".prompt")).to_contain_text("a three")
            expect(ann.page.locator(".slot img")).to_have_count(2)
            assert ann.page.locator("[data-testid=transport]").count() == 0, "a picture has no player"
            expect(ann.test("gate")).to_be_hidden()
            sizes = ann.page.evaluate("[...document.querySelectorAll('.slot img')].map((one) => one.naturalWidth)")
            assert sizes == [160, 160]
        key, query = KEYS[number % len(KEYS)], house.query_of(id)
        given[query] = key, house.slot_of(query, ann.shown())[0]
        ann.page.keyboard.press(key)
        ann.gone(id)
    ann.saved()
    answers = house.answers()
    assert len(answers) == 20
    for query, (key, first) in given.items():
        answer = answers[query]
        if key in PREFERENCE:
            assert isinstance(answer, Comparison)
            assert answer.preference == (PREFERENCE[key] if first == 0 else 1 - PREFERENCE[key])
        else:
            assert isinstance(answer, Skip)


def test_four_pictures_are_put_in_order_by_keys(tmp_path: Path, open_house: Open, visit: Visit) -> None:
    house = open_house(fill(tmp_path / "pictures", digits(1, size=4)), kind="pictures")
    ann = visit(house.link("ann"))
    id = ann.question()
    query, slots = house.query_of(id), house.slot_of(house.query_of(id), ann.shown())
    assert ann.page.locator(".slot img").count() == 4
    for key in ("4", "ArrowUp", "ArrowUp", "ArrowUp", "1", "ArrowDown", "Enter"):
        ann.page.keyboard.press(key)
    ann.gone(id)
    ann.saved()
    answer = house.answers()[query]
    assert isinstance(answer, Ranking)
    assert sorted(range(4), key=lambda slot: answer.ranks[slots[slot]]) == [3, 1, 0, 2]
