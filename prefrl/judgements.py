"""The judgements: what can be answered to a query. NumPy and the standard library only."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Generic, Literal, TypeAlias

from prefrl.types import C, Query, is_whole


@dataclass(frozen=True)
class Comparison:
    """Two candidates judged."""

    query: str
    preference: float
    """In [0, 1]: the probability that the first candidate is better; 0.5 is a tie, a strength lies between."""
    labeler: str = ""
    shown: tuple[int, ...] = ()
    """The order in which the candidates were shown; the preference itself is in the query's own order."""
    weight: float = 1.0
    """How much the judgement counts in a fit."""

    def __post_init__(self) -> None:
        check_weight(self.weight)
        if not 0.0 <= self.preference <= 1.0:
            raise ValueError(f"a preference must lie in [0, 1], got {self.preference}")


@dataclass(frozen=True)
class Ranking:
    """K candidates judged."""

    query: str
    ranks: tuple[int, ...]
    """A rank for each candidate, in the query's own order; 0 is best, equal ranks are ties."""
    labeler: str = ""
    shown: tuple[int, ...] = ()
    weight: float = 1.0

    def __post_init__(self) -> None:
        check_weight(self.weight)
        if len(self.ranks) < 2 or not all(is_whole(rank) for rank in self.ranks):
            raise ValueError(f"a ranking needs a whole rank >= 0 for each of at least 2 candidates, got {self.ranks}")


@dataclass(frozen=True)
class Choice:
    """The best of K candidates; nothing is said of the others."""

    query: str
    best: int
    """Which candidate, counted from 0 in the query's own order."""
    labeler: str = ""
    shown: tuple[int, ...] = ()
    weight: float = 1.0

    def __post_init__(self) -> None:
        check_weight(self.weight)
        if not is_whole(self.best):
            raise ValueError(f"the best candidate is counted from 0, got {self.best}")


@dataclass(frozen=True)
class Rating:
    """Each candidate on a scale of its own right, such as one to five stars."""

    query: str
    levels: tuple[int, ...]
    """A level for each candidate, in the query's own order; 0 is worst, `scale` - 1 is best."""
    scale: int
    """How many levels there are."""
    labeler: str = ""
    shown: tuple[int, ...] = ()
    weight: float = 1.0

    def __post_init__(self) -> None:
        check_weight(self.weight)
        right = all(is_whole(level) and level < self.scale for level in self.levels)
        if not (is_whole(self.scale) and self.scale >= 2 and self.levels and right):
            raise ValueError(
                f"a rating needs whole levels from 0 to scale - 1, got {self.levels} on a scale of {self.scale}"
            )


def person(labeler: str) -> str:
    """Who gave a judgement: NAME, also of NAME#2, which is their second answer to a question in one file."""
    name, mark, number = labeler.rpartition("#")
    return name if name and mark and number.isdigit() else labeler


@dataclass(frozen=True)
class Skip:
    """No judgement. A skip may be asked again of someone else; incomparable says that there is no answer."""

    query: str
    reason: Literal["skip", "incomparable"] = "skip"
    labeler: str = ""
    shown: tuple[int, ...] = ()


Judgement: TypeAlias = Comparison | Ranking | Choice | Rating


Answer: TypeAlias = Judgement | Skip


@dataclass(frozen=True)
class Judged(Generic[C]):
    """A query with one judgement on it. Raises `ValueError` where the two do not fit."""

    query: Query[C]
    judgement: Judgement

    def __post_init__(self) -> None:
        if self.judgement.query != self.query.id:
            raise ValueError(f"query {self.query.id[:12]} got a judgement of query {self.judgement.query[:12]}")
        check_fits(self.judgement, len(self.query.candidates))


def check_fits(answer: Answer, size: int) -> None:
    """Raise `ValueError` where an answer does not fit a query of `size` candidates."""
    match answer:
        case Comparison():
            fits = size == 2
        case Ranking(ranks=ranks):
            fits = size == len(ranks)
        case Choice(best=best):
            fits = size >= 2 and best < size
        case Rating(levels=levels):
            fits = size == len(levels)
        case Skip():
            fits = True
    if not fits:
        raise ValueError(f"query {answer.query[:12]} has {size} candidates; got {answer}")


def check_weight(weight: float) -> None:
    """Raise `ValueError` for a weight that says nothing."""
    if not 0.0 < weight < math.inf:
        raise ValueError(f"a judgement's weight must be positive and finite, got {weight}")
