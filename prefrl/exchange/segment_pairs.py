"""Judged pairs of segments in an .npz, as Preference Transformer's data lies (Kim et al. 2023).

For each part P ("train", "eval") arrays `P_obs_1`, `P_obs_2` (pairs, T, O), `P_action_1`, `P_action_2` (pairs, T, A),
and for each labeler L `P_label_L` (pairs,): 0 where the first segment is better, 1 where the second is, 0.5 for a tie.

Or ranked behaviour, as T-REX learns from it (Brown et al. 2019): the arrays that `segment_arrays` describes and `ranks`
(N,), the lower the better. Each two segments are a pair; of equal ranks they are a tie.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from functools import partial
from itertools import combinations
from pathlib import Path

import numpy as np

from prefrl.exchange.layout import Parts, Row
from prefrl.exchange.segment_arrays import Arrays, archived, finite, named, read, rows
from prefrl.judgements import Comparison
from prefrl.types import Fields, Query, Segment

ARRAYS = ("obs_1", "obs_2", "action_1", "action_2")
RANKS = "ranks"


def segment_pairs(path: Path) -> Parts:
    """(part and row, what reads it) for each pair. Raises `ValueError` where arrays are missing or do not fit."""
    with archived(path) as archive:
        if RANKS in archive:
            yield from _ranked(archive)
            return
        splits = _splits(archive)
        if not splits:
            raise ValueError(_nothing(archive))
        for split in splits:
            arrays, labels = _arrays(archive, split)
            for i in range(len(arrays["obs_1"])):
                yield f"{split}, row {i + 1}", partial(_rows, arrays, labels, split, i)


def judges(path: Path) -> bool:
    """Whether a file is of pairs or ranks, and not of segments that nobody judged.

    Raises `ValueError` for what is neither.
    """
    with archived(path) as archive:
        if not (_splits(archive) or "observations" in archive):
            raise ValueError(_nothing(archive))
        return bool(_splits(archive)) or RANKS in archive


def segments(path: Path) -> dict[str, Segment]:
    """Every distinct segment of pairs, judged or not, or of the arrays that `segment_arrays` describes, by its place.

    Raises `ValueError` as `segment_pairs` does.
    """
    with archived(path) as archive:
        if "observations" in archive:
            return rows(archive)
        if not (splits := _splits(archive)):
            raise ValueError(_nothing(archive))
        found: dict[str, tuple[str, Segment]] = {}
        for split in splits:
            arrays, _ = _arrays(archive, split)
            for i in range(len(arrays["obs_1"])):
                for side in ("1", "2"):
                    one = _segment(arrays, split, side, i)
                    found.setdefault(one.id, (f"{split}, row {i + 1}, segment {side}", one))
        return dict(found.values())


def _ranked(archive: Arrays) -> Parts:
    """(two rows, what reads them) for each two segments of ranked behaviour."""
    if splits := _splits(archive):
        raise ValueError(f"arrays of judged pairs ({splits[0]}_obs_1) and array ranks: put them into a file each")
    found = {place: replace(one, gold=None) for place, one in rows(archive).items()}  # ranks stand for themselves
    ranks = read(archive, RANKS)
    if ranks.shape != (len(found),) or ranks.dtype.kind not in "fiu" or not np.isfinite(ranks).all():
        got = f"{ranks.dtype} of shape {ranks.shape}"
        raise ValueError(f"array ranks: expected a finite number for each of {len(found)} segments, got {got}")
    if len(found) < 2:
        raise ValueError("array ranks: expected at least two segments to be ranked, got one")
    for (one, first), (other, second) in combinations(zip(found, ranks.tolist(), strict=True), 2):
        pair, value = (found[one], found[other]), 0.5 + 0.5 * float(np.sign(first - second))
        yield f"{one} and {other}", partial(_pair, pair, value)


def _pair(pair: tuple[Segment, Segment], value: float) -> list[Row | str]:
    if pair[0].id == pair[1].id:
        raise ValueError("both are the same segment: leave one out")
    return [_compared(pair, value)]


def _compared(pair: tuple[Segment, Segment], value: float, labeler: str = "", split: str = "") -> Row:
    """A comparison whose value says how probably the second is better, as the labels of a file do."""
    query = Query(pair)
    swapped = query.candidates[0].id != pair[0].id  # a query sorts its candidates by id
    return Row(query, Comparison(query.id, value if swapped else 1.0 - value, labeler), split)


def _splits(archive: Arrays) -> list[str]:
    return [name.removesuffix("_obs_1") for name in archive if name.endswith("_obs_1")]


def _nothing(archive: Arrays) -> str:
    known = ", ".join(archive) or "none"
    return f"expected arrays named train_obs_1 and so on, or observations and actions, got {known}"


def _arrays(file: Fields, split: str) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """The segments of a part, and its labels by labeler."""
    if missing := [f"{split}_{name}" for name in ARRAYS if f"{split}_{name}" not in file]:
        raise ValueError(f"array {missing[0]} is missing")
    prefix = f"{split}_label_"
    arrays = {name: file[f"{split}_{name}"] for name in ARRAYS}
    labels = {name.removeprefix(prefix): file[name] for name in file if name.startswith(prefix)}
    if not labels:
        raise ValueError(f"expected labels {prefix}human, say; there are none")
    pairs, steps = arrays["obs_1"].shape[:2] if arrays["obs_1"].ndim == 3 else (-1, -1)
    for name, array in arrays.items():
        twin = arrays["obs_1" if name.startswith("obs") else "action_1"]
        if array.ndim != 3 or array.shape != twin.shape or array.shape[:2] != (pairs, steps):
            shapes = ", ".join(str(a.shape) for a in arrays.values())
            raise ValueError(f"{split}_{name}: expected (pairs, T, O) twice and (pairs, T, A) twice, got {shapes}")
        if array.dtype.kind != "f":
            raise ValueError(f"{split}_{name}: expected floats (one-hot for discrete actions), got {array.dtype}")
    for name, array in labels.items():
        if array.shape != (pairs,) or array.dtype.kind not in "fiu":
            got = f"{array.dtype} of shape {array.shape}"
            raise ValueError(f"{prefix}{name}: expected a number for each of {pairs} pairs, got {got}")
    return arrays, labels


def _rows(arrays: Mapping[str, np.ndarray], labels: Mapping[str, np.ndarray], split: str, i: int) -> list[Row | str]:
    """One pair with every labeler's judgement on it."""
    first, second = (_segment(arrays, split, side, i) for side in ("1", "2"))
    found: list[Row | str] = []
    for labeler, values in labels.items():
        value = float(values[i])
        if not 0.0 <= value <= 1.0:
            raise ValueError(f"label_{labeler}: expected 0 (first better) to 1 (second better), got {value}")
        found.append(_compared((first, second), value, labeler, split))
    return found


def _segment(arrays: Mapping[str, np.ndarray], split: str, side: str, i: int) -> Segment:
    seen, done = (finite(f"{name}_{side}", arrays[f"{name}_{side}"][i]) for name in ("obs", "action"))
    return named(split, Segment(seen, done, "", 0))
