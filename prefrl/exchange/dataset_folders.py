"""Folders of a data set: what `datasets` saved with `save_to_disk`, and folders of Parquet, JSON lines or .csv.

The files are read as data alone: a loading script in the folder is never run.
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from prefrl.exchange.layout import Layout, Parts, Row
from prefrl.exchange.reading import list_files, refuse_links
from prefrl.exchange.text_rows import text_rows
from prefrl.storage.log import has_store

PATTERNS = (("*.parquet",), ("*.jsonl", "*.jsonl.gz"), ("*.json", "*.json.gz"), ("*.csv", "*.csv.gz"))
SPLITS = re.compile(r"(train|test|validation|valid|dev|eval)(?=[-_.]|\Z)")
JUDGEMENTS = "judgements"
"""The part of a data set of ours that holds every judgement; the rest of it says the same again."""
OURS = "prefrl.json"
"""What says that a data set is ours."""


def folder_rows(folder: Path, layout: Layout | None = None) -> Parts:
    """(file, row N, what reads it) for each row of a data set. Raises `ValueError` where there is none."""
    for path, split in _files(folder):
        for place, parse in text_rows(path, layout):
            yield f"{path.relative_to(folder)}, {place}", partial(_in_split, parse, split)


def _in_split(parse: Any, split: str) -> Sequence[Row | str]:
    """What a row holds, in the split that its file is of unless it says so itself."""
    found: Sequence[Row | str] = parse()
    return [row if isinstance(row, str) or row.split else row._replace(split=split) for row in found]


def data_files(folder: Path) -> list[Path]:
    """The files of a data set, in their order. Raises `ValueError` where there is none."""
    return [path for path, _ in _files(folder)]


def _files(folder: Path) -> Iterator[tuple[Path, str]]:
    """(file, split), those of the kind alone that the folder is made of."""
    refuse_links(folder)
    if has_store(folder):
        raise ValueError(f"{folder} is a store itself: read what `prefrl export --form bundle` makes of it")
    if (folder / OURS).exists():
        yield from ((path, "") for path in list_files(folder / JUDGEMENTS, ["*.parquet"]))
        return
    if (folder / "dataset_dict.json").exists():
        for split in _names(folder / "dataset_dict.json", "splits"):
            yield from ((path, split) for path in _saved(folder / split))
        return
    if (folder / "state.json").exists():
        yield from ((path, "") for path in _saved(folder))
        return
    for patterns in PATTERNS:
        if files := [path for path in list_files(folder, patterns) if path.name not in _KNOWN]:
            yield from ((path, _split(path, folder)) for path in files)
            return
    raise ValueError(f"{folder}: expected a bundle, or a data set in Parquet, Arrow, JSON lines or .csv; found none")


_KNOWN = (
    "dataset_info.json",
    "dataset_infos.json",
    "state.json",
    "dataset_dict.json",
    "metadata.json",
    "MANIFEST.json",
)


def _saved(folder: Path) -> list[Path]:
    """The files that `save_to_disk` wrote, in their order."""
    return [folder / name for name in _names(folder / "state.json", "_data_files")]


def _names(path: Path, key: str) -> list[str]:
    """Names of files or folders beside a JSON file that lists them; nothing that leads elsewhere."""
    try:
        values = json.loads(path.read_text())[key]
        names = [value["filename"] if isinstance(value, dict) else value for value in values]
    except (ValueError, KeyError, TypeError) as error:
        raise ValueError(f"{path} is not what save_to_disk writes: {error!r}") from None
    for name in names:
        if not isinstance(name, str) or not re.fullmatch(r"\w[\w.-]*", name):
            raise ValueError(f"{path}: {name!r:.200} is no name of a file beside it")
    return names


def _split(path: Path, folder: Path) -> str:
    """The split that a file's name, or its folder's, starts with; "" where it starts with none."""
    for part in reversed(path.relative_to(folder).parts):
        if found := SPLITS.match(part):
            return found[1]
    return ""
