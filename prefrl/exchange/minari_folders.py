"""Judged segments from a Minari data set with `labels.jsonl` beside it, as `exports.minari` writes them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from prefrl.exchange.layout import Parts, Row, answer_of
from prefrl.exchange.reading import parse_json, read_lines, refuse_links
from prefrl.types import Fields, Floats, Segment

LABELS = "labels.jsonl"


def is_minari(folder: Path) -> bool:
    """Whether a folder is a Minari data set with labels."""
    return (folder / "metadata.json").exists() and (folder / LABELS).exists()


def minari_rows(folder: Path) -> Parts:
    """(row N, what reads it) for each label. Raises `ValueError` where the data set is not one of ours."""
    refuse_links(folder)
    episodes = _Episodes(_storage(folder))
    for number, line in enumerate(read_lines(folder / LABELS), 1):
        yield f"{LABELS}, row {number}", partial(_parse, line, episodes)


def episodes(folder: Path) -> tuple[list[Segment], tuple[Floats, Floats] | None]:
    """Every episode, judged or not, as a segment, and the bounds of actions (A,), infinite where there are none.

    Discrete actions have no bounds (None), and become one-hot.

    The gold is attached where rewards are the task's own: in data sets that were not exported from a store.
    """
    refuse_links(folder)
    storage = _storage(folder)
    found = []
    for number in range(storage.total_episodes):
        (data,), (meta,) = storage.get_episodes([number]), storage.get_episode_metadata([number])
        options = meta.get("options") or {}
        if "candidate" in options:
            found.append(_segment(data, options, storage.action_space))
        else:
            one = _segment(data, {"episode": f"episode {number}"}, storage.action_space)
            found.append(replace(one, gold=np.asarray(data["rewards"], np.float64)))
    space = storage.action_space
    return found, None if _discrete(space) else (space.low.astype(np.float32), space.high.astype(np.float32))


def _storage(folder: Path) -> Any:
    """The data set's storage. Its own spaces must be in it: without them Minari would make the environment it names."""
    try:
        metadata = json.loads((folder / "metadata.json").read_text())
    except ValueError as error:
        raise ValueError(f"{folder / 'metadata.json'} is no JSON: {error}") from None
    known = metadata if isinstance(metadata, dict) else {}
    spaces = [known.get(name) for name in ("observation_space", "action_space")]
    read = [json.loads(space) for space in spaces if isinstance(space, str)]
    if [isinstance(space, dict) and space.get("type") for space in read] not in (["Box", "Box"], ["Box", "Discrete"]):
        raise ValueError(
            f"{folder}: expected a Minari data set whose observations and actions are each a Box, or whose actions are "
            "Discrete"
        )
    from minari.dataset.minari_storage import MinariStorage

    try:
        return MinariStorage.read(folder.absolute())
    except ModuleNotFoundError:
        raise
    except ImportError as error:  # Minari's own words, where what reads the data's form is not there
        raise ValueError(
            f"{folder} has data in the form {known.get('data_format')!r}, and what reads it is missing: "
            f"pip install 'prefrl[interchange]' ({error})"
        ) from error


def _discrete(space: Any) -> bool:
    from gymnasium.spaces import Discrete

    return isinstance(space, Discrete)


@dataclass
class _Episodes:
    """The segments of a data set, each read once."""

    storage: Any
    found: dict[int, Segment] = field(default_factory=dict)

    def __getitem__(self, number: Any) -> Segment:
        total = self.storage.total_episodes
        if isinstance(number, bool) or not isinstance(number, int) or not 0 <= number < total:
            raise ValueError(f"expected the number of an episode, from 0 to {total - 1}, got {number!r:.200}")
        if number not in self.found:
            (data,) = self.storage.get_episodes([number])
            (meta,) = self.storage.get_episode_metadata([number])
            self.found[number] = _segment(data, meta.get("options") or {}, self.storage.action_space)
        return self.found[number]


def _segment(data: Fields, options: Fields, space: Any) -> Segment:
    observations = np.asarray(data["observations"], np.float32)
    actions = _one_hot(data, space) if _discrete(space) else np.asarray(data["actions"], np.float32)
    if not np.isfinite(observations).all() or not np.isfinite(actions).all():
        raise ValueError(f"episode {data['id']} holds values that are not finite")
    return Segment(observations[:-1], actions, str(options.get("episode")), int(options.get("start", 0)))


def _one_hot(data: Fields, space: Any) -> Floats:
    """(T,) discrete actions, which count from the space's start, -> (T, A)."""
    actions, start, count = np.asarray(data["actions"]), int(space.start), int(space.n)
    if actions.ndim != 1 or not np.isin(actions, np.arange(start, start + count)).all():
        raise ValueError(
            f"episode {data['id']} has actions that are not whole numbers from {start} to {start + count - 1}"
        )
    found: Floats = (actions[:, None] == np.arange(start, start + count)).astype(np.float32)
    return found


def _parse(line: str, episodes: _Episodes) -> Sequence[Row | str]:
    row = parse_json(line)
    if not isinstance(row, dict) or not isinstance(row.get("episodes"), list):
        raise ValueError(f'expected "episodes": list, and an answer, got {line:.200}')
    return [answer_of(row, [episodes[number] for number in row["episodes"]])]
