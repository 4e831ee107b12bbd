"""Recorded behaviour: segments in an .npz, the episodes of a Minari data set, or what a store's demonstrations show."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from prefrl.exchange.bundles import is_bundle
from prefrl.kinds import kind_of, only
from prefrl.protocols import ControlTask
from prefrl.storage.log import has_store
from prefrl.store import Store
from prefrl.types import Floats, Segment

ROUNDING = 1e-4
"""By how much an action may lie outside of its bounds: files hold them in few digits."""


class Recording(NamedTuple):
    """All that a file holds."""

    segments: tuple[Segment, ...]
    """At least one; the gold is attached where the file has it."""
    bounds: tuple[Floats, Floats] | None
    """(A,) each of actions, infinite where the file knows none; None where actions are one-hot."""
    names: tuple[str, ...]
    """What each segment is called when something is wrong with it."""


def recording(path: Path) -> Recording:
    """Read a file of segments or of pairs of them (.npz), or the folder of a Minari data set or of demonstrations.

    Actions that are all one-hot are discrete. Raises `ValueError` for anything else, and where sizes differ.
    """
    found, bounds = _read(path)
    sizes = {(one.observations.shape[1], one.actions.shape[1]) for one in found.values()}
    if len(sizes) != 1:
        got = " and ".join(map(str, sorted(sizes))) or "no segment"
        raise ValueError(f"{path}: expected observations and actions of one size each, got {got}")
    ((_, size),) = sizes
    free = (np.full(size, -np.inf, np.float32), np.full(size, np.inf, np.float32))
    discrete = size > 1 and all(is_one_hot(one.actions) for one in found.values())
    return Recording(tuple(found.values()), None if discrete else bounds or free, tuple(found))


def _read(path: Path) -> tuple[dict[str, Segment], tuple[Floats, Floats] | None]:
    """The segments, by what each is called, and the bounds of actions, where they are known."""
    if path.suffix == ".npz" and path.is_file():
        from prefrl.exchange.segment_pairs import segments

        return {f"{path}, {place}": one for place, one in segments(path).items()}, None
    if (path / "metadata.json").exists():
        from prefrl.exchange.minari_folders import episodes

        found, bounds = episodes(path)
        return {f"{path}, episode {number}": one for number, one in enumerate(found)}, bounds
    if has_store(path):
        return {f"{called(one)} ({number} of {path})": one for number, one in enumerate(_demonstrated(path), 1)}, None
    if is_bundle(path):
        raise ValueError(
            f"{path} is a bundle: import it first (prefrl import {path} --out FOLDER), and name the folder"
        )
    raise ValueError(
        f"{path}: expected an .npz file of segments, or the folder of a Minari data set or of demonstrations"
    )


def recorded(path: Path, task: ControlTask) -> tuple[Segment, ...]:
    """Behaviour of any length to be imitated. Raises `ValueError` where it cannot be."""
    found = recording(path)
    for name, one in zip(found.names, found.segments, strict=True):
        check_imitable(one, task, name)
    return found.segments


def called(one: Segment) -> str:
    """What a demonstration is called where no file has it."""
    return f"the demonstration {one.episode!r} from step {one.start}"


def check_imitable(one: Segment, task: ControlTask, name: str = "") -> None:
    """Raise `ValueError` where a behaviour, which is called by its name, cannot be imitated in a task."""
    kind, bounds = kind_of(one), task.action_bounds
    fault = kind.misfit(one, task) or kind.fault(one) or ("has no step" if not len(one) else "")
    if not fault and bounds is None and not is_one_hot(one.actions):
        fault = "has actions that are not one-hot, and those of the task are discrete"
    if not fault and bounds is not None:
        low, high = (np.asarray(side) for side in bounds)
        outside = (one.actions < low - ROUNDING) | (one.actions > high + ROUNDING)
        if outside.any():
            step = int(outside.any(1).argmax())
            fault = f"has the action {one.actions[step]} in step {step}, outside of the bounds {low} to {high}"
    if fault:
        raise ValueError(f"{name or called(one)} {fault}: leave it out, or mend it")


def _demonstrated(folder: Path) -> list[Segment]:
    with Store[Segment](folder, write=False) as store:
        shown = [one.like for one in store.demonstrations()]
    if not shown:
        raise ValueError(f"{folder} holds no demonstration: make some with prefrl demonstrate, or import them")
    return only(Segment, shown, ValueError(f"{folder} holds demonstrations of text: expected those of control"))


def is_one_hot(actions: Floats) -> bool:
    """Whether each step (T, A) has a single 1, and else 0."""
    return bool(np.isin(actions, (0.0, 1.0)).all() and (actions.sum(1) == 1).all())
