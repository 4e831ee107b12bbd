"""Rankings: by dragging, by buttons and by keys the same order comes out."""

from __future__ import annotations

from pathlib import Path

import pytest
from browser.house import House, Open, fill, texts
from browser.visitor import Visit, Visitor
from playwright.sync_api import expect

from prefrl.judgements import Ranking

pytestmark = pytest.mark.browser


@pytest.fixture
def house(tmp_path: Path, open_house: Open) -> House:
    """A page with four responses to each prompt."""
    return open_house(fill(tmp_path / "texts", texts(4, size=4)))


def order(visitor: Visitor) -> list[int]:
    """The slots, best first."""
    rows = visitor.page.locator("[data-testid=rank-list] li").all()
    return [int(row.get_attribute("data-slot") or "") for row in rows]


def ranked(house: House, visitor: Visitor) -> tuple[int, ...]:
    """Send the order; the ranks that the store has then, slot by slot."""
    id, shown = visitor.question(), visitor.shown()
    visitor.test("submit-ranking").click()
    visitor.gone(id)
    visitor.saved()
    query = house.query_of(id)
    answer = house.answers()[query]
    assert isinstance(answer, Ranking)
    return tuple(answer.ranks[candidate] for candidate in house.slot_of(query, shown))


def drag(visitor: Visitor, slot: int, onto: int) -> None:
    """Take a row by the mouse to where another one is."""
    start, end = (visitor.test(f"rank-row-{one}").locator(".rank-name").bounding_box() for one in (slot, onto))
    assert start
    assert end
    mouse, below = visitor.page.mouse, end["y"] > start["y"]
    mouse.move(start["x"] + 20, start["y"] + start["height"] / 2)
    mouse.down()
    mouse.move(end["x"] + 20, end["y"] + end["height"] * (0.2 if not below else 0.8), steps=12)
    mouse.up()


def test_dragging_buttons_and_keys_give_the_same_order(house: House, visit: Visit) -> None:
    ann = visit(house.link("ann"), reduced_motion="reduce")  # rows are where they will be, as soon as they are let go
    ann.question()
    ann.test("rank-list").scroll_into_view_if_needed()
    drag(ann, 3, onto=0)
    assert order(ann) == [3, 0, 1, 2]
    drag(ann, 0, onto=2)
    assert order(ann) == [3, 1, 2, 0]
    dragged = ranked(house, ann)
    ann.question()
    for button in ("rank-up-3", "rank-up-3", "rank-up-3", "rank-down-0", "rank-down-0"):
        ann.test(button).click()
    buttons = ranked(house, ann)
    ann.question()
    for key in ("4", "ArrowUp", "ArrowUp", "ArrowUp", "1", "ArrowDown", "ArrowDown"):
        ann.page.keyboard.press(key)
    assert order(ann) == [3, 1, 2, 0]
    keys = ranked(house, ann)
    assert dragged == buttons == keys == (3, 1, 2, 0)
    assert all(one["touched"] for one in house.about())


def test_ties_are_kept(house: House, visit: Visit) -> None:
    ann = visit(house.link("ann"))
    ann.question()
    for key in ("3", "ArrowUp", "ArrowUp", "2", "t"):
        ann.page.keyboard.press(key)
    assert order(ann) == [2, 0, 1, 3]
    assert ranked(house, ann) == (1, 1, 0, 2)


def test_an_order_that_nobody_touched_is_asked_about_first(house: House, visit: Visit) -> None:
    ann = visit(house.link("ann"))
    id = ann.question()
    ann.page.keyboard.press("Enter")
    expect(ann.page.locator(".rank-warning")).to_be_visible()
    assert ann.question() == id
    assert ranked(house, ann) == (0, 1, 2, 3)
    assert house.about()[0]["touched"] is False


def test_a_ranking_that_is_taken_back_stands_as_it_was(house: House, visit: Visit) -> None:
    ann = visit(house.link("ann"))
    id = ann.question()
    for key in ("4", "ArrowUp", "ArrowUp"):
        ann.page.keyboard.press(key)
    ann.press("Enter")
    ann.page.keyboard.press("z")
    ann.question_is(id)
    assert order(ann) == [0, 3, 1, 2]


def test_a_finger_moves_a_number_by_its_grip(house: House, visit: Visit) -> None:
    ann = visit(house.link("ann"), viewport={"width": 360, "height": 740}, has_touch=True, is_mobile=True)
    ann.question()
    session = ann.context.new_cdp_session(ann.page)
    boxes = [ann.test(f"rank-row-{one}").locator(".rank-grip").bounding_box() for one in (3, 2)]
    assert boxes[0]
    assert boxes[1]
    (x, y), end = (boxes[0]["x"] + 8, boxes[0]["y"] + boxes[0]["height"] / 2), boxes[1]["x"]
    for kind, at in (("touchStart", x), ("touchMove", x - 10), ("touchMove", end - 8), ("touchEnd", None)):
        points = [] if at is None else [{"x": at, "y": y}]
        session.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
    assert order(ann) == [0, 1, 3, 2]


def test_on_a_phone_a_number_is_tapped_and_moved_by_the_buttons_below(house: House, visit: Visit) -> None:
    ann = visit(house.link("ann"), viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True)
    ann.question()
    ann.test("rank-row-3").tap()
    expect(ann.test("response-3")).to_be_in_viewport()
    for button in ("rank-up-3", "rank-up-3", "rank-equal-3"):
        ann.test(button).tap()
    assert order(ann) == [0, 3, 1, 2]
    assert ranked(house, ann) == (0, 1, 2, 0)
