"""Recorded behaviour as demonstrations: each segment of an .npz, or episode of a Minari data set, in which nothing is
judged, is a query of one candidate that stands for itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial
from pathlib import Path

from prefrl.exchange.layout import Layout, Parts, Row
from prefrl.exchange.segment_arrays import named
from prefrl.judgements import Demonstration
from prefrl.kinds import kind_of
from prefrl.storage.events import check_text
from prefrl.types import Query, Segment

REWARDS = "row of rewards: a demonstration says what to do, not what it was worth"


def is_behaviour(path: Path) -> bool:
    """Whether a path is recorded behaviour that nobody has judged. Raises `ValueError` for a damaged .npz."""
    if path.is_dir():
        from prefrl.exchange.minari_folders import is_unjudged

        return is_unjudged(path)
    if path.suffix != ".npz":
        return False
    from prefrl.exchange.segment_pairs import judges

    return not judges(path)


def behaviour_rows(path: Path, layout: Layout) -> Parts:
    """(row or episode N, what reads it) for each demonstration.

    One is called as the file calls its episode; where that has no name, after its place and its content, so that two
    that are alike are two, and that a second reading changes nothing. Raises `ValueError` where arrays do not fit.
    """
    if layout.columns or layout.form not in ("auto", "demonstrations"):
        raise ValueError(
            f"{path} is recorded behaviour, whose segments are demonstrations: --map, and a --form other than "
            "demonstrations, are for rows"
        )
    for place, make in _each(path):
        yield place, partial(_demonstration, place, make)


def _each(path: Path) -> Iterator[tuple[str, Callable[[], Segment]]]:
    if path.is_dir():
        from prefrl.exchange.minari_folders import each

        yield from each(path)
        return
    from prefrl.exchange import segment_arrays

    with segment_arrays.archived(path) as archive:
        yield from segment_arrays.each(archive)


def _demonstration(place: str, make: Callable[[], Segment]) -> Sequence[Row | str]:
    one = make()
    one = one if one.episode else named(place, one)
    check_text("its episode", one.episode)
    if fault := kind_of(one).fault(one) or ("" if len(one) else "has no step"):
        raise ValueError(f"it {fault}")
    query = Query((one,))
    return [Row(query, Demonstration(query.id, one.id)), *([] if one.gold is None else [REWARDS])]
