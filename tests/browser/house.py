"""A labelling page that is being served in this process, and what its store says: for tests of the page."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any, TypeAlias, cast

import numpy as np
import sqlalchemy as sql

from prefrl.envs.digits import DigitsSettings, real_digits
from prefrl.envs.toys import PointSettings
from prefrl.judgements import Answer, Comparison
from prefrl.label.web import WebLabeler, WebSettings, showing
from prefrl.page.service import Service
from prefrl.page.site import Site
from prefrl.storage import tables
from prefrl.store import Store
from prefrl.types import Picture, Query, Response, Segment

STEPS = 15
POINT = PointSettings(segment_steps=STEPS)
CONFIG = f"""\
task: {{kind: point, segment_steps: {STEPS}}}
reward: {{kind: mlp}}
learner: {{kind: control}}
labeler: {{kind: web, check_share: 0, repeat_share: 0}}
"""
"""Of a folder with clips: for the process that draws them, and for the command line."""
FIRST = {"slight": 0.73, "clear": 0.88, "much": 0.95}
"""What a strength means as a preference for the first slot."""


@dataclass
class House:
    """The page of one store."""

    folder: Path
    store: Store[Any]
    site: Site
    links: dict[str, str] = field(default_factory=dict)

    @property
    def service(self) -> Service:
        return self.site.service

    @property
    def origin(self) -> str:
        return self.site.address.rstrip("/")

    @property
    def admin(self) -> str:
        """The link of who started the server."""
        return self.site.notes[0].removeprefix("label here: ")

    def link(self, name: str, role: Any = "annotator") -> str:
        """A new link for somebody, who may be new too."""
        token, events = self.service.access.invite(name, role)
        self.service.append(events)
        return f"{self.site.address}#{token}"

    def ask(self, queries: Sequence[Query[Any]]) -> None:
        """Ask more while the page is served."""
        self.store.ask(queries)
        self.service.refresh()

    def answers(self, name: str = "ann") -> dict[str, Answer]:
        """What stands of a person's answers, by query."""
        return {one.query: one for one in self.store.answers() if one.labeler == name}

    def spoken(self, name: str = "ann") -> int:
        """How many answers of a person the log holds, whether they stand or not."""
        kinds = ("comparison", "ranking", "choice", "rating", "demonstration", "skip")
        return sum(one["kind"] in kinds and one["actor"] == name for one in self.store.events())

    def about(self, name: str = "ann") -> list[dict[str, Any]]:
        """What the log keeps beside each answer of a person."""
        return [one["body"]["about"] for one in self.store.events() if one["actor"] == name and "about" in one["body"]]

    def query_of(self, assignment: str) -> str:
        found = sql.select(tables.assignment.c.query).where(tables.assignment.c.id == assignment)
        with self.store.log.reading() as connection:
            return str(connection.scalar(found))

    def slot_of(self, query: str, shown: Sequence[str]) -> list[int]:
        """For each slot, which of the query's candidates stands there, told by what the page shows."""
        looks = [self.look(one) for one in self.store.query(query).candidates]
        return [looks.index(one) for one in shown]

    def look(self, candidate: Any) -> str:
        """What the page shows of a candidate: its text, or the address of its clip."""
        if isinstance(candidate, Response):
            return candidate.text
        assert self.site.clips is not None
        return self.site.clips.names(candidate.id)[0]

    def preference(self, query: str, name: str = "ann") -> float:
        answer = self.answers(name)[query]
        assert isinstance(answer, Comparison), answer
        return answer.preference


Open: TypeAlias = Callable[..., House]
"""`open(folder, kind="text", **settings)` serves a folder until the test ends."""


@contextmanager
def serving(folder: Path, kind: str = "text", **settings: Any) -> Iterator[House]:
    """Serve the store of a folder; no check questions and no repeats, unless the test wants them."""
    quiet = {"guideline": "", "clips": {"ahead_seconds": 0}}
    chosen: dict[str, Any] = {"port": 0, "check_share": 0.0, "repeat_share": 0.0, **quiet} | settings
    task: Any = SimpleNamespace(kind="text", name="short stories")
    if kind != "text":
        task = (POINT if kind == "control" else DigitsSettings()).build()
    with Store[Any](folder) as store:
        asks = WebSettings.model_validate(chosen)
        labeler = WebLabeler(asks, task, showing(asks.ask, task))
        labeler.open(store, fixed=True)
        try:
            yield House(folder, store, cast(Site, labeler._site))
        finally:
            labeler.close()


def texts(count: int, size: int = 2) -> list[Query[Response]]:
    """Queries over short texts."""
    return [
        Query(tuple(Response(f"Story {i} begins", f"and story {i} ends like this: {k}") for k in range(size)))
        for i in range(count)
    ]


def said(prompt: str, *responses: str) -> Query[Response]:
    return Query(tuple(Response(prompt, one) for one in responses))


def clips(count: int) -> list[Query[Segment]]:
    """Queries over pieces of a point's way through the plane."""
    return [Query((segment(2 * i), segment(2 * i + 1))) for i in range(count)]


def digits(count: int, size: int = 2) -> list[Query[Picture]]:
    """Queries over handwritten digits, as they lie in their package."""
    pixels, _ = real_digits()
    return [Query(tuple(Picture("a three", one) for one in pixels[size * i : size * (i + 1)])) for i in range(count)]


def segment(number: int, drawable: bool = True) -> Segment:
    """A point that goes straight from somewhere to somewhere; without states it cannot be drawn."""
    rng = np.random.default_rng(number)
    way = np.linspace(rng.uniform(-1, 1, 2), rng.uniform(-1, 1, 2), STEPS)
    still = np.zeros((STEPS, 2), np.float32)
    return Segment(way.astype(np.float32), still, f"e{number}", 0, way if drawable else None)


def fill(folder: Path, queries: Sequence[Query[Any]]) -> Path:
    """A folder with a store and open queries."""
    folder.mkdir(parents=True, exist_ok=True)
    if not isinstance(queries[0].candidates[0], Response):
        control = isinstance(queries[0].candidates[0], Segment)
        (folder / "config.yaml").write_text(CONFIG if control else "task: {kind: digits}\n")
    with Store[Any](folder) as store:
        store.ask(queries)
    return folder


def copy(source: Path, target: Path) -> Path:
    """A folder's own copy, drawn clips included."""
    shutil.copytree(source, target)
    return target
