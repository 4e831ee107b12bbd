"""Answering: what is pressed is what the store holds, once, in the query's own order."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest
from browser.house import FIRST, House, Open, fill, texts
from browser.visitor import Visit, Visitor
from playwright.sync_api import expect

from prefrl.judgements import Comparison, Skip

pytestmark = pytest.mark.browser

KEYS: dict[str, float | str] = {
    "ArrowLeft": FIRST["clear"],
    "2": 1 - FIRST["clear"],
    "Shift+ArrowRight": 1 - FIRST["much"],
    "ArrowDown": 0.5,
    "x": "incomparable",
    "1": FIRST["clear"],
    "a": FIRST["slight"],
    "s": "skip",
    "ArrowRight": 1 - FIRST["clear"],
    "Shift+ArrowLeft": FIRST["much"],
    "d": 1 - FIRST["slight"],
    "0": 0.5,
}
"""Each key, and the preference for the first slot that it stands for, or why there is none."""


def labelled(house: House, visitor: Visitor, keys: Sequence[str]) -> dict[str, float | str]:
    """Press keys, one a question; what the store should hold for each query, in its own order."""
    expected: dict[str, float | str] = {}
    for key in keys:
        query, shown = house.query_of(visitor.question()), visitor.shown()
        turned = house.slot_of(query, shown) == [1, 0]
        value = KEYS[key]
        expected[query] = 1 - value if turned and isinstance(value, float) else value
        visitor.press(key)
    return expected


def held(house: House) -> dict[str, float | str]:
    """What the store holds."""
    found: dict[str, float | str] = {}
    for query, answer in house.answers().items():
        assert isinstance(answer, Comparison | Skip)
        found[query] = answer.preference if isinstance(answer, Comparison) else answer.reason
    return found


def twenty() -> list[str]:
    return [*KEYS, *list(KEYS)[:8]]


def agree(one: dict[str, float | str], other: dict[str, float | str]) -> bool:
    return one.keys() == other.keys() and all(one[key] == pytest.approx(other[key]) for key in one)


def test_twenty_pairs_of_texts_are_labelled_by_keys_alone(text_house: House, visit: Visit) -> None:
    ann = visit(text_house.link("ann"))
    expected = labelled(text_house, ann, twenty())
    ann.saved()
    assert agree(held(text_house), expected)
    assert text_house.spoken() == 20
    assert {one["input"] for one in text_house.about()} == {"key"}


def test_twenty_pairs_of_clips_are_labelled_by_keys_alone(clip_house: House, visit: Visit) -> None:
    ann = visit(clip_house.link("ann"))
    expected = labelled(clip_house, ann, twenty())
    ann.saved()
    assert agree(held(clip_house), expected)
    assert clip_house.spoken() == 20


def test_the_end_is_said(tmp_path: Path, open_house: Open, visit: Visit) -> None:
    house = open_house(fill(tmp_path / "texts", texts(2)))
    ann = visit(house.link("ann"))
    labelled(house, ann, ["1", "2"])
    ann.situation("done")
    ann.saved()
    assert house.site.left() == 0


def test_ten_answers_are_taken_back_skips_among_them(text_house: House, visit: Visit) -> None:
    ann = visit(text_house.link("ann"))
    given = [ann.press(key) for key in ("1", "2", "0", "s", "x", "1", "s", "2", "a", "d", "1", "2")]
    ann.saved()  # or the last one is withdrawn before it was sent, and the log never hears of it
    for id in reversed(given[2:]):
        ann.page.keyboard.press("z")
        ann.question_is(id)
    ann.saved()
    assert sorted(text_house.answers()) == sorted(map(text_house.query_of, given[:2]))
    assert text_house.spoken() == 12
    expect(ann.page.locator(".earlier")).to_have_attribute("data-testid", "tie")
    ann.press("x")
    ann.saved()
    assert held(text_house)[text_house.query_of(given[2])] == "incomparable"


def test_an_answer_from_before_a_reload_is_taken_back(text_house: House, visit: Visit) -> None:
    ann = visit(text_house.link("ann"))
    id = ann.press("s")
    ann.saved()
    ann.page.reload()
    ann.question()
    ann.page.keyboard.press("z")
    ann.question_is(id)
    assert text_house.answers() == {}


def test_an_answer_is_changed_from_the_history(text_house: House, visit: Visit) -> None:
    ann = visit(text_house.link("ann"))
    expected = labelled(text_house, ann, ["1", "2", "x"])
    ann.saved()
    ann.go("/history")
    chips = ann.page.locator("[data-testid=entry] .answer-chip")
    expect(chips).to_have_text(["Can’t compare", "2 is clearly better", "1 is clearly better"])
    ann.test("change").nth(2).click()
    expected |= labelled(text_house, ann, ["0"])
    ann.saved()
    assert agree(held(text_house), expected)


def test_a_held_key_answers_once(text_house: House, visit: Visit) -> None:
    ann = visit(text_house.link("ann"))
    first = ann.question()
    for _ in range(3):
        ann.page.keyboard.down("ArrowLeft")
    ann.gone(first)
    second = ann.question()
    for _ in range(5):
        ann.page.keyboard.down("ArrowLeft")
    ann.page.keyboard.up("ArrowLeft")
    ann.saved()
    assert text_house.spoken() == 1
    assert ann.question() == second


@pytest.mark.parametrize("button", ["choose-first", "skip"])
def test_a_double_click_answers_once(text_house: House, visit: Visit, button: str) -> None:
    ann = visit(text_house.link("ann"))
    first = ann.question()
    ann.test(button).dblclick()
    ann.gone(first)
    ann.question()
    ann.saved()
    assert text_house.spoken() == 1
    assert text_house.about()[0]["input"] == "mouse"


def test_two_tabs_show_one_question_and_go_on_together(text_house: House, visit: Visit) -> None:
    ann = visit(text_house.link("ann"))
    id, shown = ann.question(), ann.shown()
    other = ann.window(f"{text_house.origin}/label")
    assert (other.question(), other.shown()) == (id, shown)
    ann.press("1")
    other.gone(id)
    assert other.question() == ann.question()
    other.press("2")
    ann.saved()
    other.saved()
    assert text_house.spoken() == 2


def test_two_browsers_of_one_person_give_one_label(text_house: House, visit: Visit) -> None:
    one, other = visit(text_house.link("ann")), visit(text_house.link("ann"))
    id, shown = one.question(), one.shown()
    assert (other.question(), other.shown()) == (id, shown)
    one.press("1")
    one.saved()
    other.press("x")
    expect(other.test("toast").first).to_contain_text("answered before")
    other.saved()
    assert text_house.spoken() == 1
    assert held(text_house)[text_house.query_of(id)] != "incomparable"


def test_a_reload_keeps_the_question_and_its_order(text_house: House, visit: Visit) -> None:
    ann = visit(text_house.link("ann"))
    ann.press("1")
    before = ann.question(), ann.shown()
    ann.saved()
    for _ in range(3):
        ann.page.reload()
        assert (ann.question(), ann.shown()) == before
