"""For everybody: screen readers, small screens, dark rooms, and names that are no secure context."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from axe_playwright_python.sync_playwright import Axe
from browser.house import House, Open, fill, said, segment, serving, texts
from browser.visitor import Visit, Visitor

from prefrl.types import Query

pytestmark = pytest.mark.browser

SERIOUS = ("serious", "critical")
VIEWS = ("/label", "/history", "/guide", "/admin")
PHONE = {"viewport": {"width": 360, "height": 740}, "has_touch": True, "is_mobile": True}
LONG = "AVeryLongWordThatNobodyBreaks" * 12


def faults(visitor: Visitor) -> list[str]:
    """What axe finds that keeps people out, each with the element it is about."""
    found = Axe().run(visitor.page).response["violations"]
    return [f"{one['id']}: {one['nodes'][0]['html'][:120]}" for one in found if one["impact"] in SERIOUS]


def views(visitor: Visitor) -> Iterator[str]:
    """Go through all views; returns their names as each is there."""
    for path in VIEWS:
        visitor.go(path)
        there = "[data-testid=question][data-ready=true]" if path == "/label" else f"main{path.replace('/', '.')} h1"
        visitor.page.wait_for_selector(there)
        yield path


def too_wide(visitor: Visitor) -> int:
    """By how many pixels the page is wider than its window."""
    return int(visitor.page.evaluate("document.documentElement.scrollWidth - innerWidth"))


def busy(house: House, visitor: Visitor) -> None:
    """Give the views something to show."""
    visitor.go("/label")
    for key in ("1", "2", "x"):
        visitor.press(key)
    visitor.saved()


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("house", ["text_house", "clip_house"])
def test_no_view_keeps_anybody_out(house: str, scheme: str, visit: Visit, request: pytest.FixtureRequest) -> None:
    served: House = request.getfixturevalue(house)
    me = visit(served.admin, color_scheme=scheme, reduced_motion="reduce")
    busy(served, me)
    assert {path: faults(me) for path in views(me)} == {path: [] for path in VIEWS}


def test_dialogs_rankings_and_the_welcome_keep_nobody_out(tmp_path: Path, open_house: Open, visit: Visit) -> None:
    house = open_house(fill(tmp_path / "texts", texts(3, size=4)), guideline="# Look\n\nTwice.")
    ann = visit(house.link("ann"), reduced_motion="reduce")
    ann.page.wait_for_selector("[data-testid=guideline-dialog]")
    assert faults(ann) == []
    ann.test("guideline-read").click()
    ann.question()
    assert faults(ann) == []
    for button, dialog in (("help", "help-dialog"), ("settings", "settings-dialog"), ("report", "report-dialog")):
        ann.test(button).click()
        ann.page.wait_for_selector(f"[data-testid={dialog}]")
        assert faults(ann) == [], dialog
        ann.page.keyboard.press("Escape")
    nobody = visit(house.site.address, wait=False, reduced_motion="reduce")
    nobody.allowed.append("401")
    nobody.page.wait_for_selector("[data-testid=welcome]")
    assert faults(nobody) == []


@pytest.mark.parametrize("house", ["text_house", "clip_house"])
def test_no_view_is_wider_than_a_phone(house: str, visit: Visit, request: pytest.FixtureRequest) -> None:
    served: House = request.getfixturevalue(house)
    me = visit(served.admin, **PHONE)
    busy(served, me)
    assert {path: too_wide(me) for path in views(me)} == dict.fromkeys(VIEWS, 0)


def test_long_words_and_rankings_fit_on_a_phone(tmp_path: Path, open_house: Open, visit: Visit) -> None:
    queries = [said(LONG, f"1{LONG}", f"2{LONG}"), said("b", LONG, "1", "2", "3")]
    house = open_house(fill(tmp_path / "texts", queries), guideline=LONG, question=LONG)
    ann = visit(house.link("ann" * 20), **PHONE)
    ann.test("guideline-read").click()
    for _ in queries:
        id = ann.question()
        assert too_wide(ann) == 0
        ann.test("skip").tap()
        ann.gone(id)
    ann.situation("done")
    ann.saved()
    ann.go("/history")
    ann.page.wait_for_selector("[data-testid=entry]")
    assert too_wide(ann) == 0


def test_fingers_find_buttons_of_44_pixels(text_house: House, visit: Visit) -> None:
    ann = visit(text_house.link("ann"), **PHONE)
    id = ann.question()
    for button in ("choose-first", "choose-second", "tie", "incomparable", "skip", "undo"):
        box = ann.test(button).bounding_box()
        assert min(box["width"], box["height"]) >= 44, button
    ann.test("choose-second").tap()
    ann.gone(id)
    ann.saved()
    assert [one["input"] for one in text_house.about()] == ["touch"]


def test_a_name_without_a_secure_context_is_enough(tmp_path: Path, visit: Visit) -> None:
    folder = fill(tmp_path / "texts", texts(3))
    with serving(folder, allowed_hosts=("labeler.test",)) as house:
        ann = visit(house.link("ann").replace("127.0.0.1", "labeler.test"))
        ann.allowed.append("Cross-Origin-Opener-Policy header has been ignored")  # for want of a certificate
        assert ann.page.evaluate("[isSecureContext, typeof crypto.randomUUID]") == [False, "undefined"]
        for key in ("1", "s", "0"):
            ann.press(key)
        ann.situation("done")
        ann.saved()
        assert house.spoken() == 3


FIRST_SCREEN = """(controls) => {
  const height = (box) => Math.max(0, Math.min(box.bottom, innerHeight) - Math.max(box.top, 0));
  const seen = (id) => {
    const node = document.querySelector(`[data-testid=${id}]`), box = node.getBoundingClientRect();
    const top = document.elementFromPoint(box.left + box.width / 2, box.top + box.height / 2);
    return height(box) === box.height && node.contains(top);
  };
  const share = height(document.querySelector(".stage").getBoundingClientRect()) / innerHeight;
  const scrolls = document.documentElement.scrollHeight - innerHeight;
  return {share, hidden: controls.filter((id) => !seen(id)), scrolls};
}"""
"""The share of the window that is for what is judged, and which controls cannot be tapped as they stand."""
AS_IT_COMES_IN = """() => {
  document.querySelector("[data-testid=question]").style.setProperty("animation", "appear 9s paused", "important");
  return document.documentElement.scrollHeight - innerHeight;
}"""
"""By how much the page scrolls in the first moment of a question."""
UPRIGHT = PHONE | {"viewport": {"width": 390, "height": 844}, "reduced_motion": "reduce"}
PAIR = ["choose-first", "choose-first-much", "tie", "choose-second-slight", "incomparable", "skip", "undo"]
ORDER = ["rank-row-0", "rank-row-3", "submit-ranking", "incomparable", "skip", "undo"]
STORY = "Once upon a time there was a lighthouse in a storm. " * 40


@pytest.mark.parametrize("kind", ["text", "control"])
@pytest.mark.parametrize(("size", "controls"), [(2, PAIR), (4, ORDER)])
def test_a_phone_shows_what_is_judged_on_half_of_it_and_all_answers_at_once(
    kind: str, size: int, controls: list[str], tmp_path: Path, open_house: Open, visit: Visit
) -> None:
    some = [f"{k} {STORY}" for k in range(size)]
    queries = [said(STORY, *some)] if kind == "text" else [Query(tuple(segment(k, False) for k in range(size)))]
    house = open_house(fill(tmp_path / "asked", queries), kind=kind, question="Which one is kept upright better?")
    ann = visit(house.link("ann"), **UPRIGHT)
    ann.allowed.append("500")  # these clips cannot be drawn
    ann.page.wait_for_selector("[data-testid=question]")
    found = ann.page.evaluate(FIRST_SCREEN, controls)
    assert found["share"] >= 0.5
    assert (found["hidden"], found["scrolls"]) == ([], 0)
    assert ann.page.evaluate(AS_IT_COMES_IN) == 0
