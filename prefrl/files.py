"""Files that survive a crash: written whole or not at all, and verified by sha256."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

MANIFEST = "MANIFEST.json"


class DamagedError(ValueError):
    """A folder does not hold what its manifest says."""


def write_file(path: Path, data: bytes) -> None:
    """Write a whole file or nothing: temporary file beside it, fsync, rename, fsync of the folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, name = tempfile.mkstemp(dir=path.parent, prefix=".", suffix=".tmp")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.chmod(name, 0o644)
        os.replace(name, path)
    except BaseException:
        Path(name).unlink(missing_ok=True)
        raise
    sync_folder(path.parent)


def sync_folder(folder: Path) -> None:
    """Make renames within a folder durable."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


@contextmanager
def whole_folder(path: Path) -> Iterator[Path]:
    """Fill a temporary folder; on success it gets a manifest and takes the place of `path` in one rename."""
    path.parent.mkdir(parents=True, exist_ok=True)
    work = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name}-"))
    try:
        yield work
        files = sorted(p for p in work.rglob("*") if p.is_file())
        hashes = {p.relative_to(work).as_posix(): hashlib.sha256(p.read_bytes()).hexdigest() for p in files}
        write_file(work / MANIFEST, json.dumps(hashes, indent=1).encode())
        work.chmod(0o755)
        if path.exists():
            shutil.rmtree(path)
        os.rename(work, path)
        sync_folder(path.parent)
    except BaseException:
        shutil.rmtree(work, ignore_errors=True)
        raise


def verify(folder: Path) -> None:
    """Raise `DamagedError` unless every file is there with the sha256 that the manifest says."""
    try:
        hashes = json.loads((folder / MANIFEST).read_text())
        for name, expected in hashes.items():
            if hashlib.sha256((folder / name).read_bytes()).hexdigest() != expected:
                raise DamagedError(f"{folder / name} does not have the sha256 that {MANIFEST} says: it was changed")
    except (OSError, ValueError) as error:
        if isinstance(error, DamagedError):
            raise
        raise DamagedError(f"{folder} is no complete checkpoint: {error}") from error
