"""The whole of it: a run goes on while somebody reads, judges and answers in a browser, and its policy gets better."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from browser.child import Child, free_port
from browser.visitor import LOST, QUESTION, Visit, Visitor
from playwright.sync_api import Browser
from vaderSentiment.vaderSentiment import SentimentIntensityAnalyzer

pytestmark = pytest.mark.browser

LABELS = 90


@pytest.fixture
def running(tmp_path: Path) -> Any:
    """The command that a person would type, for fewer labels."""
    settings = ["labeler.kind=web", f"labeler.port={free_port()}", "labeler.enough=0.9", "labeler.strength=false"]
    settings.append('labeler.guideline=""')
    size = ["loop.rounds=2", f"loop.labels={LABELS}", "learner.evaluation_prompts=128"]
    child = Child("run", "text/reviews", *settings, *size, "--out", str(tmp_path / "run"), log=tmp_path / "log")
    yield child
    child.process.kill()
    child.process.wait()


def label(visitor: Visitor, child: Child) -> None:
    """Prefer what sounds happier, by the words on the page alone, for as long as the run goes on."""
    mood = SentimentIntensityAnalyzer()
    while child.process.poll() is None:
        if visitor.page.locator(QUESTION).count() == 0:
            visitor.page.wait_for_timeout(100)
            continue
        first, second = (mood.polarity_scores(text)["compound"] for text in visitor.shown())
        visitor.press("0" if first == second else "1" if first > second else "2")


def test_a_policy_improves_while_somebody_labels(
    running: Child, chromium: Browser, visit: Visit, tmp_path: Path
) -> None:
    with chromium.new_context() as context:
        link = running.link(context.new_page())
    me = visit(link)
    me.allowed.append(LOST)  # the server ends with its run
    label(me, running)
    assert running.process.returncode == 0, running.log.read_text()
    summary = json.loads((tmp_path / "run" / "summary.json").read_text())
    assert summary["labels"]["answered"] >= 0.9 * LABELS
    assert summary["gold_before"] < 0.2
    assert summary["gold_after"] > summary["gold_before"] + 0.3
