"""A browser for the tests of the page, and pages to look at in it."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from browser.child import Child, Start
from browser.house import House, Open, clips, copy, fill, serving, texts
from browser.visitor import Visit, Visitor, enter
from playwright.sync_api import Browser, expect, sync_playwright

from prefrl.page.clips.queue import Clips, ClipSettings

PLACES = ("/usr/bin/chromium", "/usr/bin/chromium-browser")
FLAGS = (
    "--no-sandbox",
    "--disable-gpu",
    "--disable-background-networking",
    "--no-first-run",
    "--autoplay-policy=no-user-gesture-required",
    "--host-resolver-rules=MAP labeler.test 127.0.0.1",
)


@pytest.fixture(scope="package")
def chromium() -> Iterator[Browser]:
    """Debian's Chromium: the one that Playwright brings plays no H.264."""
    place = next((path for path in (*PLACES, shutil.which("chromium")) if path and Path(path).exists()), None)
    if place is None:
        pytest.skip("needs Chromium: apt-get install -y chromium")
    with sync_playwright() as playwright:
        expect.set_options(timeout=20_000)  # on a machine that does other things too
        browser = playwright.chromium.launch(executable_path=place, args=list(FLAGS))
        yield browser
        browser.close()


@pytest.fixture
def visit(chromium: Browser, open_house: Open) -> Iterator[Visit]:
    """Open a link in a browser of one's own: `visit(link)`. In the end each is asked what went wrong.

    Houses are closed after the browsers, whichever a test names first: a page asks its server again and again.
    """
    visitors: list[Visitor] = []

    def come(link: str, **options: Any) -> Visitor:
        visitors.append(enter(chromium, link, **options))
        return visitors[-1]

    yield come
    for one in visitors:
        one.context.close()
    for one in visitors:
        one.check()


@pytest.fixture
def open_house(tmp_path: Path) -> Iterator[Open]:
    """Serve a folder's store: `open_house(folder, **settings)`; all are closed in the end."""
    with ExitStack() as stack:
        yield lambda folder, **settings: stack.enter_context(serving(folder, **settings))


@pytest.fixture
def text_house(tmp_path: Path, open_house: Open) -> House:
    """A page with 24 pairs of short texts."""
    return open_house(fill(tmp_path / "texts", texts(24)))


@pytest.fixture
def clip_house(tmp_path: Path, drawn: Path, open_house: Open) -> House:
    """A page with 22 pairs of clips."""
    return open_house(copy(drawn, tmp_path / "clips"), kind="control")


@pytest.fixture(scope="package")
def drawn(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with 22 pairs of clips that are drawn already."""
    queries = clips(22)
    folder = fill(tmp_path_factory.mktemp("drawn") / "clips", queries)
    made = Clips(folder, ClipSettings())
    made.start()
    ids = [candidate.id for query in queries for candidate in query.candidates]
    thread = threading.Thread(target=_draw, args=(made, ids))
    thread.start()
    thread.join()
    made.close()
    return folder


def _draw(made: Clips, ids: list[str]) -> None:
    """In a thread of its own: Playwright has an event loop in the main one."""
    import asyncio

    for id in ids:
        asyncio.run(made.get(made.names(id)[0].removeprefix("/media/"), 90.0))


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Start]:
    """Start a command; what still runs in the end is killed."""
    children: list[Child] = []

    def begin(*command: str) -> Child:
        children.append(Child(*command, log=tmp_path / f"log-{len(children)}"))
        return children[-1]

    yield begin
    for child in children:
        child.kill()
