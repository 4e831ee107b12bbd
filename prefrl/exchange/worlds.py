"""Whether what a run is given from elsewhere, demonstrations or a policy, was made in the same world."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import yaml

from prefrl.components import ConfigError, Settings, flat, settings_class, todays
from prefrl.types import Json

LENGTHS = {"horizon", "segment_seconds", "segment_steps", "fps", "frame_size"}
"""How long behaviour is and how it is drawn: what was shown holds in both."""


def other_worlds(task: Settings, given: Mapping[str, Settings]) -> list[str]:
    """A sentence for each folder named in some settings, by their part, whose task has other settings than this one.

    Where a folder says nothing of its task, as the files of others, nothing can be told.
    """
    here = _world(task)
    found = []
    for part, settings in given.items():
        for key, path in flat(settings.model_dump()):
            there = _saved(path) if isinstance(path, Path) else None
            if there is None or there == here:
                continue
            told = ", ".join(_differences(there, here))
            found.append(f"{part}.{key}: {path} is of another world ({told}); what is right there may be wrong here")
    return found


def _world(task: Settings) -> Json:
    parts = dict(flat(task.identity().model_dump(mode="json")))
    return {key: value for key, value in parts.items() if key not in LENGTHS}


def _saved(folder: Path) -> Json | None:
    """The world of a run's or of demonstrations' folder, where its settings can be read."""
    path = folder / "config.yaml"
    if not path.is_file():
        return None
    try:
        said = todays("tasks", dict(yaml.safe_load(path.read_text(encoding="utf-8"))["task"]))
        return _world(settings_class("tasks", said["kind"]).model_validate(said))
    except (ConfigError, ValueError, KeyError, TypeError, OSError, yaml.YAMLError):
        return None  # whoever reads the folder says what is wrong with it


def _differences(there: Json, here: Json) -> Iterator[str]:
    keys: Sequence[str] = list(dict.fromkeys([*there, *here]))
    for key in keys:
        if there.get(key) != here.get(key):
            yield f"task.{key} is {there.get(key, 'not set')} there, {here.get(key, 'not set')} here"
