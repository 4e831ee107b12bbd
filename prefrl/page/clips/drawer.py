"""The process that draws clips, as its server sees it: started when needed, ended when it hangs, replaced when gone."""

from __future__ import annotations

import json
import logging
import os
import signal
import subprocess
import sys
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from queue import Empty, SimpleQueue
from threading import Lock, Thread
from typing import IO

from prefrl.types import Json

log = logging.getLogger(__name__)
PATIENCE = 3.0
"""Seconds to wait for a process that was killed."""
LAST_WORDS = 30
"""Lines of a lost process's errors that are logged."""
START = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from prefrl.page.clips.worker import main; main(sys.argv[2])"
)
"""The process finds modules where this one finds them, and nowhere else: not in the folder it is started from."""


class DrawerLost(RuntimeError):
    """The process ended, or had to be ended, before it answered. The message is a sentence for people."""


@dataclass(frozen=True)
class Drawn:
    """What came of a job."""

    error: str = ""
    """Why there is no clip; "" where there is one."""
    lasting: bool = False
    """Whether it would go the same way again."""


@dataclass
class _Child:
    """One running process, and the threads that listen to it."""

    process: subprocess.Popen[str]
    replies: SimpleQueue[str | None] = field(default_factory=SimpleQueue)
    words: deque[str] = field(default_factory=lambda: deque(maxlen=LAST_WORDS))
    jobs: int = 0
    listeners: list[Thread] = field(default_factory=list)

    def listen(self) -> None:
        out, errors = self.process.stdout, self.process.stderr
        assert out is not None
        assert errors is not None
        self.listeners = [Thread(target=f, args=(s,), daemon=True) for f, s in ((self._out, out), (self._err, errors))]
        for one in self.listeners:
            one.start()

    def _out(self, stream: IO[str]) -> None:
        with stream:
            for line in stream:
                self.replies.put(line)
        self.replies.put(None)  # the pipe has closed, so the process is gone

    def _err(self, stream: IO[str]) -> None:
        with stream:
            while line := stream.readline(1000):  # a line without an end must not fill the memory
                self.words.append(line.rstrip())


class Drawer:
    """Draws one clip at a time in a process of its own. `draw` belongs to one thread; `close` may come from any."""

    def __init__(self, command: Sequence[str], limit: float, first_limit: float, most_jobs: int) -> None:
        """Time limits in seconds, the first one for a process's first job; after `most_jobs` it is replaced."""
        self._command = list(command)
        self._limit = limit
        self._first_limit = first_limit
        self._most_jobs = most_jobs
        self._child: _Child | None = None
        self._closed = False
        self._turn = Lock()

    @property
    def pid(self) -> int | None:
        """Of the process, while there is one."""
        child = self._child
        return None if child is None else child.process.pid

    def draw(self, candidate: str, file: str) -> Drawn:
        """Have a clip drawn. Raises `DrawerLost` where the process hung or crashed."""
        try:
            child = self._ready()
        except OSError as error:  # no memory, say: not the clip's fault
            return Drawn(f"the process that draws does not start: {error}")
        limit = self._limit if child.jobs else self._first_limit
        child.jobs += 1
        try:
            return self._ask(child, {"candidate": candidate, "file": file, "limit": limit})
        except DrawerLost as lost:
            self._end(child)
            if not self._closed:
                log.warning("drawing candidate %s: %s; its last words: %s", candidate, lost, " | ".join(child.words))
            raise

    def close(self) -> None:
        """End the process, within seconds, whatever it does; none is started from now on."""
        with self._turn:
            self._closed = True
            child = self._child
        if child is not None:
            self._end(child)

    def _ready(self) -> _Child:
        if self._child is not None and self._child.jobs >= self._most_jobs:
            self._end(self._child)
        with self._turn:
            if self._closed:
                raise DrawerLost("the server is closing")
            if self._child is None:
                self._child = _start(self._command)
            return self._child

    def _ask(self, child: _Child, job: Json) -> Drawn:
        stdin = child.process.stdin
        assert stdin is not None
        with suppress(OSError, ValueError):  # if it is gone, that shows in the next line
            stdin.write(json.dumps(job) + "\n")
            stdin.flush()
        try:
            line = child.replies.get(timeout=job["limit"])
        except Empty:
            raise DrawerLost(f"drawing took longer than {job['limit']:g} seconds") from None
        if line is None:
            raise DrawerLost("the process that draws has crashed")
        return _understood(line, job["file"])

    def _end(self, child: _Child) -> None:
        """Kill a process with all that it started, and collect it."""
        with self._turn:
            if self._child is not child:  # `draw` and `close` may both come here: one of them ends it
                return
            self._child = None
        _kill(child.process)
        try:
            child.process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            log.error("process %d, which draws clips, does not end: a driver may hang", child.process.pid)
        with suppress(OSError, ValueError):
            if child.process.stdin is not None:
                child.process.stdin.close()
        for one in child.listeners:
            one.join(1.0)


def worker(folder: Path) -> list[str]:
    """The command that draws the clips of a run's folder."""
    return [sys.executable, "-X", "faulthandler", "-P", "-c", START, json.dumps(sys.path), str(folder.resolve())]


def _start(command: list[str]) -> _Child:
    pipe = subprocess.PIPE
    # A session of its own: it is killed with all that it started, and a Ctrl-C at the terminal is not for it.
    process = subprocess.Popen(
        command, stdin=pipe, stdout=pipe, stderr=pipe, start_new_session=True, encoding="utf-8", errors="replace"
    )
    child = _Child(process)
    child.listen()
    return child


def _kill(process: subprocess.Popen[str]) -> None:
    """Not asked first whether it lives: until it is collected, its number is nobody else's."""
    if sys.platform == "win32":
        process.kill()
        return
    with suppress(OSError):
        os.killpg(process.pid, signal.SIGKILL)


def _understood(line: str, file: str) -> Drawn:
    try:
        reply = json.loads(line)
        if reply["file"] != file:
            raise ValueError("a reply to another job")
        return Drawn(str(reply.get("error", "")), bool(reply.get("lasting", False)))
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise DrawerLost("the process that draws gave no sensible reply") from error
