"""Clips for the page: drawn when they are wanted by a process of their own, kept while there is room."""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
import re
import time
from collections.abc import Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field
from math import inf
from pathlib import Path
from threading import Condition, Thread

import yaml
from pydantic import Field

from prefrl.components import Settings
from prefrl.page.clips.drawer import Drawer, DrawerLost, Drawn, worker
from prefrl.page.clips.encode import ENCODING, NAME, formats
from prefrl.page.clips.shelf import Shelf

log = logging.getLogger(__name__)
ATTEMPTS = 2
"""A process that hangs or crashes is replaced, and the clip is tried once more."""
LOOKED_AT, SOON, LATER = range(3)
"""Whom a clip is drawn for first."""
MEDIA = "/media/"


class ClipSettings(Settings):
    """How clips are drawn and kept."""

    limit_seconds: float = Field(30.0, gt=0)
    """How long one clip may take, before the process that draws it is replaced."""
    first_limit_seconds: float = Field(90.0, gt=0)
    """The same for the first clip of a process, which loads the simulator."""
    ahead_seconds: float = Field(45.0, ge=0)
    """How long a start waits for the clips of the first questions, so that nobody else does; 0 draws none ahead."""
    cache_bytes: int = Field(2 << 30, gt=0)
    """How much the clips on disk may take; the least lately used go first, and are drawn again when wanted."""
    waiting: int = Field(256, gt=0)
    """How many clips may wait to be drawn."""
    retry_seconds: float = Field(30.0, ge=0)
    """After a failure that may pass, such as a full disk: when to try again."""
    clips_per_process: int = Field(500, gt=0)
    """After how many clips the process that draws is replaced: graphics drivers leak."""


class ClipUnknown(LookupError):
    """No candidate has a clip of this name."""


class ClipFailed(RuntimeError):
    """A clip cannot be drawn. The message is a sentence for people."""


class ClipBusy(RuntimeError):
    """A clip is not drawn yet: ask again."""


@dataclass
class _Job:
    candidate: str
    name: str
    rank: int
    number: int
    done: Future[str] = field(default_factory=Future)
    """Ends with why there is no clip, or ""."""

    def __post_init__(self) -> None:
        self.done.set_running_or_notify_cancel()  # one who no longer waits cannot cancel it for the others


class Clips:
    """The clips of a run's folder.

    A clip's name is its candidate's id, combined by exclusive or with a digest of what else determines the picture.
    So it tells of no file, needs no table to be read back, and changes where the picture would: browsers keep clips
    for ever.
    """

    def __init__(self, folder: Path, settings: ClipSettings, command: Sequence[str] = (), still: bool = False) -> None:
        """`command` draws clips in place of `prefrl.page.clips.worker`, and speaks as it does. `still`: a clip is one
        picture, which loses nothing as a WebP."""
        self._formats = ("webp",) if still else formats()
        self._folder, self._settings = folder, settings
        self._shelf = Shelf(folder / "clips", settings.cache_bytes)
        limits = settings.limit_seconds, settings.first_limit_seconds
        self._drawer = Drawer(command or worker(folder), *limits, settings.clips_per_process)
        self._turn = Condition()
        self._waiting: dict[str, _Job] = {}
        self._drawing: _Job | None = None
        self._failed: dict[str, tuple[str, float]] = {}
        """Why, and until when (monotonic seconds) that is believed."""
        self._format = self._formats[0]
        """What was last asked for: browsers without H.264 want what comes next to be prepared in another."""
        self._asked = self._drawn = 0
        self._closed = False
        self._key = 0
        self._thread = Thread(target=self._run, name="clips", daemon=True)

    def start(self) -> None:
        """Begin to draw. The process that does is started with the first clip."""
        self._thread.start()

    def close(self) -> None:
        """Stop, and end the process that draws, within seconds. Who waits is told to ask again."""
        with self._turn:
            self._closed = True
            self._turn.notify_all()
        self._drawer.close()
        if self._thread.is_alive():
            self._thread.join(5.0)
        with self._turn:
            left, self._waiting = list(self._waiting.values()), {}
        for job in left:
            job.done.set_result("the server is closing")

    # --- for the app ---------------------------------------------------------------------------------------------

    def names(self, candidate: str) -> list[str]:
        """The addresses of a candidate's clip, best format first."""
        return [f"{MEDIA}{self._name(candidate, format)}" for format in self._formats]

    def want(self, candidate: str, soon: bool = False) -> None:
        """Have a clip drawn ahead, `soon` or later; left undone where too many wait. Texts have none."""
        name = self._name(candidate, self._format)
        if self._exists(candidate) and self._failure(name) is None and self._shelf.find(name) is None:
            with suppress(ClipBusy):
                self._enqueue(candidate, name, SOON if soon else LATER)

    def missing(self, candidates: Sequence[str]) -> list[str]:
        """Those whose clips are still to be drawn; what cannot be drawn is not among them."""
        names = {one: self._name(one, self._format) for one in candidates if self._exists(one)}
        return [one for one, name in names.items() if self._failure(name) is None and self._shelf.find(name) is None]

    def draw(self, candidates: Sequence[str], seconds: float) -> str:
        """Have clips drawn now, and wait for them; why there is one missing, or "" once all are there."""
        until = time.monotonic() + seconds
        try:
            jobs = [self._enqueue(one, self._name(one, self._format), LOOKED_AT) for one in candidates]
            for job in jobs:
                if reason := job.done.result(max(0.0, until - time.monotonic())):
                    return reason
        except TimeoutError:
            return f"not drawn within {seconds:g} seconds"
        except ClipBusy as busy:
            return str(busy)
        return ""

    def retry(self, candidate: str) -> None:
        """Forget that a clip could not be drawn."""
        with self._turn:
            for format in self._formats:
                self._failed.pop(self._name(candidate, format), None)

    async def get(self, name: str, wait: float) -> Path:
        """The file of a clip by the last part of its address, drawn if need be within `wait` seconds.

        Raises `ClipUnknown`, `ClipFailed` with a sentence for people, or `ClipBusy`.
        """
        candidate = self._candidate(name)
        if (path := self._shelf.find(name)) is not None:
            return path
        if (reason := self._failure(name)) is not None:
            raise ClipFailed(reason)
        done = asyncio.wrap_future(self._enqueue(candidate, name, LOOKED_AT).done)
        await asyncio.wait([done], timeout=wait)
        if not done.done() or self._closed:
            raise ClipBusy("the clip is being drawn: ask again in a moment")
        if reason := done.result():
            raise ClipFailed(reason)
        if (path := self._shelf.find(name)) is None:
            raise ClipBusy("the clip had to make room for others: ask again in a moment")
        return path

    def counts(self) -> dict[str, int]:
        """Clips drawn by this server and failed, on disk now, and waiting."""
        with self._turn:
            failed, waiting = len(self._failed), len(self._waiting) + (self._drawing is not None)
        return {"drawn": self._drawn, "failed": failed, "cached": len(self._shelf), "waiting": waiting}

    # --- names ---------------------------------------------------------------------------------------------------

    def _name(self, candidate: str, format: str) -> str:
        return f"{_mixed(candidate, self._picture())}.{format}"

    def _candidate(self, name: str) -> str:
        """The candidate that a clip shows. Nothing that a client sends becomes part of a path before this."""
        match = NAME.fullmatch(name)
        if match is None or match[2] not in self._formats:
            raise ClipUnknown(f"no clip is called {name[:80]!r}")
        candidate = _mixed(match[1], self._picture())
        if not self._exists(candidate):
            raise ClipUnknown(f"no candidate has the clip {name!r}")
        self._format = match[2]
        return candidate

    def _exists(self, candidate: str) -> bool:
        """Is there a segment of this id? Its arrays are filed before it is asked about."""
        known = re.fullmatch("[0-9a-f]{64}", candidate) is not None
        return known and (self._folder / "blobs" / candidate[:2] / f"{candidate}.safetensors").is_file()

    def _picture(self) -> int:
        """A digest of the task, which draws, and of how clips are encoded."""
        path = self._folder / "config.yaml"
        if not self._key and path.is_file():
            task = yaml.safe_load(path.read_text(encoding="utf-8"))["task"]
            facts = json.dumps({"task": task, "encoding": ENCODING}, sort_keys=True, default=str)
            self._key = int(hashlib.sha256(facts.encode()).hexdigest(), 16)
        return self._key

    # --- the queue -----------------------------------------------------------------------------------------------

    def _enqueue(self, candidate: str, name: str, rank: int) -> _Job:
        """The job that draws a clip: the one there is, or a new one. Raises `ClipBusy` where too many wait."""
        with self._turn:
            job = self._waiting.get(name)
            if job is None and self._drawing is not None and self._drawing.name == name:
                job = self._drawing
            if job is None:
                self._make_room(rank)
                self._asked += 1
                job = self._waiting[name] = _Job(candidate, name, rank, self._asked)
                self._turn.notify_all()
            job.rank = min(job.rank, rank)
            return job

    def _make_room(self, rank: int) -> None:
        """A full queue drops what is wanted later for what is wanted now."""
        if self._closed:
            raise ClipBusy("the server is closing")
        if len(self._waiting) < self._settings.waiting:
            return
        last = max(self._waiting.values(), key=lambda job: (job.rank, job.number))
        if last.rank <= rank:
            raise ClipBusy("too many clips are waiting to be drawn: ask again in a moment")
        del self._waiting[last.name]

    def _failure(self, name: str) -> str | None:
        with self._turn:
            reason, until = self._failed.get(name, ("", 0.0))
            if until <= time.monotonic():
                self._failed.pop(name, None)
                return None
            return reason

    # --- the thread that draws -------------------------------------------------------------------------------------

    def _run(self) -> None:
        try:
            self._shelf.scan()
        except OSError as error:
            log.warning("the clips that were drawn before cannot be counted: %s", error)
        while (job := self._next()) is not None:
            try:
                drawn = self._draw(job)
            except Exception:  # whatever goes wrong with one clip, the next ones are drawn
                log.exception("clip %s", job.name)
                drawn = Drawn("the clip could not be drawn; the server's log says why")
            self._finish(job, drawn)

    def _next(self) -> _Job | None:
        with self._turn:
            self._turn.wait_for(lambda: self._waiting or self._closed)
            if self._closed:
                return None
            job = min(self._waiting.values(), key=lambda job: (job.rank, job.number))
            self._drawing = self._waiting.pop(job.name)
            return job

    def _draw(self, job: _Job) -> Drawn:
        if self._shelf.find(job.name) is not None:
            return Drawn()
        drawn = Drawn()
        for _ in range(ATTEMPTS):
            try:
                drawn = self._drawer.draw(job.candidate, job.name)
                break
            except DrawerLost as lost:
                drawn = Drawn(str(lost), lasting=True)
        if not drawn.error and not self._shelf.add(job.name):
            return Drawn("the clip was drawn, but cannot be read back")
        return drawn

    def _finish(self, job: _Job, drawn: Drawn) -> None:
        with self._turn:
            self._drawing = None
            if drawn.error:
                until = inf if drawn.lasting else time.monotonic() + self._settings.retry_seconds
                self._failed[job.name] = drawn.error, until
                if not self._closed:
                    log.warning("no clip of candidate %s: %s", job.candidate, drawn.error)
            else:
                self._drawn += 1
        job.done.set_result(drawn.error)


def _mixed(digits: str, key: int) -> str:
    """64 hex digits, combined with a key; the same again gives back what they were."""
    return f"{int(digits, 16) ^ key:064x}"
