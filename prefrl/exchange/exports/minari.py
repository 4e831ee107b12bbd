"""Segments as episodes of a Minari data set, with the judgements beside them as JSON lines that name the episodes."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from prefrl.exchange.exports.given import (
    LABELER,
    ORDER,
    STRENGTH,
    TIME,
    WEIGHT,
    WHOLE,
    Exported,
    Tally,
    each_answer,
    told,
    write_lines,
)
from prefrl.kinds import only
from prefrl.storage.files import whole_folder
from prefrl.storage.log import StoreError
from prefrl.store import Store
from prefrl.types import Json, Segment

LABELS = "labels.jsonl"
STATES = "simulator states of a segment"
NOTES = (
    "rewards are 0: a store keeps its gold to itself",
    "the last observation of an episode is there twice: a segment ends before the next one",
)


def export_minari(store: Store, path: Path) -> Exported:
    """Write a folder that `minari.MinariDataset` opens: every judged segment is an episode, cut off at its end.

    The options of an episode say which `candidate` it is, of which `episode` and from which `start` on. `labels.jsonl`
    has a row for each answer: `episodes`, the numbers of those that were compared, and the answer. Raises `StoreError`
    for responses, and for segments of different sizes.
    """
    tally, episodes = Tally({LABELER, ORDER, TIME, STRENGTH, WEIGHT, WHOLE}), dict[str, int]()
    with whole_folder(path) as work:
        storage: Any = None
        for segment in _segments(store):
            storage = storage or new_storage(work, segment, path.name)
            add_episode(storage, segment, len(episodes))
            episodes[segment.id] = len(episodes)
            tally.dropped[STATES] += segment.states is not None
        written = write_lines(work / LABELS, _labels(store, tally, episodes))
        if storage is None:
            raise StoreError(
                f"{store.folder} holds no judgement of segments to write; demonstrations fit --form demonstrations"
            )
    return tally.done(store, written, f"{len(episodes)} segments as episodes", *NOTES)


def _segments(store: Store) -> Iterator[Segment]:
    """Every segment that was judged or skipped, once."""
    seen = set[str]()
    error = StoreError("responses are no trajectories, and do not fit Minari; use another form")
    for given in each_answer(store):
        for segment in only(Segment, given.query.candidates, error):
            if segment.id not in seen:
                seen.add(segment.id)
                yield segment


def new_storage(work: Path, segment: Segment, name: str) -> Any:
    """An empty data set for segments of one size."""
    import minari
    from gymnasium.spaces import Box
    from minari.dataset.minari_storage import MinariStorage

    spaces = (Box(-np.inf, np.inf, array.shape[1:], np.float32) for array in (segment.observations, segment.actions))
    # Minari joins a relative path to itself.
    storage = MinariStorage.new(work.absolute(), *spaces, data_format="arrow")
    plain = re.sub(r"[^\w-]+", "-", name, flags=re.ASCII).strip("-") or "segments"
    storage.update_metadata({"dataset_id": f"prefrl/{plain}-v0", "minari_version": minari.__version__})
    return storage


def add_episode(storage: Any, segment: Segment, number: int) -> None:
    """Write a segment as an episode that is cut off at its end. Raises `StoreError` for one of another size."""
    from minari.data_collector import EpisodeBuffer

    steps = len(segment)
    sizes = (storage.observation_space.shape, storage.action_space.shape)
    if (found := (segment.observations.shape[1:], segment.actions.shape[1:])) != sizes:
        raise StoreError(f"segments of sizes {sizes} and {found} do not fit one data set of Minari")
    last = segment.observations[-1:]
    episode = EpisodeBuffer(
        id=number,
        options={"candidate": segment.id, "episode": segment.episode, "start": segment.start},
        observations=np.concatenate([segment.observations, last]).astype(np.float32),
        actions=segment.actions.astype(np.float32),
        rewards=[0.0] * steps,
        terminations=[False] * steps,
        truncations=[False] * (steps - 1) + [True],
    )
    storage.update_episodes([episode])


def _labels(store: Store, tally: Tally, episodes: Mapping[str, int]) -> Iterator[Json]:
    for given in each_answer(store):
        tally.note(given)
        compared = {"query": given.query.id, "episodes": [episodes[c.id] for c in given.query.candidates]}
        yield compared | told(given)
