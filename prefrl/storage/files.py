"""Files that survive a crash: written whole or not at all, and verified by sha256."""

from __future__ import annotations

import gzip
import hashlib
import json
import os
import shutil
import uuid
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

MANIFEST = "MANIFEST.json"
README = "README.md"
"""For people, who may edit it: no manifest vouches for it."""


class DamagedError(ValueError):
    """A folder does not hold what its manifest says."""


def write_file(path: Path, data: bytes) -> None:
    """Write a whole file or nothing: temporary file beside it, fsync, rename, fsync of the folder."""
    make_folder(path.parent)
    work = _beside(path)
    try:
        # Not tempfile: its files are private whatever the umask says, and a store is to be shared as the user wishes.
        with os.fdopen(os.open(work, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o666), "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())  # before the rename: a crash could leave the new name with nothing in it
        os.replace(work, path)
    except BaseException:
        work.unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def make_folder(folder: Path) -> None:
    """Make a folder with what is above it, so that it survives a crash: an entry is only safe once its folder is."""
    if folder.is_dir():  # nearly always, and cheaper than a look at all that is above it
        return
    missing = [f for f in (folder, *folder.parents) if not f.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for made in missing:
        sync_folder(made.parent)


def sync_folder(folder: Path) -> None:
    """Make renames within a folder durable."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Fill a temporary folder; on success it gets a manifest and takes the place of `path` in one rename.

    Raises `ValueError` where `path` holds anything that an earlier `whole_folder` did not put there.
    """
    check_free(path)
    make_folder(path.parent)
    work = _beside(path)
    work.mkdir()
    try:
        yield work
        files = sorted(p for p in work.rglob("*") if p.is_file() and p != work / README)
        hashes = {p.relative_to(work).as_posix(): _sha256(p) for p in files}
        # The manifest comes last: what has one is whole.
        write_file(work / MANIFEST, json.dumps(hashes, indent=1).encode())
        _replace(path, work)
    except BaseException:
        shutil.rmtree(work, ignore_errors=True)
        raise


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def check_free(path: Path) -> None:
    """Raise `ValueError` unless a folder may be replaced: it is missing, empty, or was written by `whole_folder`."""
    if not path.exists():
        return
    if not path.is_dir():
        raise ValueError(f"{path} is a file: choose another folder")
    found = {p.relative_to(path).as_posix() for p in path.rglob("*") if p.is_file()}
    try:
        ours = {MANIFEST, README, *json.loads((path / MANIFEST).read_text())}
    except (OSError, ValueError):
        ours = set()
    if strangers := sorted(found - ours):
        raise ValueError(f"{path} holds other things ({strangers[0]}), which would be lost: choose another folder")


def _replace(path: Path, work: Path) -> None:
    """Put `work` in the place of `path`; what was there is only removed once that is done."""
    aside = _beside(path)
    # A folder that holds something cannot be replaced by a rename, so the old one steps aside.
    if path.exists():
        os.rename(path, aside)
    os.rename(work, path)
    sync_folder(path.parent)
    shutil.rmtree(aside, ignore_errors=True)


def _beside(path: Path) -> Path:
    """A hidden name in the same folder that nothing else has."""
    # In the same folder: across file systems a rename is a copy, which can be cut short.
    return path.parent / f".{path.name}-{uuid.uuid4().hex[:12]}"


def read_lines(path: Path) -> Iterator[str]:
    """The lines of a UTF-8 file (.gz or not), cut at line feeds alone: in JSON lines other separators are text.

    Raises `ValueError` where a .gz is damaged.
    """
    opened = gzip.open if path.suffix == ".gz" else open
    try:
        with opened(path, "rt", encoding="utf-8-sig", newline="\n") as file:
            for line in file:
                yield line.rstrip("\r\n")
    except (EOFError, zlib.error, gzip.BadGzipFile) as error:
        raise ValueError(f"{path} is no whole gzip file: {error}") from error


def verify(folder: Path) -> None:
    """Raise `DamagedError` unless every file is there with the sha256 that the manifest says."""
    try:
        hashes = json.loads((folder / MANIFEST).read_text())
        for name, expected in hashes.items():
            if _sha256(folder / name) != expected:
                raise DamagedError(f"{folder / name} does not have the sha256 that {MANIFEST} says: it was changed")
    except (OSError, ValueError) as error:
        if isinstance(error, DamagedError):
            raise
        raise DamagedError(f"{folder} is no complete checkpoint: {error}") from error
