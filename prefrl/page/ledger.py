"""The answers of a log in columns, as far as it was read: what the dashboard's figures are made of.

A log only grows, so each event is looked at once, and new ones cost what they are.
"""

from __future__ import annotations

from array import array
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime

import numpy as np

from prefrl.judgements import Answer, best_of, implied_pairs
from prefrl.storage.events import ANSWER_TYPES, read_answer
from prefrl.types import Fields, Floats

JUDGED, SKIPPED, INCOMPARABLE = 0, 1, 2
LABEL, CHECK, REPEAT = 0, 1, 2
RIGHT, LEFT, TIE, UNKNOWN = 0, 1, 2, -1
MOST_CANDIDATES = 4096
"""In a query: pairs of candidates are told apart by numbers that a double holds exactly."""
FLAGS = 50
"""How many of the last reported problems are kept."""
KINDS = ("query", *ANSWER_TYPES, "retract", "repeat", "flag")
"""Events that a ledger reads; those of candidates too, where there are clips."""
ROWS = ("query", "person", "purpose", "word", "first", "hit", "seconds", "clip", "at")
"""Columns of answers: `first` is which of the two that were shown first is preferred, by place; `hit` whether the best
candidate of a check question was found (-1 for no check); `seconds` to the decision, and `clip` until the longest clip
has played once, NaN where not known; `at` in seconds since 1970."""
PAIRS = ("row", "item", "preference", "one", "other")
"""Columns of the pairs that the judgements imply: which pair of which query, the preference for the one before the
other in the query's own order, and, of queries of two, the numbers of the candidates (else -1)."""
Signature = tuple[tuple[int, int, float], ...] | str | None
"""What an answer says, strength aside: (i, j, sign) with i < j, or "incomparable"; None for a skip."""


@dataclass(frozen=True)
class Asked:
    number: int
    candidates: tuple[int, ...]
    expected: int | None
    """The clearly best candidate of a check question."""
    clip: float


@dataclass
class Ledger:
    """See the module's docstring. `fps` is None where there are no clips."""

    fps: float | None = None
    queries: dict[str, Asked] = field(default_factory=dict)
    people: dict[str, int] = field(default_factory=dict)
    """Name -> number, of everybody who ever answered."""
    standing: dict[tuple[int, int], int] = field(default_factory=dict)
    """(query, person) -> the row of the answer that stands."""
    repeats: list[tuple[int, int, int]] = field(default_factory=list)
    """(row, query, person) of answers to repeated questions."""
    signatures: list[Signature] = field(default_factory=list)
    """Of each row."""
    flags: deque[dict[str, str]] = field(default_factory=lambda: deque(maxlen=FLAGS))
    """Reported problems, newest first."""
    _rows: dict[str, array[float]] = field(default_factory=lambda: {name: array("d") for name in ROWS})
    _pairs: dict[str, array[float]] = field(default_factory=lambda: {name: array("d") for name in PAIRS})
    _candidates: dict[str, int] = field(default_factory=dict)
    _steps: dict[str, int] = field(default_factory=dict)

    @property
    def rows(self) -> dict[str, Floats]:
        """The columns of all answers ever given, retracted ones too."""
        return {name: np.array(column) for name, column in self._rows.items()}

    @property
    def pairs(self) -> dict[str, Floats]:
        """The columns of the pairs that they imply."""
        return {name: np.array(column) for name, column in self._pairs.items()}

    def read(self, event: Fields) -> None:
        """The next event of the log; kinds that say nothing of answers are passed over."""
        reader = _READERS.get(event["kind"])
        if reader is not None:
            reader(self, event)

    def _candidate(self, event: Fields) -> None:
        self._steps[event["id"]] = event["body"].get("steps", 0)

    def _query(self, event: Fields) -> None:
        body = event["body"]
        steps = max(self._steps.get(id, 0) for id in body["candidates"])
        numbers = (self._candidates.setdefault(id, len(self._candidates)) for id in body["candidates"])
        self.queries[event["id"]] = Asked(
            number=len(self.queries),
            candidates=tuple(numbers),
            expected=body.get("expected") if body.get("purpose") == "check" else None,
            clip=steps / self.fps if self.fps and steps else np.nan,
        )

    def _answer(self, event: Fields) -> None:
        answer = read_answer(event["kind"], event["subject"], event["actor"], event["body"])
        at = self._add(event, answer, event["body"].get("about"), repeat=False)
        if at is not None:
            self.standing[at[1:]] = at[0]

    def _repeat(self, event: Fields) -> None:
        body = event["body"]
        said = {name: value for name, value in body["answer"].items() if name != "kind"}
        answer = read_answer(body["answer"]["kind"], event["subject"], event["actor"], said)
        at = self._add(event, answer, body.get("about"), repeat=True)
        if at is not None:
            self.repeats.append(at)

    def _retract(self, event: Fields) -> None:
        asked = self.queries.get(event["subject"])
        if asked is not None:
            self.standing.pop((asked.number, self.people.get(event["actor"], -1)), None)

    def _flag(self, event: Fields) -> None:
        text = str(event["body"].get("text", ""))
        self.flags.appendleft({"at": event["at"], "actor": event["actor"], "query": event["subject"], "text": text})

    def _add(self, event: Fields, answer: Answer, about: Fields | None, repeat: bool) -> tuple[int, int, int] | None:
        """A row for an answer: (row, query, person); None where its query is not known."""
        asked = self.queries.get(answer.query)
        if asked is None:
            return None
        pairs = said(answer, len(asked.candidates))
        place = (len(self.signatures), asked.number, self.people.setdefault(event["actor"], len(self.people)))
        milliseconds = ((about or {}).get("timings") or {}).get("decision_ms") or np.nan
        row = (
            asked.number,
            place[2],
            REPEAT if repeat else LABEL if asked.expected is None else CHECK,
            word(answer),
            first_shown(pairs, answer.shown),
            UNKNOWN if asked.expected is None else best_of(answer) == asked.expected,
            milliseconds / 1000,
            asked.clip,
            datetime.fromisoformat(event["at"]).timestamp(),
        )
        for column, value in zip(self._rows.values(), row, strict=True):
            column.append(value)
        self.signatures.append(signature(answer, pairs))
        self._add_pairs(place[0], asked, pairs)
        return place

    def _add_pairs(self, row: int, asked: Asked, pairs: list[tuple[int, int, float]]) -> None:
        one, other = asked.candidates if len(asked.candidates) == 2 else (-1, -1)
        for i, j, preference in pairs:
            item = (asked.number * MOST_CANDIDATES + i) * MOST_CANDIDATES + j
            for column, value in zip(self._pairs.values(), (row, item, preference, one, other), strict=True):
                column.append(value)


_READERS: dict[str, Callable[[Ledger, Fields], None]] = {
    **dict.fromkeys(ANSWER_TYPES, Ledger._answer),
    "candidate": Ledger._candidate,
    "query": Ledger._query,
    "repeat": Ledger._repeat,
    "retract": Ledger._retract,
    "flag": Ledger._flag,
}


def said(answer: Answer, size: int) -> list[tuple[int, int, float]]:
    """(i, j, preference for i) with i < j, for each pair of `size` candidates that an answer speaks of."""
    if answer.reason is not None:
        return []
    return [(i, j, p) if i < j else (j, i, 1 - p) for i, j, p in implied_pairs(answer, size)]


def signature(answer: Answer, pairs: list[tuple[int, int, float]]) -> Signature:
    """What two answers to one query must have in common to be the same; see `Signature`."""
    if answer.reason is not None:
        return "incomparable" if answer.reason == "incomparable" else None
    return tuple((i, j, float(p > 0.5) - float(p < 0.5)) for i, j, p in sorted(pairs))


def word(answer: Answer) -> int:
    if answer.reason in (None, "demonstration"):
        return JUDGED
    return INCOMPARABLE if answer.reason == "incomparable" else SKIPPED


def first_shown(pairs: list[tuple[int, int, float]], shown: tuple[int, ...]) -> int:
    """LEFT or RIGHT, whichever of the two in the first two places is preferred, TIE, or UNKNOWN."""
    if len(shown) < 2:
        return UNKNOWN
    i, j = sorted(shown[:2])
    preference = next((p for a, b, p in pairs if (a, b) == (i, j)), None)
    if preference is None:
        return UNKNOWN
    if preference == 0.5:
        return TIE
    return LEFT if (preference > 0.5) == (shown[0] == i) else RIGHT
