"""The rows of a file: how they are laid out, which of them count, and the answer that each gives."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple, TypeAlias

from prefrl.judgements import Answer, Choice, Comparison, Judged, Ranking, Rating, Skip, person
from prefrl.storage.events import check_answer
from prefrl.types import Query, Response, is_whole


class Row(NamedTuple):
    """One answer of a file."""

    query: Query[Any]
    answer: Answer
    """Its labeler is "" where the file names none."""
    split: str = ""
    """The part of the data that the file puts it into; "" where it says nothing."""
    named: str = ""
    """The query of a store that it was written from; "" where the file names none."""
    there: str = ""
    """Its labeler, numbered among the answers to the query that is named."""

    @property
    def judged(self) -> Judged[Any]:
        """The judgement; for rows that are no skip."""
        if self.answer.reason is not None:
            raise ValueError("a skip is no judgement")
        return Judged(self.query, self.answer)


Parts: TypeAlias = Iterable[tuple[str, Callable[[], Sequence[Row | str]]]]
"""(place, parse): where a part of a file stands, and what reads it: answers, and reasons for leaving some out."""


@dataclass(frozen=True)
class Layout:
    """How the rows of a file are to be read."""

    form: str = "auto"
    """Which of `text_rows.FORMS` they have; "auto" looks at each row's columns."""
    columns: tuple[tuple[str, str], ...] = ()
    """(ours, the file's): which of its columns are to be read as what; when given, nothing else is read."""
    skip_bad: bool = False
    """Leave bad rows out, and tell of them, instead of refusing the file."""

    @classmethod
    def of(cls, form: str = "auto", columns: str = "", skip_bad: bool = False) -> Layout:
        """From names as `prompt=question,chosen=better,rejected=worse`."""
        pairs = [pair.partition("=") for pair in columns.split(",") if pair.strip()]
        if bad := ["".join(pair) for pair in pairs if not (pair[0].strip() and pair[2].strip())]:
            raise ValueError(f"expected columns as prompt=question,chosen=better, got {bad[0]!r}")
        return cls(form, tuple((ours.strip(), theirs.strip()) for ours, _, theirs in pairs), skip_bad)


@dataclass(frozen=True)
class Which:
    """Which judgements of a source count."""

    labelers: tuple[str, ...] = ()
    """By whom; everybody when empty."""
    split: str = ""
    """Of which part of a file, "train" or "eval" say; all when empty."""

    @classmethod
    def of(cls, labelers: str, split: str) -> Which:
        """From names that are separated by commas."""
        return cls(tuple(name.strip() for name in labelers.split(",") if name.strip()), split)

    def takes(self, labeler: str) -> bool:
        """Whether a labeler's judgements count; "human#2" gave the second judgement of "human" on the same query."""
        return not self.labelers or person(labeler) in self.labelers


VERDICTS = ("ranks", "best", "ratings", "preference", "skip")
"""Columns of which one says the answer."""


def answer_of(row: Mapping[str, Any], candidates: Sequence[Any]) -> Row:
    """The answer that a row gives to the candidates that it lists. Raises `ValueError` unless it gives just one."""
    given = [name for name in VERDICTS if row.get(name) is not None]
    if len(given) != 1:
        raise ValueError(f"expected one of {', '.join(VERDICTS)}, got {', '.join(given) or 'none'}")
    return answered(row, candidates, partial(_GIVEN[given[0]], row))


def answered(row: Mapping[str, Any], candidates: Sequence[Any], verdict: Callable[..., Answer]) -> Row:
    """A query over candidates, and an answer in the query's own order.

    `verdict` is given `order`, where `order[i]` is where candidate i stands in the query.
    """
    query = Query[Any](tuple(candidates))
    place = {candidate.id: i for i, candidate in enumerate(query.candidates)}
    order = [place[candidate.id] for candidate in candidates]
    who = {
        "labeler": optional(row, "labeler", str, ""),
        "shown": _shown(row, order),
        "weight": number(row, "weight", 1.0),
    }
    answer = verdict(query=query.id, order=order, who=who)
    check_answer(answer, len(candidates))
    named = row.get("query")  # in files of others this may be anything
    return Row(query, answer, optional(row, "split", str, ""), named if isinstance(named, str) else "")


def responses(prompt: str, texts: Sequence[str]) -> list[Response]:
    """Texts as responses to a prompt."""
    return [Response(prompt, text) for text in texts]


def _shown(row: Mapping[str, Any], order: Sequence[int]) -> tuple[int, ...]:
    """Which candidate stood in each place, where the row says it of its own responses."""
    shown = row.get("shown")
    if not shown:
        return ()
    if not isinstance(shown, list) or not all(map(is_whole, shown)) or sorted(shown) != list(range(len(order))):
        raise ValueError(f"column 'shown': expected each of 0 to {len(order) - 1} once, got {shown!r:.200}")
    return tuple(order[i] for i in shown)


def comparison(first_better: float, query: str, order: Sequence[int], who: dict[str, Any]) -> Comparison:
    return Comparison(query, first_better if order[0] == 0 else 1.0 - first_better, **who)


def _preference(row: Mapping[str, Any], query: str, order: Sequence[int], who: dict[str, Any]) -> Comparison:
    value = row["preference"]
    if len(order) != 2 or isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"a preference is a number, of the first of two responses; got {value!r} for {len(order)}")
    if not 0.0 <= value <= 1.0:
        raise ValueError(f"a preference must lie in [0, 1], got {value}")
    return comparison(float(value), query, order, who)


def _ranking(row: Mapping[str, Any], query: str, order: Sequence[int], who: dict[str, Any]) -> Ranking:
    return Ranking(query, _integers(row["ranks"], "ranks", order), **who)


def _choice(row: Mapping[str, Any], query: str, order: Sequence[int], who: dict[str, Any]) -> Choice:
    best = row["best"]
    if isinstance(best, bool) or not isinstance(best, int) or not 0 <= best < len(order):
        raise ValueError(f"best: expected the number of a response, from 0 to {len(order) - 1}, got {best!r}")
    return Choice(query, order[best], **who)


def _skip(row: Mapping[str, Any], query: str, order: Sequence[int], who: dict[str, Any]) -> Skip:
    if row["skip"] not in ("skip", "incomparable"):
        raise ValueError(f"skip: expected skip or incomparable, got {row['skip']!r:.200}")
    return Skip(query, row["skip"], who["labeler"], who["shown"])


def _rating(row: Mapping[str, Any], query: str, order: Sequence[int], who: dict[str, Any]) -> Rating:
    scale = row.get("scale")
    if isinstance(scale, bool) or not isinstance(scale, int):
        raise ValueError(f'ratings need "scale", how many levels there are; got {scale!r}')
    return Rating(query, _integers(row["ratings"], "ratings", order), scale, **who)


_GIVEN: Mapping[str, Callable[..., Answer]] = {
    "ranks": _ranking,
    "best": _choice,
    "ratings": _rating,
    "preference": _preference,
    "skip": _skip,
}


def _integers(values: Any, name: str, order: Sequence[int]) -> tuple[int, ...]:
    """One integer for each response, put into the query's order."""
    whole = isinstance(values, list) and all(isinstance(v, int) and not isinstance(v, bool) for v in values)
    if not whole or len(values) != len(order):
        raise ValueError(f"{name}: expected an integer for each of {len(order)} responses, got {values!r:.200}")
    by_place = dict(zip(order, values, strict=True))
    return tuple(by_place[i] for i in range(len(order)))


def optional(row: Mapping[str, Any], name: str, kind: Any, default: Any) -> Any:
    """A value that may be left out; a table has None there."""
    value = row.get(name)
    if value is None:
        return default
    if not isinstance(value, kind) or isinstance(value, bool):
        raise ValueError(f"column {name!r}: expected {getattr(kind, '__name__', 'number')}, got {value!r:.200}")
    return value


def number(row: Mapping[str, Any], name: str, default: float) -> float:
    """A number that may be left out. Raises `ValueError` where it is not finite: a table may hold NaN."""
    try:
        value = float(optional(row, name, (int, float), default))
    except OverflowError:
        value = math.inf
    if not math.isfinite(value):
        raise ValueError(f"column {name!r}: expected a finite number, got {row[name]!r:.40}")
    return value
