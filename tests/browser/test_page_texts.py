"""Markdown and conversations are drawn; what was written is a key away; plain text is left alone."""

from __future__ import annotations

from pathlib import Path

import pytest
from browser.house import House, Open, fill, said
from browser.visitor import Visit
from playwright.sync_api import expect

from prefrl.exchange.transcripts import parse_transcript

pytestmark = pytest.mark.browser

CHAT = "System: Be short.\n\nHuman: Read a *file*?\n\nAssistant: With `open`.\n\nHuman: And <b>then</b>?\n\nAssistant: "
LONG = "x = 1  # " + "a comment without an end " * 40
TABLE = "| way | cost |\n|---|--:|\n| `a` | 1 |"
CODE = f"Do **this**:\n\n```python\nfor line in file:\n    {LONG}\n```\n\n{TABLE}\n\n- one\n- two"
LINKS = "See [here](http://evil.test/) and ![x](http://evil.test/x.png)\n\n<img src=http://evil.test/x.png> ~~no~~"
PLAIN = "Two  spaces,\n\n\n  an indent, 2 * 3 * 4, snake_case_name and <b>markup</b>: as it was."
PHONE = {"viewport": {"width": 390, "height": 844}, "has_touch": True, "is_mobile": True}


@pytest.fixture
def house(tmp_path: Path, open_house: Open) -> House:
    return open_house(fill(tmp_path / "texts", [said(CHAT, CODE, LINKS)]))


def panel(text: str) -> str:
    """The response that holds this, wherever it stands."""
    return f".response:has-text('{text}')"


def test_conversations_and_markdown_are_drawn_and_a_key_shows_what_was_written(house: House, visit: Visit) -> None:
    ann = visit(house.link("ann"))
    ann.question()
    page = ann.page
    assert page.locator(".prompt .turn-speaker").all_text_contents() == ["System", "Human", "Assistant", "Human"]
    expect(page.locator(".prompt .turn-text").last).to_have_text("And <b>then</b>?")
    code, links = page.locator(panel("Do this")), page.locator(panel("evil.test"))
    expect(code.locator("pre")).to_contain_text("for line in file:\n    x = 1")
    expect(code.locator(".code-name")).to_have_text("python")
    assert code.locator("td").all_text_contents() == ["a", "1"]
    assert code.locator("li").all_text_contents() == ["one", "two"]
    assert links.locator("a, img").count() == 0
    expect(links.locator(".address code").first).to_have_text("http://evil.test/")
    page.keyboard.press("w")
    expect(ann.test("toggle-written")).to_have_attribute("aria-pressed", "true")
    assert sorted(ann.shown()) == sorted([CODE, LINKS])
    expect(page.locator(".prompt .text-body")).to_have_text(CHAT, use_inner_text=False)
    ann.test("toggle-written").click()
    expect(page.locator(".prompt .turn")).to_have_count(4)


def test_plain_text_and_a_project_without_drawing_show_every_character(
    house: House, tmp_path: Path, open_house: Open, visit: Visit
) -> None:
    plain = open_house(fill(tmp_path / "plain", [said(PLAIN, f"1 {PLAIN}", f"2 {PLAIN}")]))
    ann = visit(plain.link("ann"))
    ann.question()
    assert sorted(ann.shown()) == [f"1 {PLAIN}", f"2 {PLAIN}"]
    assert ann.page.locator(".rendered").count() == 0
    undrawn = open_house(fill(tmp_path / "undrawn", [said(CHAT, CODE, LINKS)]), markdown=False)
    ben = visit(undrawn.link("ben"))
    ben.question()
    assert sorted(ben.shown()) == sorted([CODE, LINKS])
    assert ben.test("toggle-written").count() == 0


def test_wide_code_scrolls_in_its_own_block_and_keeps_its_arrows_when_it_was_tabbed_to(
    house: House, visit: Visit
) -> None:
    ann = visit(house.link("ann"), **PHONE)
    id = ann.question()
    block = ann.page.locator("pre.wide")
    assert block.evaluate("node => node.scrollWidth > node.clientWidth")
    assert ann.page.evaluate("document.documentElement.scrollWidth - innerWidth") == 0
    ann.page.keyboard.press("Tab")
    block.focus()
    ann.page.keyboard.press("ArrowRight")
    ann.question_is(id)
    block.tap()
    ann.page.keyboard.press("ArrowRight")
    ann.gone(id)
    ann.saved()


HIDING = "```\ncode\n``` hidden\nmore\n```\nafter\n\n1. a\n   - b\n2. c\n9. d"
RUNS_ON = "I can.\n\nHuman: And you?\n\nAssistant:"
CUT = "Human: Can you read?\n\nAssistant: Yes.\n\nHuman:"


def test_nothing_hides_behind_a_fence_and_numbers_and_turns_are_those_that_were_written(
    tmp_path: Path, open_house: Open, visit: Visit
) -> None:
    ann = visit(open_house(fill(tmp_path / "odd", [said(CHAT, HIDING, RUNS_ON), said(CUT, "a", "b")])).link("ann"))
    ann.question()
    hiding, runs_on = ann.page.locator(panel("hidden")), ann.page.locator(panel("I can."))
    expect(hiding.locator("pre")).to_have_text("code\n``` hidden\nmore")
    items = hiding.locator("li").evaluate_all("all => all.map(one => [one.textContent, one.getAttribute('value')])")
    assert items == [["a", "1"], ["b", None], ["c", "2"], ["d", "9"]]
    assert runs_on.locator(".turn-speaker").all_text_contents() == ["Assistant", "Human", "Assistant"]
    ann.press("1")
    expect(ann.page.locator(".prompt .turn-text").first).to_have_text("Can you read?")
    assert ann.page.locator(".prompt .turn-speaker").all_text_contents() == ["Human", "Assistant", "Human"]


TRANSCRIPTS = (
    CHAT,
    "Human: a",
    "\n\nHuman: a\n\nAssistant: b\n\nHuman:",
    "Human:a\n\nAssistant: b",
    "Human: a\nAssistant: b",
    "He said\n\nHuman: a",
    "System:\n\nHuman: a \U0001f600\n\n\n\nAssistant: b\n",
    "",
)


def test_turns_are_those_that_a_policy_is_prompted_with(house: House, visit: Visit) -> None:
    ann = visit(house.link("ann"))
    found = ann.page.evaluate(
        "async (texts) => { const {turns} = await import('/static/turns.js'); return texts.map(turns); }",
        list(TRANSCRIPTS),
    )
    roles = {"System": "system", "Human": "user", "Assistant": "assistant"}
    told = [one and [{"role": roles[t["speaker"]], "content": t["content"]} for t in one] for one in found]
    assert told == [parse_transcript(text) for text in TRANSCRIPTS]
