"""The first clips are there before anybody is told where to look; a renderer that fails or hangs holds nothing up."""

from __future__ import annotations

import io
import json
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
import pytest
from clip_server import FAKE, attempts
from rich.console import Console

from prefrl.envs.toys import PointSettings
from prefrl.label.web import WebLabeler, WebSettings
from prefrl.page import site
from prefrl.page.clips.queue import Clips, ClipSettings
from prefrl.page.questions import Past
from prefrl.store import Store
from prefrl.types import Query, Segment

Begin: TypeAlias = Callable[..., WebLabeler]


@pytest.fixture
def begin(store: Store[Segment], monkeypatch: pytest.MonkeyPatch) -> Iterator[Begin]:
    """`begin(order, ahead_seconds)`: a labeler whose drawer does this with every clip, and a console to read."""
    folder = store.folder

    def draws(folder: Path, settings: ClipSettings, still: bool) -> Clips:
        assert not still
        return Clips(folder, settings, [sys.executable, str(FAKE), str(folder)])

    monkeypatch.setattr(site, "Clips", draws)
    made: list[WebLabeler] = []

    def build(order: str = "draw", ahead_seconds: float = 20.0, asked: int = 4) -> WebLabeler:
        store.ask([query(number) for number in range(asked)])
        drawn = [one.id[:4] for number in range(6) for one in query(number).candidates]
        (folder / "orders.json").write_text(json.dumps({id: [order] for id in drawn}))
        settings = {"port": 0, "check_share": 0, "when_empty": "continue", "clips": {"ahead_seconds": ahead_seconds}}
        made.append(WebLabeler(WebSettings.model_validate(settings), PointSettings().build()))
        made[0].console = Console(file=io.StringIO(), width=200)
        return made[0]

    yield build
    for one in made:
        one.close()


def query(number: int) -> Query[Segment]:
    ways = [np.full((3, 2), 2.0 * number + k, np.float32) for k in range(2)]
    return Query(tuple(Segment(way, np.zeros((3, 2), np.float32), f"e{number}", 0, way) for way in ways))


def said(labeler: WebLabeler) -> str:
    file: Any = labeler.console.file
    return str(file.getvalue())


def test_the_link_comes_when_the_clips_of_the_first_questions_are_drawn(begin: Begin, store: Store[Segment]) -> None:
    labeler = begin()
    notes = labeler.open(store)
    assert len(notes) == 1
    assert len(attempts(store.folder)) == 2 * site.FIRST
    assert said(labeler) == "drawing the first 4 clips, for 20 seconds at most\n"
    assert labeler._site is not None
    assert labeler._site.clips is not None
    desk = labeler._site.service.desk
    desk.tell("me", Past())
    given = [one.query for one in desk.pick("me", site.FIRST)[1]]
    shown = [one.id for number in range(4) if query(number).id in given for one in query(number).candidates]
    assert len(shown) == 2 * site.FIRST
    assert labeler._site.clips.missing(shown) == []


def test_new_questions_are_given_out_when_the_first_clips_are_drawn(begin: Begin, store: Store[Segment]) -> None:
    labeler = begin(asked=0)
    assert len(labeler.open(store)) == 1, "a run opens the page before it asks"
    store.ask([query(0), query(1)])
    assert labeler._draw_first(site_of(labeler)) == []
    assert len(attempts(store.folder)) == 2 * site.FIRST
    store.ask([query(2), query(3)])
    labeler._draw_first(site_of(labeler))
    assert said(labeler).count("drawing") == 1, "the next ones are drawn while people look"


@pytest.mark.parametrize(
    ("order", "why"), [("error", "it has no states"), ("hang", "not drawn within 0.5 seconds")], ids=["fails", "hangs"]
)
def test_a_renderer_that_fails_costs_a_warning_and_no_start(
    order: str, why: str, begin: Begin, store: Store[Segment]
) -> None:
    labeler, begun = begin(order, ahead_seconds=0.5 if order == "hang" else 20.0), time.monotonic()
    notes = labeler.open(store)
    assert time.monotonic() - begun < 15
    assert notes[0].startswith("label here: ")
    assert notes[1:] == [f"the first clips are not there yet ({why}): the page goes on trying"]


def test_nothing_is_drawn_ahead_where_that_is_not_wanted(begin: Begin, store: Store[Segment]) -> None:
    labeler = begin(ahead_seconds=0)
    assert len(labeler.open(store)) == 1
    assert (said(labeler), attempts(store.folder)) == ("", [])


def site_of(labeler: WebLabeler) -> site.Site:
    assert labeler._site is not None
    return labeler._site
