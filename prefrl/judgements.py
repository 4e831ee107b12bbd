"""The answers: judgements, demonstrations, and none. NumPy and the standard library only."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import ClassVar, Generic, Literal, TypeAlias

from prefrl.types import C, Json, Query, is_whole


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
    reason: ClassVar[None] = None
    """There is a judgement, so no reason why there is none; see `Skip`."""

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
    reason: ClassVar[None] = None

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
    reason: ClassVar[None] = None

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
    reason: ClassVar[None] = None

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


@dataclass(frozen=True)
class Demonstration:
    """An answer that is a behaviour: "like this". It answers a query of one candidate, the learner's own.

    In control the behaviour has an expert's actions in the states of the query, or is an episode that stands for
    itself; in text it is a better response.
    """

    query: str
    like: str
    """The id of the candidate that shows what to do; the query's own where that stands for itself."""
    labeler: str = ""
    shown: tuple[int, ...] = ()
    weight: float = 1.0
    reason: ClassVar[Literal["demonstration"]] = "demonstration"
    """Why there is no judgement: it says what to do."""

    def __post_init__(self) -> None:
        check_weight(self.weight)


Judgement: TypeAlias = Comparison | Ranking | Choice | Rating


Answer: TypeAlias = Judgement | Demonstration | Skip


@dataclass(frozen=True)
class Demonstrated(Generic[C]):
    """A query with the behaviour that answers it. Raises `ValueError` where the two do not fit."""

    query: Query[C]
    like: C
    demonstration: Demonstration

    def __post_init__(self) -> None:
        check_fits(self.demonstration, len(self.query.candidates))
        if (self.demonstration.query, self.demonstration.like) != (self.query.id, self.like.id):
            raise ValueError(f"query {self.query.id[:12]} got a demonstration of query {self.demonstration.query[:12]}")
        if self.like.context != self.query.candidates[0].context:
            raise ValueError(f"query {self.query.id[:12]} is answered by a behaviour of another context (prompt)")

    def told_apart(self, weight: float) -> list[Judged[C]]:
        """That the one was shown and the other is the learner's own, each for itself, as ratings on a scale of two: a
        discriminator's labels (Ho and Ermon 2016). Nothing where a behaviour stands for itself."""
        if self.implied(weight) is None:
            return []
        shown, piles = self.demonstration, (self.query, Query((self.like,)))
        weight *= shown.weight
        return [Judged(q, Rating(q.id, (level,), 2, shown.labeler, weight=weight)) for level, q in enumerate(piles)]

    def implied(self, weight: float) -> Judged[C] | None:
        """That what was shown is better than the learner's own (Ibarz et al. 2018), with `weight` times the weight of
        the demonstration; None where a behaviour stands for itself."""
        (own,) = self.query.candidates
        if own.id == self.like.id:
            return None
        pair = Query((own, self.like))
        first = float(pair.candidates[0].id == self.like.id)
        shown = self.demonstration
        return Judged(pair, Comparison(pair.id, first, shown.labeler, weight=weight * shown.weight))


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
        case Demonstration():
            fits = size == 1
        case Skip():
            fits = True
    if not fits:
        raise ValueError(f"query {answer.query[:12]} has {size} candidates; got {answer}")


# --- what an answer says ----------------------------------------------------------------------------------------------

Pair: TypeAlias = tuple[int, int, float]
"""(i, j, preference that i is better)."""


def implied_pairs(judgement: Judgement, size: int) -> list[Pair]:
    """One for each pair of `size` candidates that the judgement speaks of."""
    match judgement:
        case Comparison(preference=preference):
            return [(0, 1, preference)]
        case Choice(best=best):
            return [(best, j, 1.0) for j in range(size) if j != best]
        case Ranking(ranks=ranks):
            worth = [-rank for rank in ranks]
        case Rating(levels=levels):
            worth = list(levels)
    signs = ((i, j, (worth[i] > worth[j]) - (worth[i] < worth[j])) for i, j in combinations(range(size), 2))
    return [(i, j, 0.5 + 0.5 * sign) for i, j, sign in signs]


def best_of(answer: Answer) -> int | None:
    """The one candidate that an answer puts above every other; None where there is none."""
    match answer:
        case Comparison(preference=preference):
            worth = [int(preference > 0.5) - int(preference < 0.5), 0]
        case Ranking(ranks=ranks):
            worth = [-rank for rank in ranks]
        case Rating(levels=levels):
            worth = list(levels)
        case Choice(best=best):
            return best
        case Demonstration() | Skip():
            return None
    return worth.index(max(worth)) if worth.count(max(worth)) == 1 else None


def good(judgement: Judgement, size: int) -> list[bool | None]:
    """For each candidate whether it is good; None where that is not said.

    A rating is good in the upper half of its scale. In what compares, a candidate is good that is better than another
    and worse than none, and bad the other way round.
    """
    if isinstance(judgement, Rating):
        middle = (judgement.scale - 1) / 2
        return [None if level == middle else level > middle for level in judgement.levels]
    better, worse = set[int](), set[int]()
    for i, j, preference in implied_pairs(judgement, size):
        if preference != 0.5:
            better.add(i if preference > 0.5 else j)
            worse.add(j if preference > 0.5 else i)
    return [None if (k in better) == (k in worse) else k in better for k in range(size)]


def moved(answer: Answer, places: Sequence[int]) -> Answer:
    """The answer where candidate i of its query stands in place `places[i]`."""
    answer = replace(answer, shown=tuple(places[i] for i in answer.shown))
    match answer:
        case Comparison(preference=preference):
            return replace(answer, preference=preference if places[0] == 0 else 1.0 - preference)
        case Ranking(ranks=ranks):
            return replace(answer, ranks=_in_places(ranks, places))
        case Rating(levels=levels):
            return replace(answer, levels=_in_places(levels, places))
        case Choice(best=best):
            return replace(answer, best=places[best])
        case Demonstration() | Skip():
            return answer


def _in_places(values: Sequence[int], places: Sequence[int]) -> tuple[int, ...]:
    by_place = dict(zip(places, values, strict=True))
    return tuple(by_place[place] for place in range(len(values)))


def same(one: Answer, other: Answer) -> bool:
    """Whether two answers say the same of the same query, preferences but for rounding."""
    if isinstance(one, Comparison) and isinstance(other, Comparison):
        # A file that counts from the other side holds 1 - p, which has been rounded.
        close = abs(one.preference - other.preference) < 1e-9
        return close and replace(one, preference=other.preference) == other
    return one == other


def columns(answer: Answer) -> Json:
    """The answer as the columns of a row that lists its candidates in the query's order."""
    match answer:
        case Comparison(preference=preference):
            return {"preference": preference}
        case Ranking(ranks=ranks):
            return {"ranks": list(ranks)}
        case Choice(best=best):
            return {"best": best}
        case Rating(levels=levels, scale=scale):
            return {"ratings": list(levels), "scale": scale}
        case Demonstration(like=like):
            return {"like": like}
        case Skip(reason=reason):
            return {"skip": reason}


def is_soft(answer: Answer) -> bool:
    """Whether it says how strong a preference is: one that is neither a tie nor a certainty."""
    return isinstance(answer, Comparison) and answer.preference not in (0.0, 0.5, 1.0)


def is_pairwise(answer: Answer) -> bool:
    """Whether nothing is lost when its pairs are written in its place."""
    return isinstance(answer, Comparison | Skip)


# --- checked ----------------------------------------------------------------------------------------------------------


def check_weight(weight: float) -> None:
    """Raise `ValueError` for a weight that says nothing."""
    if not 0.0 < weight < math.inf:
        raise ValueError(f"the weight of an answer must be positive and finite, got {weight}")
