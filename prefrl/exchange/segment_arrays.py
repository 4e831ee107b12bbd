"""Recorded segments in an .npz: arrays `observations` and `actions`, of one length or joined to one long row of steps.

Either `observations` (N, T, O), `actions` (N, T, A) and, where the gold is known, `rewards` (N, T); or, for episodes of
unlike length, (S, O), (S, A) and (S,) with `lengths` (N,), which sum to S. Discrete actions are one-hot, or whole
numbers from 0 on, (N, T) or (S,); `action_count` says how many there are where the highest one was never taken.
`episodes` (N,), text, may say of which episode each is, and `starts` (N,) from which of its steps on.
"""

from __future__ import annotations

import hashlib
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TypeAlias

import numpy as np

from prefrl.types import LARGEST, Floats, Segment

Arrays: TypeAlias = Mapping[str, np.ndarray]
LARGEST_COUNT = 10_000
"""Discrete actions: a number beyond is a mistake, and would fill the memory."""
UNLIKE = (
    "; of episodes of unlike length, put all steps one after another, (S, O) and (S, A), and say in an array lengths "
    "(N,) how many each episode has"
)

_DAMAGED = (ValueError, EOFError, OSError, NotImplementedError, zipfile.BadZipFile, zlib.error)
"""What reading an archive raises where it is not whole, or is packed in a way that cannot be read."""


@contextmanager
def archived(path: Path) -> Iterator[Arrays]:
    """The arrays of a file, whose name stands in front of what is wrong with them."""
    with path.open("rb") as file:
        try:
            archive = np.load(file, allow_pickle=False)  # a pickle can run any code
            if not isinstance(archive, Mapping):
                raise ValueError("expected an archive of arrays, got one array")
            yield archive
        except _DAMAGED as error:
            raise ValueError(f"{path}: {error}") from error


def rows(archive: Arrays) -> dict[str, Segment]:
    """Every segment, by what its place in the arrays is called. Raises `ValueError` where they do not fit."""
    found = {}
    for place, make in each(archive):
        try:
            one = make()
        except ValueError as error:
            raise ValueError(f"{place}: {error}") from None
        found[place] = one if one.episode else named("segment", one)
    return found


def each(archive: Arrays) -> Iterator[tuple[str, Callable[[], Segment]]]:
    """(place, what makes it) for every segment; its episode is "" where the file names none.

    Raises `ValueError` where the arrays do not fit; what makes a segment does where values are not finite.
    """
    if "actions" not in archive:
        raise ValueError("array actions is missing")
    names = [name for name in ("observations", "actions", "rewards", "lengths") if name in archive]
    arrays = {name: read(archive, name) for name in names}
    _check_shapes(arrays)
    if arrays["actions"].dtype.kind in "iu":
        arrays["actions"] = _one_hot(arrays["actions"], archive)
    lengths, row = arrays.pop("lengths", None), "row"
    if lengths is not None:
        row, ends = "episode", np.cumsum(lengths)
        # After the last end there is one part more, with nothing in it; without it no lengths are no episode.
        split = {name: np.split(array, ends)[:-1] for name, array in arrays.items()}
    else:
        split = {name: list(array) for name, array in arrays.items()}
    episodes, starts = _origins(archive, len(split["actions"]))
    for i in range(len(split["actions"])):
        yield f"{row} {i + 1}", partial(_segment, {name: split[name][i] for name in arrays}, episodes[i], starts[i])


def _segment(arrays: Arrays, episode: str, start: int) -> Segment:
    observations, actions = (finite(f"array {name}", arrays[name]) for name in ("observations", "actions"))
    gold = arrays["rewards"].astype(np.float64) if "rewards" in arrays else None
    return Segment(observations, actions, episode, start, gold=gold)


def _origins(archive: Arrays, count: int) -> tuple[list[str], list[int]]:
    """Of which episode each segment is, "" where nothing is said, and from which step on."""
    if "episodes" not in archive:
        if "starts" in archive:
            raise ValueError("array starts says from which step of its episode each segment is: add episodes (N,)")
        return [""] * count, [0] * count
    episodes = read(archive, "episodes")
    starts = read(archive, "starts") if "starts" in archive else np.zeros(count, int)
    if episodes.shape != (count,) or episodes.dtype.kind != "U" or not all(episodes):
        got = f"{episodes.dtype} of shape {episodes.shape}"
        raise ValueError(f"array episodes: expected a text for each of {count} segments, got {got}")
    if starts.shape != (count,) or starts.dtype.kind not in "iu" or ((starts < 0) | (starts > LARGEST)).any():
        got = f"{starts.dtype} of shape {starts.shape}"
        raise ValueError(f"array starts: expected a step from 0 on for each of {count} segments, got {got}")
    return [str(name) for name in episodes], [int(start) for start in starts]


def finite(name: str, values: np.ndarray) -> Floats:
    """(T, X) as float32. Raises `ValueError` for what is not finite there; steps count from 0."""
    with np.errstate(over="ignore"):  # what float32 cannot hold becomes inf
        found: Floats = values.astype(np.float32)
    bad = np.argwhere(~np.isfinite(found))
    if len(bad):
        raise ValueError(f"{name} is {found[tuple(bad[0])]} in step {bad[0][0]}; expected finite float32")
    return found


def named(part: str, one: Segment) -> Segment:
    """A segment that is called after its part and its content: the same one in two pairs is one candidate."""
    content = hashlib.sha256(one.observations.tobytes() + one.actions.tobytes()).hexdigest()[:16]
    return replace(one, episode=f"{part}/{content}")


def read(archive: Arrays, name: str) -> np.ndarray:
    """An array. Raises `ValueError` for one of objects."""
    try:
        return archive[name]
    except ValueError as error:  # objects, which are pickled
        raise ValueError(f"array {name}: {error}{UNLIKE}") from None


def _check_shapes(arrays: Arrays) -> None:
    observations, actions, rewards = arrays["observations"], arrays["actions"], arrays.get("rewards")
    discrete, joined = actions.dtype.kind in "iu", "lengths" in arrays
    dims, steps = 2 if joined else 3, observations.shape[:-1]
    fits = observations.ndim == dims and actions.ndim == dims - discrete and actions.shape[: dims - 1] == steps
    if not fits or (rewards is not None and rewards.shape != steps):
        one_row = "observations (S, O), actions (S, A) and rewards (S,), beside lengths (N,)"
        told = one_row if joined else "observations (N, T, O), actions (N, T, A) and rewards (N, T)"
        shapes = {name: array.shape for name, array in arrays.items()}
        raise ValueError(f"expected {told}, without the A where actions are whole numbers; got {shapes}")
    if observations.dtype.kind != "f" or not (discrete or actions.dtype.kind == "f"):
        got = f"{observations.dtype}, {actions.dtype}"
        raise ValueError(f"expected floats, or whole numbers for discrete actions; got {got}")
    if joined:
        _check_lengths(arrays["lengths"], len(observations))


def _check_lengths(lengths: np.ndarray, steps: int) -> None:
    whole = lengths.ndim == 1 and lengths.dtype.kind in "iu"
    if not whole or not ((lengths > 0) & (lengths <= steps)).all() or lengths.sum() != steps:
        got = f"{lengths.tolist()}" if whole else f"{lengths.dtype} of shape {lengths.shape}"
        raise ValueError(f"array lengths: expected whole numbers above 0 that sum to the {steps} steps, got {got:.100}")


def _one_hot(actions: np.ndarray, archive: Arrays) -> Floats:
    """(...) whole numbers -> (..., A)."""
    low, high = (int(actions.min()), int(actions.max())) if actions.size else (0, 0)
    told = archive.get("action_count", np.array(high + 1))
    if told.ndim or told.dtype.kind not in "iu":
        raise ValueError(f"array action_count: expected one whole number, got {told.dtype} of shape {told.shape}")
    count = min(int(told), LARGEST_COUNT)
    if low < 0 or high >= count:
        raise ValueError(
            f"array actions: expected whole numbers from 0 to {count - 1}, got {low} to {high}; action_count says how "
            "many actions there are"
        )
    found: Floats = (actions[..., None] == np.arange(count)).astype(np.float32)
    return found
