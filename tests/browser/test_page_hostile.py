"""Text from models, people and settings is shown, never run."""

from __future__ import annotations

from pathlib import Path

import pytest
from browser.house import House, Open, fill, said
from browser.visitor import Visit, Visitor
from playwright.sync_api import CDPSession, expect

pytestmark = pytest.mark.browser

CORPUS = (
    "<script>window.xss = 1; alert(1)</script>",
    "</script><script src=http://evil.test/x.js></script>",
    "<img src=x onerror='window.xss = 1; alert(1)'>",
    "<img src=http://evil.test/pixel.png>",
    "<svg onload=\"window.xss = 1\"><animate onbegin='window.xss = 1'></svg>",
    "<iframe srcdoc='<script>parent.xss = 1</script>'></iframe>",
    "<a href='javascript:window.xss = 1'>click</a> javascript:window.xss=1",
    "[click](javascript:window.xss=1) ![x](http://evil.test/x.png) [y](data:text/html,<script>window.xss=1</script>)",
    "<style>@import 'http://evil.test/x.css'; * { display: none }</style>",
    "<base href=http://evil.test/><form action=http://evil.test/><button>go</button></form>",
    "`${window.xss = 1}` {{constructor.constructor('window.xss=1')()}} {{7*7}} {% raw %} <%= 1 %>",
    "&lt;b&gt; &amp; &#x3c;script&#x3e; &nbsp; %3Cscript%3E",
    "\u202etfel ot thgir\u202c \u2066isolate\u2069 \u200bzero\u200dwidth\ufeff \u0000nul",
    "Z\u0351\u036b\u0343\u036a\u0302\u036b\u033d\u034f\u0334\u0319\u0324a\u030d\u0328\u0310l\u0341\u0342g\u0489o" * 20,
    "'\"><input autofocus onfocus=window.xss=1> ' OR 1=1 -- =cmd|' /C calc'!A0",
)
NAMES = ("<img src=x onerror=window.xss=1>", "'\"><svg onload=window.xss=1>", "{{7*7}}`${window.xss=1}`")
MEGABYTES = 10


def untouched(visitor: Visitor) -> None:
    """Nothing of a text has run, or become a part of the page."""
    page = visitor.page
    assert page.evaluate("window.xss === undefined")
    strange = "script:not([src^='/static/']), iframe, img, base, form[action], style, [onerror], a[href^='java']"
    assert page.locator(strange).count() == 0
    assert page.evaluate("getComputedStyle(document.body).display") != "none"


def test_a_hostile_corpus_stays_text_wherever_it_is_shown(tmp_path: Path, open_house: Open, visit: Visit) -> None:
    queries = [said(text, f"1 {text}", f"2 {text}") for text in CORPUS]
    house = open_house(
        fill(tmp_path / "texts", queries), markdown=True, guideline="\n\n".join(CORPUS), question=CORPUS[0]
    )
    ann = visit(house.link(NAMES[0]))
    ann.test("guideline-read").click()
    ann.question()
    untouched(ann)
    ann.test("toggle-written").click()
    for number in range(len(CORPUS)):
        query = house.query_of(ann.question())
        shown = ann.shown()
        wanted = sorted(one.text for one in house.store.query(query).candidates)
        assert sorted(shown) == wanted
        untouched(ann)
        _every_view(ann)
        _comment(ann, CORPUS[number])
        ann.press("1")
    ann.situation("done")
    ann.saved()
    wanted = sorted(one.replace("\0", "").strip() for one in CORPUS)
    assert sorted(one["comment"] for one in house.about(NAMES[0])) == wanted
    ann.go("/history")
    for summary in ann.page.locator("[data-testid=entry] summary").all()[:4]:
        summary.click()
    expect(ann.page.locator(".entry-comment")).to_have_count(len(CORPUS))
    untouched(ann)
    ann.go("/guide")
    expect(ann.test("guideline-text")).to_contain_text("<script>window.xss")
    untouched(ann)


def _every_view(ann: Visitor) -> None:
    """Drawn as Markdown and turns, differences and invisible characters, on and off."""
    for one in ("toggle-written", "toggle-diff", "toggle-invisible"):
        ann.test(one).click()
        untouched(ann)
        ann.test(one).click()


def _comment(ann: Visitor, text: str) -> None:
    ann.page.keyboard.press("c")
    ann.test("comment-text").fill(text)
    ann.test("comment-keep").click()


def test_admins_see_hostile_names_reports_and_guidelines_as_text(text_house: House, visit: Visit) -> None:
    ann = visit(text_house.link(NAMES[1]))
    ann.question()
    for text in CORPUS:
        ann.test("report").click()
        ann.test("report-text").fill(text)
        ann.test("report-send").click()
    ann.saved()
    me = visit(text_house.admin)
    me.go("/admin")
    expect(me.test("flags").locator("li")).to_have_count(len(CORPUS))
    for name in (NAMES[0], NAMES[2]):
        me.test("invite-name").fill(name)
        me.test("invite").click()
        expect(me.page.locator("dialog")).to_contain_text(name)
        me.page.keyboard.press("Escape")
    expect(me.test("annotators")).to_contain_text(NAMES[1])
    me.test("guideline-edit").fill("\n\n".join(CORPUS).replace("\0", ""))
    me.test("save-guideline").click()
    expect(ann.test("guideline-dialog")).to_contain_text("<script>window.xss")
    untouched(ann)
    untouched(me)
    me.page.reload()
    expect(me.test("annotators")).to_contain_text(NAMES[2])
    untouched(me)


def test_a_line_of_ten_megabytes_leaves_the_page_responsive(tmp_path: Path, open_house: Open, visit: Visit) -> None:
    long = "long line without an end " * (MEGABYTES * 40_000)
    assert len(long) == MEGABYTES * 10**6
    queries = [said("One", long, "short"), said("Two", "a", "b"), said("Three", long[1:], long[2:])]
    ann = visit(open_house(fill(tmp_path / "texts", queries)).link("ann"))
    for _ in range(3):
        ann.page.wait_for_selector("[data-testid=question][data-ready=true]", timeout=30_000)
        for one in ("toggle-diff", "toggle-invisible", "toggle-stacked"):
            assert _seconds(ann, one) < 2
            assert _seconds(ann, one) < 2
        ann.press("1")
    ann.situation("done")
    ann.saved()


def _seconds(ann: Visitor, toggle: str) -> float:
    """That the page keeps its thread busy from a press of a button to the next two frames on the screen.

    Seconds of a processor, which do not hang on what else runs here.
    """
    session = ann.context.new_cdp_session(ann.page)
    session.send("Performance.enable", {"timeDomain": "threadTicks"})
    begun = _worked(session)
    ann.test(toggle).click()
    ann.page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    return _worked(session) - begun


def _worked(session: CDPSession) -> float:
    found = {one["name"]: one["value"] for one in session.send("Performance.getMetrics")["metrics"]}
    return float(found["TaskDuration"])
