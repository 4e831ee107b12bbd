"""Minari data sets: judged segments where `labels.jsonl` lies beside them, as `exports.minari` writes them, and the
episodes of any other."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from prefrl.exchange.layout import Parts, Row, answer_of
from prefrl.exchange.reading import parse_json, read_lines, refuse_links
from prefrl.types import Fields, Floats, Segment

LABELS = "labels.jsonl"
METADATA = "metadata.json"


def is_minari(folder: Path) -> bool:
    """Whether a folder is a Minari data set with labels."""
    return (folder / METADATA).exists() and (folder / LABELS).exists()


def is_unjudged(folder: Path) -> bool:
    """Whether a folder is a Minari data set without labels: other data sets may have a metadata.json as well."""
    return (folder / METADATA).exists() and not (folder / LABELS).exists() and "data_format" in _metadata(folder)


def minari_rows(folder: Path) -> Parts:
    """(row N, what reads it) for each label. Raises `ValueError` where the data set is not one of ours."""
    episodes = _Episodes(_opened(folder))
    for number, line in enumerate(read_lines(folder / LABELS), 1):
        yield f"{LABELS}, row {number}", partial(_parse, line, episodes)


def episodes(folder: Path) -> tuple[list[Segment], tuple[Floats, Floats] | None]:
    """Every episode, judged or not, as a segment, and the bounds of actions (A,), infinite where there are none.

    Discrete actions have no bounds (None), and become one-hot.

    The gold is attached where rewards are the task's own: in data sets that were not exported from a store.
    """
    storage, found = _opened(folder), []
    for number in range(storage.total_episodes):
        with _called(number):
            one = _episode(storage, number)
        found.append(one if one.episode else replace(one, episode=f"episode {number}"))
    space = storage.action_space
    return found, None if _discrete(space) else (space.low.astype(np.float32), space.high.astype(np.float32))


def each(folder: Path) -> Iterator[tuple[str, Callable[[], Segment]]]:
    """(place, what reads it) for every episode; it is named "" where it was not exported from a store."""
    storage = _opened(folder)
    for number in range(storage.total_episodes):
        yield f"episode {number}", partial(_episode, storage, number)


def _episode(storage: Any, number: int) -> Segment:
    """An episode, named as in the store that it was exported from, else "", with its rewards as the gold."""
    data, options = _read(storage, number)
    if "candidate" in options:
        return _segment(data, options, storage)
    one = _segment(data, {"episode": ""}, storage)
    return replace(one, gold=np.asarray(data["rewards"], np.float64))


def _read(storage: Any, number: int) -> tuple[Fields, Fields]:
    """The arrays of an episode, and its options. Raises `ValueError` where they are not whole."""
    try:
        (data,), (meta,) = storage.get_episodes([number]), storage.get_episode_metadata([number])
    except (OSError, KeyError, ValueError) as error:
        raise ValueError(f"cannot be read: {error}") from error
    return data, meta.get("options") or {}


@contextmanager
def _called(number: int) -> Iterator[None]:
    """What is wrong with an episode is told by its number."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"episode {number} {error}") from None


def _opened(folder: Path) -> Any:
    refuse_links(folder)
    return _storage(folder)


def _metadata(folder: Path) -> Fields:
    try:
        found = json.loads((folder / METADATA).read_text())
    except ValueError as error:
        raise ValueError(f"{folder / METADATA} is no JSON: {error}") from None
    return found if isinstance(found, dict) else {}


def _storage(folder: Path) -> Any:
    """The data set's storage. Its own spaces must be in it: without them Minari would make the environment it names."""
    known = _metadata(folder)
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
            with _called(number):
                data, options = _read(self.storage, number)
                self.found[number] = _segment(data, options, self.storage)
        return self.found[number]


def _segment(data: Fields, options: Fields, storage: Any) -> Segment:
    """Raises `ValueError` for what cannot be one, as the end of a sentence about the episode."""
    observations, space = np.asarray(data["observations"], np.float32), storage.action_space
    actions = _one_hot(data["actions"], space) if _discrete(space) else np.asarray(data["actions"], np.float32)
    seen, done = storage.observation_space.shape, (int(space.n),) if _discrete(space) else space.shape
    steps = len(actions)
    if (observations.shape, actions.shape) != ((steps + 1, *seen), (steps, *done)) or len(seen) != 1 or len(done) != 1:
        raise ValueError(
            f"has observations {observations.shape} and actions {actions.shape}; expected (T + 1, O) and (T, A), as "
            f"its data set says: {seen} and {done} a step"
        )
    if not np.isfinite(observations).all() or not np.isfinite(actions).all():
        raise ValueError("holds values that are not finite")
    return Segment(observations[:-1], actions, str(options.get("episode")), int(options.get("start", 0)))


def _one_hot(taken: Any, space: Any) -> Floats:
    """(T,) discrete actions, which count from the space's start, -> (T, A)."""
    actions, start, count = np.asarray(taken), int(space.start), int(space.n)
    if actions.ndim != 1 or not np.isin(actions, np.arange(start, start + count)).all():
        raise ValueError(f"has actions that are not whole numbers from {start} to {start + count - 1}")
    found: Floats = (actions[:, None] == np.arange(start, start + count)).astype(np.float32)
    return found


def _parse(line: str, episodes: _Episodes) -> Sequence[Row | str]:
    row = parse_json(line)
    if not isinstance(row, dict) or not isinstance(row.get("episodes"), list):
        raise ValueError(f'expected "episodes": list, and an answer, got {line:.200}')
    return [answer_of(row, [episodes[number] for number in row["episodes"]])]
