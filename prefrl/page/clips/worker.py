"""A process that draws clips, for a labelling server: `python -m prefrl.page.clips.worker FOLDER`.

Drawing and encoding are foreign code that can hang or crash, so they have a process of their own, which the server
watches and replaces. One line of JSON in, `{"candidate": id, "file": "<64 hex>.mp4", "limit": seconds}`; one out,
`{"file": ..., "bytes": n}` or `{"file": ..., "error": a sentence, "lasting": whether trying again is in vain}`. The
clip lies in `FOLDER/clips/<first two hex>/` by then. The end of the input ends the process, even while it draws.
"""

from __future__ import annotations

import faulthandler
import json
import os
import sys
import traceback
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from queue import SimpleQueue
from threading import Thread
from typing import Any, TextIO, cast

import yaml

from prefrl.components import load_plugins, settings_class
from prefrl.kinds import kind_of, named
from prefrl.page.clips.encode import NAME, encode
from prefrl.protocols import DrawnTask, TaskSettings
from prefrl.storage.files import write_file
from prefrl.store import Store
from prefrl.types import Json

GRACE = 5.0
"""Seconds after a job's limit at which the process ends itself, should nobody have ended it."""
SENTENCE = 400
"""Characters of an error at most."""


class JobError(ValueError):
    """A job that cannot be done, whoever tries."""


@dataclass
class Artist:
    """Draws the candidates of one store, by the task that the folder's settings name."""

    folder: Path
    _store: Store | None = field(default=None, init=False)

    def draw(self, candidate: str, file: str) -> int:
        """Write the clip of a candidate; returns its bytes. Raises `ValueError` where it cannot be drawn."""
        name = NAME.fullmatch(file)
        if name is None:
            raise JobError(f"expected a file named by 64 hex digits and .mp4, .webm or .webp, got {file!r}")
        place = self.folder / "clips" / file[:2]
        if place.is_symlink():
            raise JobError(f"{place} is a link, which is not followed: remove it")
        found = self._opened().candidate(candidate)
        if kind_of(found).shows != "clip":
            raise JobError("a text has no clip")
        data = encode(self._task.frames(found), self._task.fps, name[2])
        write_file(place / file, data)
        return len(data)

    @cached_property
    def _task(self) -> DrawnTask[Any]:
        """Built from its part of the settings alone: the rest would load what only training needs."""
        path = self.folder / "config.yaml"
        if not path.is_file():
            raise JobError(f"{self.folder} holds no run: expected a file config.yaml in it")
        chosen = yaml.safe_load(path.read_text(encoding="utf-8"))["task"]
        task = cast(TaskSettings, settings_class("tasks", chosen["kind"]).model_validate(chosen)).build()
        if named(task.kind).shows != "clip":
            raise JobError(f"the task {task.name} is of kind {task.kind!r}, and has no clips")
        return cast(DrawnTask[Any], task)

    def _opened(self) -> Store:
        if self._store is None:
            self._store = Store(self.folder, write=False)
        return self._store


def main(folder: str) -> None:
    """Do the jobs that come in, one after another, until the input ends."""
    incoming, outgoing = _own_pipes()
    jobs: SimpleQueue[str] = SimpleQueue()
    Thread(target=_listen, args=(incoming, jobs), daemon=True).start()
    load_plugins()
    artist = Artist(Path(folder))
    while True:
        outgoing.write(json.dumps(_reply(artist, json.loads(jobs.get()))) + "\n")
        outgoing.flush()  # the server waits for this line, with a time limit


def _own_pipes() -> tuple[TextIO, TextIO]:
    """The two pipes to the server under new numbers: what libraries print goes to the errors, and none reads along."""
    incoming, outgoing = os.fdopen(os.dup(0), encoding="utf-8"), os.fdopen(os.dup(1), "w", encoding="utf-8")
    nothing = os.open(os.devnull, os.O_RDONLY)
    os.dup2(nothing, 0)
    os.close(nothing)
    os.dup2(2, 1)
    return incoming, outgoing


def _listen(incoming: TextIO, jobs: SimpleQueue[str]) -> None:
    """Hand on each line; when there are no more, the server is gone, and a job under way is for nobody."""
    for line in incoming:
        jobs.put(line)
    os._exit(0)  # not sys.exit, which would end this thread alone


def _reply(artist: Artist, job: Json) -> Json:
    # A thread in C: it ends this process even where a driver hangs without giving Python a turn.
    faulthandler.dump_traceback_later(job["limit"] + GRACE, exit=True, file=sys.stderr.fileno())
    try:
        return {"file": job["file"], "bytes": artist.draw(job["candidate"], job["file"])}
    except Exception as error:  # a task from elsewhere may raise anything
        traceback.print_exc(file=sys.stderr)
        return {"file": job["file"], "error": _sentence(error, artist.folder), "lasting": _lasting(error)}
    finally:
        faulthandler.cancel_dump_traceback_later()


def _lasting(error: Exception) -> bool:
    """Mistakes in what is to be drawn come again; a full disk, or what nobody thought of, may be over in a minute."""
    return isinstance(error, ValueError | RuntimeError)


def _sentence(error: Exception, folder: Path) -> str:
    """For people who label: one line, which says nothing of where this machine keeps things."""
    said = " ".join(str(error).split()).replace(str(folder), "the run's folder")
    told = said if isinstance(error, ValueError | RuntimeError | OSError) else f"{type(error).__name__}: {said}"
    return told[:SENTENCE] or type(error).__name__


if __name__ == "__main__":
    main(sys.argv[1])
