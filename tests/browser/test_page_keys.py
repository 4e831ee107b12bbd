"""Keys: never while writing, never when switched off, and whichever a person has chosen."""

from __future__ import annotations

import pytest
from browser.house import FIRST, House
from browser.visitor import Visit, Visitor
from playwright.sync_api import expect

pytestmark = pytest.mark.browser


def settle(ann: Visitor) -> str:
    """The question on show after two frames: what a key did would be seen by then."""
    ann.page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return ann.question()


def test_keys_write_while_a_comment_is_written(text_house: House, visit: Visit) -> None:
    ann = visit(text_house.link("ann"))
    id = ann.question()
    ann.page.keyboard.press("c")
    ann.page.keyboard.type("12 0 xszr?g-+ maybe")
    ann.page.keyboard.press("ArrowLeft")
    expect(ann.test("comment-text")).to_have_value("12 0 xszr?g-+ maybe")
    assert settle(ann) == id
    ann.test("comment-keep").click()
    ann.press("1")
    ann.saved()
    assert [one["comment"] for one in text_house.about()] == ["12 0 xszr?g-+ maybe"]


def test_keys_can_be_switched_off(text_house: House, visit: Visit) -> None:
    ann = visit(text_house.link("ann"))
    ann.question()
    expect(ann.test("choose-first")).to_have_attribute("aria-keyshortcuts", "ArrowLeft 1")
    ann.test("settings").click()
    ann.test("setting-keys").uncheck()
    ann.page.keyboard.press("Escape")
    ann.page.reload()
    id = ann.question()
    for key in ("1", "ArrowRight", "x", "s", "z", "g", "?"):
        ann.page.keyboard.press(key)
    assert settle(ann) == id
    assert ann.page.locator("dialog[open]").count() == 0
    assert ann.test("choose-first").get_attribute("aria-keyshortcuts") is None
    ann.test("choose-first").click()
    ann.gone(id)
    ann.saved()
    assert text_house.spoken() == 1


def test_keys_can_be_changed_and_put_back(text_house: House, visit: Visit) -> None:
    ann = visit(text_house.link("ann"))
    ann.question()
    ann.test("settings").click()
    ann.test("key-first").click()
    ann.page.keyboard.press("x")
    expect(ann.page.locator(".key-note")).to_contain_text("taken by: Can’t compare")
    ann.test("key-first").click()
    ann.page.keyboard.press("q")
    ann.page.keyboard.press("Escape")
    expect(ann.test("choose-first").locator("kbd")).to_have_text("Q")
    id = ann.question()
    query, turned = text_house.query_of(id), text_house.slot_of(text_house.query_of(id), ann.shown()) == [1, 0]
    ann.page.keyboard.press("1")
    assert settle(ann) == id
    ann.press("q")
    ann.saved()
    wanted = 1 - FIRST["clear"] if turned else FIRST["clear"]
    assert text_house.preference(query) == pytest.approx(wanted)
    ann.test("settings").click()
    ann.test("reset-keys").click()
    ann.page.keyboard.press("Escape")
    ann.press("1")


def test_help_names_every_key_and_keys_wait_until_it_is_closed(text_house: House, visit: Visit) -> None:
    ann = visit(text_house.link("ann"))
    id = ann.question()
    ann.page.keyboard.press("?")
    expect(ann.test("help-dialog").locator("dt")).to_have_count(24)
    ann.page.keyboard.press("1")
    ann.page.keyboard.press("Escape")
    assert settle(ann) == id


def test_all_can_be_done_by_tab_and_enter(text_house: House, visit: Visit) -> None:
    ann = visit(text_house.link("ann"))
    id = ann.question()
    for _ in range(40):
        ann.page.keyboard.press("Tab")
        if ann.page.evaluate("document.activeElement.dataset.testid") == "tie":
            break
    outline = "getComputedStyle(document.activeElement).outlineStyle"
    assert ann.page.evaluate(outline) != "none"
    ann.page.keyboard.press("Enter")
    ann.gone(id)
    ann.saved()
    assert text_house.preference(text_house.query_of(id)) == 0.5
