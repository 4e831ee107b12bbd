"""The clips that lie in a folder: a cache, so that any of them may go at any time and be drawn again."""

from __future__ import annotations

import os
import re
import stat
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from threading import Lock

from prefrl.page.clips.encode import NAME, whole

UNFINISHED = re.compile(f"[.]{NAME.pattern}-[0-9a-f]{{12}}")
"""What is left where a process was ended while it wrote."""


class Shelf:
    """Clips in `folder`, by the first two digits of their names; the least lately used go when there are too many.

    Links inside the folder are not followed, and what is not named like a clip is left alone.
    """

    def __init__(self, folder: Path, most_bytes: int) -> None:
        self.folder, self.most_bytes = folder, most_bytes
        self._sizes: OrderedDict[str, int] = OrderedDict()
        """Of the clips known to be there, the least lately used first."""
        self._bytes = 0
        self._turn = Lock()

    def __len__(self) -> int:
        return len(self._sizes)

    def scan(self) -> None:
        """Take stock of what earlier processes left, oldest first; remove what they did not finish."""
        found = []
        for entry in _files(self.folder):
            if UNFINISHED.fullmatch(entry.name):
                _remove(Path(entry.path))
            elif NAME.fullmatch(entry.name) and Path(entry.path) == self._path(entry.name):
                status = entry.stat(follow_symlinks=False)
                found.append((status.st_mtime, entry.name, status.st_size))
        with self._turn:
            # The newest first, each put at the front: the oldest ends up there, and what was used since stays behind.
            for _, name, size in sorted(found, reverse=True):
                if name not in self._sizes:
                    self._put(name, size)
                    self._sizes.move_to_end(name, last=False)
            self._make_room()

    def find(self, name: str) -> Path | None:
        """Where a clip lies, if it does, whole. Looked at each time: a cache may be emptied by anybody."""
        path = self._path(name)
        size = _regular(path)
        there = size is not None and whole(path)
        with self._turn:
            self._put(name, size if there and size is not None else None)
        return path if there else None

    def add(self, name: str) -> bool:
        """Count a clip that was just drawn, and make room; whether it is there."""
        found = self.find(name) is not None
        with self._turn:
            self._make_room()
        return found

    def _path(self, name: str) -> Path:
        return self.folder / name[:2] / name

    def _put(self, name: str, size: int | None) -> None:
        """Note that a clip was just used, or that it is not there (None)."""
        self._bytes -= self._sizes.pop(name, 0)
        if size is not None:
            self._sizes[name] = size
            self._bytes += size

    def _make_room(self) -> None:
        """The one used last stays, however large it is: somebody waits for it."""
        while self._bytes > self.most_bytes and len(self._sizes) > 1:
            name = next(iter(self._sizes))
            if _regular(self._path(name)) is not None:
                _remove(self._path(name))
            self._put(name, None)


def _files(folder: Path) -> Iterator[os.DirEntry[str]]:
    """The regular files in the two-digit folders of `folder`; links are passed over."""
    if not folder.is_dir():
        return
    for place in os.scandir(folder):
        if re.fullmatch("[0-9a-f]{2}", place.name) and place.is_dir(follow_symlinks=False):
            yield from (entry for entry in os.scandir(place.path) if entry.is_file(follow_symlinks=False))


def _regular(path: Path) -> int | None:
    """The size of a file that is no link, in a folder that is none."""
    try:
        if path.parent.is_symlink():
            return None
        status = path.lstat()
    except OSError:
        return None
    return status.st_size if stat.S_ISREG(status.st_mode) else None


def _remove(path: Path) -> None:
    with suppress(OSError):  # where an open file cannot be removed, it will be another time
        path.unlink()
