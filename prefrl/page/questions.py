"""What the desk gives out: open questions, the people they go to, and the rules by which they do."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, TypeAlias

from prefrl.page import api
from prefrl.page.shown import Showing

Purpose: TypeAlias = Literal["label", "check", "repeat"]
BETWEEN = "\x1f"
"""Between names in a text; no name that people can have holds it."""


@dataclass(frozen=True)
class Policy:
    """How questions are given out."""

    overlap: int = 1
    """How many different people each question goes to."""
    lease_seconds: float = 120.0
    check_share: float = 0.0
    """Of what a person is given, about how much is a check question."""
    repeat_share: float = 0.0
    """Of what a person is given, about how much is a question of theirs with the sides turned round."""
    seed: int = 0


@dataclass
class Question:
    """A query that is open, or a check question."""

    id: str
    seq: int
    batch: int
    size: int
    purpose: Purpose = "label"
    answered: int = 0
    """Judgements that stand, "cannot be compared" among them."""
    names: str = ""
    """Who was given it before it came here, as one text: of most of many questions nobody ever looks."""
    leases: dict[str, float] = field(default_factory=dict)
    """Who holds it, and until when."""
    free: bool = False
    """Whether somebody more can be given it; kept up by the desk."""
    skipped: frozenset[str] = frozenset()
    """Whose last word on it is a skip."""

    @cached_property
    def seen(self) -> set[str]:
        """Who was given it, ever."""
        return set(filter(None, self.names.split(BETWEEN)))

    @property
    def key(self) -> tuple[int, int, str]:
        """The newest batch first, and within it the order of asking."""
        return -self.batch, self.seq, self.id


@dataclass(frozen=True)
class Given:
    """A question that was put to a person: an assignment."""

    id: str
    query: str
    annotator: str
    purpose: Purpose
    shown: tuple[int, ...]
    """`shown[slot]` is the candidate in that slot, counted in the query's own order."""
    guideline: str = ""
    """Version of the guideline at the time."""


@dataclass
class Past:
    """What a person has done so far."""

    given: int = 0
    """Assignments, of whatever purpose."""
    answers: int = 0
    """Assignments that are answered."""
    recent: list[Given] = field(default_factory=list)
    """Open questions that were answered, oldest first: repeats are taken from them."""
    repeated: set[str] = field(default_factory=set)


@dataclass
class Person:
    """Where one person stands."""

    past: Past | None = None
    """None until it is told."""
    held: dict[str, Given] = field(default_factory=dict)
    """Given, and not answered; oldest first."""
    undone: set[str] = field(default_factory=set)
    """Assignments whose answers were taken back, and that wait for others."""


@dataclass(frozen=True)
class Counts:
    """Questions, check questions not among them."""

    asked: int
    answered: int
    """With all the answers they need."""
    leased: int
    free: int


@dataclass(frozen=True)
class Terms:
    """What a project asks, and how."""

    page: api.Page
    policy: Policy
    strengths: dict[str, float]
    """slight, clear and much as preferences."""
    guideline: str = ""
    """Its text at the beginning."""
    offered: bool = False
    """Whether that is the text we ship, which gives way to any other."""
    consent: str = ""
    """What people agree to before their first question; "" for nothing."""
    fps: float = 0.0
    shows: Showing | None = None
    """How what people show becomes a behaviour; None where they judge."""
    fixed: bool = False
    """No more questions will come: who has answered all is done."""
    check_warn: float = 0.8
    """Admins are told of who surely answers fewer check questions than this share as expected."""
    check_pause: float = 0.0
    """Who surely answers fewer than this share is paused, until an admin has them go on."""
    rate: float = 10.0
    """Requests a second that one person may make; three times as many at once."""


def ignored(terms: Terms, overlap: int, guideline: api.Guideline) -> Iterator[str]:
    """Which settings do not hold, since the store knows others: `overlap` and `guideline` do."""
    if overlap != terms.policy.overlap:
        yield (
            f"labeler.overlap={terms.policy.overlap} is not used: an admin has set {overlap} on the page, and can "
            "change it there"
        )
    if not terms.offered and terms.guideline not in ("", guideline.text):
        yield (
            f"labeler.guideline is not used: the store has one already (version {guideline.version}), which an admin "
            "can change on the page"
        )
