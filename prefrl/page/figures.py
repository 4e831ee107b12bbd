"""The dashboard's numbers: who answers how much, how fast and how well, and how far people agree."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Literal

import numpy as np
import scipy.stats  # noqa: F401  # agreement needs it: it is loaded with the dashboard, and not amid a later request
import sqlalchemy as sql
from sqlalchemy import Connection

from prefrl.page import tallies
from prefrl.page.api import AgreementRow, AnnotatorRow
from prefrl.page.ledger import KINDS, SKIPPED, Ledger
from prefrl.page.tallies import Mask, Rows
from prefrl.stats.estimates import Estimate
from prefrl.stats.intervals import share
from prefrl.storage.tables import annotator, event
from prefrl.storage.tables import query as asked

ALONE = Estimate(why="nobody else judged what this person did")
EVENT = ("seq", "id", "kind", "subject", "actor", "body", "at")
GROWTH = 1.01
"""By how much the log must have grown for agreement to be computed anew."""


@dataclass(frozen=True)
class Figures:
    """What `overview.Overview` says of questions, answers and people."""

    asked: int
    """Questions, checks not among them."""
    answered: int
    """Those with as many answers as they need; "cannot be compared" is one."""
    open: int
    skipped: int
    """Skips that stand."""
    incomparable: int
    throughput: list[tuple[str, int]]
    throughput_unit: Literal["minute", "hour"]
    annotators: list[AnnotatorRow]
    agreement: AgreementRow
    flags: list[dict[str, str]]


class Dashboard:
    """The figures of one store. It remembers what it has read of the log, so that only what is new costs time.

    `fps` is that of the clips, None for text; `check_warn` as in `tallies.concerns`. May be called from any thread.
    """

    def __init__(self, fps: float | None = None, check_warn: float = 0.8, seed: int = 0) -> None:
        self._ledger, self._check_warn, self._seed = Ledger(fps), check_warn, seed
        self._sequence, self._agreed = 0, 0
        self._agreement: tuple[AgreementRow, dict[int, Estimate]] | None = None
        self._seen: dict[str, str] = {}
        self._turn = threading.Lock()

    def figures(self, connection: Connection, overlap: int, now: datetime | None = None) -> Figures:
        """The figures as they are now, over one connection that only reads.

        `overlap` is how many answers a question needs. Only people are counted, not an oracle or a file.
        """
        with self._turn:
            self._follow(connection)
            people = connection.execute(sql.select(annotator).order_by(annotator.c.name)).all()
            rows, stands = self._ledger.rows, tallies.stands(self._ledger)
            numbers = [self._ledger.people.get(one.name, -1) for one in people]
            known = np.isin(rows["person"], numbers)
            everybody, each = self._agree(rows, stands & known)
            working = rows["at"][known & (rows["word"] != SKIPPED)]
            unit, throughput = tallies.throughput(working, (now or datetime.now(UTC)).timestamp())
            return Figures(
                **counts(connection, overlap),
                throughput=throughput,
                throughput_unit=unit,
                annotators=self._people(people, rows, stands, each),
                agreement=everybody,
                flags=list(self._ledger.flags),
            )

    def _follow(self, connection: Connection) -> None:
        """Read what is new in the log."""
        newest = connection.scalar(sql.select(sql.func.max(event.c.seq))) or 0
        new = (event.c.seq > self._sequence) & (event.c.seq <= newest)
        kinds = ("candidate", *KINDS) if self._ledger.fps else KINDS
        columns = [event.c[name] for name in EVENT]
        for one in connection.execute(sql.select(*columns).where(new, event.c.kind.in_(kinds)).order_by(event.c.seq)):
            self._sequence = one.seq  # before it is read: no event may count twice, whatever becomes of this one
            self._ledger.read(dict(zip(EVENT, one, strict=True)))
        seen = sql.select(event.c.actor, sql.func.max(event.c.at)).where(new, event.c.kind.in_(("assign", *KINDS[1:])))
        for name, at in connection.execute(seen.group_by(event.c.actor)):
            self._seen[name] = max(at, self._seen.get(name, ""))
        self._sequence = newest

    def _agree(self, rows: Rows, keep: Mask) -> tuple[AgreementRow, dict[int, Estimate]]:
        """Agreement, as old as one percent of the log at most."""
        if self._agreement is None or self._sequence > GROWTH * self._agreed:
            rng = np.random.default_rng(self._seed)
            self._agreement = tallies.agreement(rows, self._ledger.pairs, keep, rng)
            self._agreed = self._sequence
        return self._agreement

    def _people(self, people: Sequence[Any], rows: Rows, stands: Mask, each: dict[int, Estimate]) -> list[AnnotatorRow]:
        """A row for each of the store's annotators; trainers only read."""
        alive, same = stands.copy(), tallies.repeated(self._ledger)
        alive[[row for row, _, _ in self._ledger.repeats]] = True
        found = []
        for one in (one for one in people if one.role != "trainer"):
            number = self._ledger.people.get(one.name, -1)
            own = np.flatnonzero(rows["person"] == number)
            person = tallies.person({name: rows[name][own] for name in rows}, stands[own], alive[own])
            repeats = share(*same.get(number, (0, 0)), "no question was repeated")
            others = {"repeats": repeats, "agreement": each.get(number, ALONE)}
            made = AnnotatorRow(
                name=one.name,
                role=one.role,
                state=one.state,
                last_seen=self._seen.get(one.name),
                **vars(person),
                **others,
            )
            found.append(made.model_copy(update={"concerns": tallies.concerns(made, self._check_warn)}))
        return found


def counts(connection: Connection, overlap: int) -> dict[str, int]:
    """Questions and what stands on them, checks not among them."""
    done = sql.case((asked.c.judged + asked.c.incomparable >= overlap, 1), else_=0)
    columns = (sql.func.count(), sql.func.sum(done), sql.func.sum(asked.c.skipped), sql.func.sum(asked.c.incomparable))
    found = connection.execute(sql.select(*columns).where(asked.c.purpose == "label")).one()
    total, answered, skipped, incomparable = (int(number or 0) for number in found)
    numbers = {"asked": total, "answered": answered, "open": total - answered}
    return numbers | {"skipped": skipped, "incomparable": incomparable}
