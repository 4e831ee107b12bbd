"""Demonstrations of control as recorded behaviour: arrays in an .npz, or the episodes of a Minari data set."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np

from prefrl.exchange.exports.given import LABELER, TIME, WEIGHT, Exported, each_answer, whole_file
from prefrl.exchange.exports.minari import NOTES, STATES, add_episode, new_storage
from prefrl.exchange.exports.rows import ANSWERED, OPINION
from prefrl.exchange.recordings import is_one_hot
from prefrl.kinds import only
from prefrl.storage.files import whole_folder
from prefrl.storage.log import StoreError
from prefrl.store import Store
from prefrl.types import Segment

CONTEXT = "name of a segment's task, of several"
HIDDEN = "there are no rewards: a store keeps its gold to itself"


def export_behaviour(store: Store, path: Path) -> Exported:
    """Write every behaviour that was shown: to an .npz that `segment_arrays` reads, or to a Minari data set's folder.

    Raises `ValueError` for another suffix, and `StoreError` where nothing was shown, or segments of different sizes.
    """
    if path.suffix not in _WRITERS:
        raise ValueError(
            f"{path}: demonstrations of control go into an .npz, or, where the name has no suffix, into the folder of "
            f"a Minari data set; got {path.suffix!r}"
        )
    shown = store.demonstrations()
    if not shown:
        raise StoreError(f"{store.folder} holds no demonstration; judgements of segments fit --form bundle or minari")
    segments = only(Segment, [one.like for one in shown], StoreError(f"{store.folder} holds no segments"))
    sizes = {(one.observations.shape[1], one.actions.shape[1]) for one in segments}
    if len(sizes) > 1:
        got = " and ".join(map(str, sorted(sizes)))
        raise StoreError(f"demonstrations of different sizes, {got}, do not fit one file; use --form bundle")
    notes = tuple(_WRITERS[path.suffix](segments, path))
    left = {
        LABELER: len(shown),
        TIME: len(shown),
        WEIGHT: sum(one.demonstration.weight != 1.0 for one in shown),
        OPINION: sum(1 for _ in each_answer(store)),
        ANSWERED: sum(one.like.id != one.query.candidates[0].id for one in shown),
        STATES: sum(one.states is not None for one in segments),
        CONTEXT: sum(bool(one.context) for one in segments),
    }
    return Exported(len(segments), {name: count for name, count in left.items() if count}, notes)


def _write_arrays(segments: Sequence[Segment], path: Path) -> Sequence[str]:
    """All steps one after another. Actions that are all one-hot are written as whole numbers."""
    actions = np.concatenate([one.actions for one in segments])
    size = actions.shape[1]
    discrete = size > 1 and is_one_hot(actions)
    with whole_file(path) as file:
        np.savez(
            file,
            observations=np.concatenate([one.observations for one in segments]),
            lengths=np.array([len(one) for one in segments]),
            episodes=np.array([one.episode for one in segments]),
            starts=np.array([one.start for one in segments]),
            **({"actions": actions.argmax(1), "action_count": np.array(size)} if discrete else {"actions": actions}),
        )
    return (HIDDEN,)


def _write_minari(segments: Sequence[Segment], path: Path) -> Sequence[str]:
    with whole_folder(path) as work:
        storage = new_storage(work, segments[0], path.name)
        for number, one in enumerate(segments):
            add_episode(storage, one, number)
    return NOTES


_WRITERS: Mapping[str, Callable[[Sequence[Segment], Path], Sequence[str]]] = {
    ".npz": _write_arrays,
    "": _write_minari,
}
"""By the suffix of a path."""
