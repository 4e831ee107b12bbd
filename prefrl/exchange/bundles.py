"""Bundles: folders with every event and every array of a store, which lose nothing. Few are in memory at a time."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator, Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from prefrl.exchange.exports.given import Exported, json_text, whole_file
from prefrl.exchange.reading import parse_json, read_lines, refuse_links
from prefrl.storage.arrivals import Merged, check_arrivals
from prefrl.storage.events import PORTABLE
from prefrl.storage.files import MANIFEST, DamagedError, whole_folder, write_file
from prefrl.storage.projection import ANSWERS
from prefrl.store import Store

EVENTS = "events.jsonl"
BLOBS = "blobs"
FIELDS = ("id", "kind", "subject", "actor", "body", "at")
"""What of an event goes from store to store; its number and its hash are each store's own."""


def is_bundle(path: Path) -> bool:
    """Whether a folder holds the events of a store."""
    return path.is_dir() and (path / EVENTS).exists()


def export_bundle(store: Store[Any], path: Path) -> Exported:
    """Write a folder with every event and every array; the same store gives the same bytes.

    Gold stays out, and so do names of people who have not answered, their access, and settings of the project.
    """
    left, answers = 0, 0
    with whole_folder(path) as work:
        with whole_file(work / EVENTS) as file:
            for one in store.events():
                left += one["kind"] not in PORTABLE
                answers += one["kind"] in ANSWERS
                if one["kind"] in PORTABLE:
                    file.write(f"{_event_text(one)}\n".encode())
        for blob in sorted((store.folder / BLOBS).rglob("*.safetensors")):
            write_file(work / blob.relative_to(store.folder), blob.read_bytes())
    note = "the gold stays where it is, and so do secrets that let people in"
    return Exported(answers, {"event about people's access or the project's settings": left} if left else {}, (note,))


def _event_text(one: Mapping[str, Any]) -> str:
    body = json.loads(json.dumps(one["body"], sort_keys=True))  # sorted at every depth: the same store, the same bytes
    return json_text({name: body if name == "body" else one[name] for name in FIELDS})


def import_bundle(path: Path, store: Store[Any]) -> Merged:
    """Read a folder that `export_bundle` wrote, all or none; what the store has already is left alone.

    Raises `ValueError` for what is wrong in it, and `StoreError` where the store holds another judgement of the same
    query by a labeler of the same name.
    """
    _check_files(path)
    return store.merge(lambda: _events(path / EVENTS), path / BLOBS)


def try_bundle(path: Path, store: Store[Any] | None) -> Merged:
    """What `import_bundle` would do, by the same checks, with nothing written. A store may be open for reading."""
    _check_files(path)
    if store is None:
        return check_arrivals(_events(path / EVENTS), path / BLOBS)
    with store.log.reading() as connection:
        return check_arrivals(_events(path / EVENTS), path / BLOBS, connection)


def _check_files(path: Path) -> None:
    """Raise `ValueError` unless the manifest names the events, nothing outside the folder, and each file's sha256."""
    refuse_links(path)
    try:
        hashes = json.loads((path / MANIFEST).read_text())
    except (OSError, ValueError) as error:
        raise ValueError(f"{path} is no whole bundle: {MANIFEST} cannot be read: {error}") from None
    if not isinstance(hashes, dict) or EVENTS not in hashes:
        raise ValueError(f"{path} is no whole bundle: {MANIFEST} does not name {EVENTS}")
    # All names before any file: none is opened that lies outside.
    for name in hashes:
        if PurePosixPath(name).is_absolute() or ".." in PurePosixPath(name).parts or "\\" in name:
            raise ValueError(f"{path}: {MANIFEST} names {name!r}, which lies outside: refused")
    for name, expected in hashes.items():
        if _sha256(path / name) != expected:
            raise DamagedError(f"{path / name} does not have the sha256 that {MANIFEST} says: it was changed")


def _sha256(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise DamagedError(f"{path} cannot be read, though {MANIFEST} names it: {error}") from error


def _events(path: Path) -> Iterator[dict[str, Any]]:
    for number, line in enumerate(read_lines(path), 1):
        try:
            one = parse_json(line)
            yield {name: one[name] for name in FIELDS}
        except (ValueError, KeyError, TypeError) as error:
            raise ValueError(f"{path}: row {number} is no event: {error!r}") from None
