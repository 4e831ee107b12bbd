"""Somebody at the page: a browser window of their own, what it asked for, and what went wrong in it."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, TypeAlias
from urllib.parse import urlsplit

from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Page, expect

QUESTION = "[data-testid=question][data-ready=true]:not([data-chosen])"
LOST = "net::ERR_"
"""What the browser writes down about requests that no server answers."""


@dataclass
class Visitor:
    """One person's browser; all its windows share cookies and storage."""

    context: BrowserContext
    page: Page
    origin: str
    allowed: list[str] = field(default_factory=list)
    """Beginnings or parts of console errors that the test brings about itself."""
    requests: list[str] = field(default_factory=list)
    troubles: list[str] = field(default_factory=list)
    others: list[str] = field(default_factory=list)
    """Origins of other projects that this person works at."""
    held_back: int = 0
    """How often the page asked whether it may really be left."""

    def watch(self) -> None:
        """Take note of all that this browser does from now on."""
        self.context.on("request", lambda request: self.requests.append(request.url))
        self.context.on("console", self._heard)
        self.context.on("weberror", lambda error: self.troubles.append(f"uncaught: {error.error}"))
        self.context.on("dialog", lambda dialog: self._asked(dialog))

    def check(self) -> None:
        """Fail where anything went to another host, or wrong."""
        foreign = [url for url in self.requests if not url.startswith(("data:", "blob:")) and not self._own(url)]
        assert not foreign, f"requests to other hosts: {foreign[:3]}"
        wrong = [one for one in self.troubles if not any(part in one for part in self.allowed)]
        assert not wrong, f"the page complained: {wrong[:3]}"

    def window(self, link: str) -> Visitor:
        """One more tab, at this project or another one. What happens in it counts as this one's."""
        other = replace(self, page=self.context.new_page())
        self.others.append(origin_of(link))
        other.page.goto(link)
        return other

    def shows_frames(self, *numbers: int) -> None:
        """Wait until the clips show these frames."""
        slots = self.page.locator(".slot .clip")
        for slot, number in enumerate(numbers):
            expect(slots.nth(slot)).to_have_attribute("data-frame", str(number))

    def press_and_refill(self, key: str) -> None:
        """Answer, and wait until the answer is saved and the page has fetched as many questions as it keeps."""
        with self.page.expect_response("**/api/assignments") as answer:
            self.press(key)
        answer.value.finished()
        self.saved()

    # --- answering -----------------------------------------------------------------------------------------------

    def question(self) -> str:
        """Wait until a question can be answered; its assignment's id."""
        found = self.page.wait_for_selector(QUESTION)
        assert found is not None
        return str(found.get_attribute("data-id"))

    def shown(self) -> list[str]:
        """What stands in the slots: texts, or the addresses of clips."""
        return [str(text) for text in self.page.evaluate(SHOWN)]

    def press(self, key: str) -> str:
        """Answer with a key; the assignment that was answered."""
        id = self.question()
        self.page.keyboard.press(key)
        self.gone(id)
        return id

    def question_is(self, id: str) -> None:
        """Wait until this very question can be answered."""
        self.page.wait_for_selector(f"{QUESTION}[data-id='{id}']")

    def gone(self, id: str) -> None:
        """Wait until this question cannot be answered any more."""
        self.page.wait_for_selector(f"[data-testid=question][data-id='{id}']:not([data-chosen])", state="detached")

    def situation(self, name: str) -> None:
        """Wait for the page that says why there is no question."""
        self.page.wait_for_selector(f"[data-testid=message][data-situation='{name}']")

    def saved(self) -> None:
        """Wait until the page says that everything is saved."""
        expect(self.test("save-state")).to_have_attribute("data-state", "saved")

    def test(self, id: str) -> Any:
        return self.page.get_by_test_id(id)

    def go(self, path: str) -> None:
        """Follow one of the page's own links."""
        self.page.locator(f"nav a[data-path='{path}']").click()

    def _heard(self, message: ConsoleMessage) -> None:
        if message.type == "error":
            self.troubles.append(f"console: {message.text} ({message.location.get('url', '')})")

    def _asked(self, dialog: Any) -> None:
        if dialog.type == "beforeunload":
            self.held_back += 1
        else:
            self.troubles.append(f"dialog: {dialog.message}")
        dialog.accept()

    def _own(self, url: str) -> bool:
        parts = urlsplit(url)
        return f"{parts.scheme}://{parts.netloc}" in (self.origin, *self.others)


def origin_of(link: str) -> str:
    match = re.match(r"https?://[^/]+", link)
    assert match, link
    return match[0]


Visit: TypeAlias = Callable[..., Visitor]
"""`visit(link, **options of the browser)`."""
SHOWN = """() => [...document.querySelectorAll("[data-testid=question] .slot")].map((slot) => {
  const source = slot.querySelector("video source, .clip img");
  return source ? source.getAttribute("src") : slot.querySelector(".text-body")?.textContent ?? "";
})"""


def enter(browser: Browser, link: str, wait: bool = True, **options: Any) -> Visitor:
    """Open a link in a new browser window, and wait until the page knows who it is."""
    options = {"viewport": {"width": 1280, "height": 800}, "locale": "en-GB"} | options
    context = browser.new_context(**options)
    context.set_default_timeout(30_000)
    visitor = Visitor(context, context.new_page(), origin_of(link))
    visitor.watch()
    visitor.page.goto(link)
    if wait:
        visitor.page.wait_for_selector("nav a[aria-current=page]")
    return visitor
