"""What the application is made of: the store, its writer, the desk, the people, and what they are shown."""

from __future__ import annotations

import asyncio
import time
import uuid
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from threading import Condition, Lock
from typing import TYPE_CHECKING, Literal, TypeVar

from sqlalchemy.exc import OperationalError
from starlette.concurrency import run_in_threadpool

from prefrl.kinds import named
from prefrl.page import api, records
from prefrl.page.access import Access, Event
from prefrl.page.cards import Cards, ClipSource
from prefrl.page.desk import Desk
from prefrl.page.intake import Intake, Reopened, Taken
from prefrl.page.questions import Given, Terms, ignored
from prefrl.page.security import Buckets, Refused
from prefrl.page.shown import Moves
from prefrl.page.texts import (
    OFFERED,
    TEXT,
    Consent,
    agreement_event,
    agreements,
    guideline_event,
    offered_event,
    text_event,
    version_of,
)
from prefrl.page.writer import Unavailable, Writer
from prefrl.storage.log import Transaction, row
from prefrl.store import Store
from prefrl.types import Fields, Query

if TYPE_CHECKING:
    from prefrl.page.figures import Dashboard

T = TypeVar("T")


@dataclass(eq=False)
class Service:
    """See the module's docstring. `open` before use, `close` after."""

    store: Store
    terms: Terms
    clips: ClipSource | None = None
    clock: Callable[[], float] = time.monotonic
    finished: bool = False
    """Whether the run needs no more answers."""
    guideline: api.Guideline = field(default_factory=lambda: api.Guideline(version="", text=""))
    consent: Consent = field(default_factory=Consent)
    changed: Condition = field(default_factory=Condition)
    """Notified after each answer that is on disk."""
    notes: list[str] = field(default_factory=list)
    """Settings that do not hold, since others were made on the page."""

    def __post_init__(self) -> None:
        self.access = Access()
        self.desk = Desk(self.terms.policy, self.clock)
        self.writer = Writer(self.store.log)
        self.intake = Intake(self.store, self.desk, self.terms.strengths, self.terms.shows)
        moves = self._moves if self.terms.page.ask == "action" else None
        self.cards = Cards(self.store.log, self.terms, self.clips, moves)
        self.requests = Buckets(self.terms.rate, 3 * self.terms.rate, self.clock)
        self.logins = Buckets(1.0, 20.0, self.clock)
        self.begun = self.clock()
        self._asked = self.seq = 0
        self._loading = Lock()
        self._store_id = ""

    # --- opening and closing ---------------------------------------------------------------------------------

    def open(self) -> None:
        """Read what the store knows, and begin to write."""
        with self.store.log.reading() as connection:
            self.access.load(connection)
            kept = records.settings(connection)
        self.load(int(kept.get("overlap", self.terms.policy.overlap)))
        self.writer.start()
        self._take_up(kept)

    def close(self) -> None:
        """Write what waits, and end."""
        self.writer.close()

    def load(self, overlap: int) -> None:
        """Have the desk begin anew from the store."""
        with self._loading, self.store.log.reading() as connection:
            self._asked = self.seq = records.newest(connection)
            questions = records.questions(connection, overlap)
            closed = records.closed(connection, overlap)
            back = records.taken_back(connection)
            self.desk.load(questions, records.unanswered(connection), closed, overlap, back)

    def refresh(self) -> None:
        """Have the desk know what was asked since. A run does so while an admin may have all loaded anew."""
        with self._loading, self.store.log.reading() as connection:
            newest = records.newest(connection)
            self.desk.add(records.questions(connection, self.desk.policy.overlap, after=self._asked))
            self._asked = max(newest, self._asked)
        self.seq = max(newest, self.seq)

    def append(self, events: list[Event]) -> None:
        """Append events from outside the application, and wait for the disk."""
        self.writer.submit(lambda tx: tx.extend(events), lambda numbers: self._noted(events, numbers)).result()

    # --- inside the application ------------------------------------------------------------------------------

    async def write(
        self,
        run: Callable[[Transaction], T],
        done: Callable[[T], None] = lambda _: None,
        failed: Callable[[], None] = lambda: None,
    ) -> T:
        """Have something written, and wait until it is on disk."""
        return await asyncio.wrap_future(self.writer.submit(run, done, failed))

    async def record(self, events: list[Event]) -> None:
        """Append events, and take note of those that speak of people."""
        await self.write(lambda tx: tx.extend(events), lambda numbers: self._noted(events, numbers))

    async def assign(self, name: str, want: int) -> list[api.Assignment]:
        """Questions for a person, at most `want`: those that are held already first."""
        picked: list[Given] = []
        given = await self.write(
            lambda tx: self.intake.assign(tx, name, want, self.guideline.version, picked),
            lambda _: None,
            lambda: self.desk.abandon(picked),
        )
        return await run_in_threadpool(self.cards.show, given)

    async def answer(self, name: str, sent: api.Answer) -> api.Receipt:
        taken = await self.write(lambda tx: self.intake.answer(tx, name, sent), self._taken)
        if self.terms.check_pause and taken.given is not None and taken.given.purpose == "check":
            await self._look_at_checks(name)
        return api.Receipt(seq=taken.seq, duplicate=taken.duplicate)

    async def measure(self, name: str, sent: api.Draft) -> api.Measured:
        """What a draft comes to, and whether it would be taken."""
        return await run_in_threadpool(self._measure, name, sent)

    async def undo(self, name: str, sent: api.Undo) -> api.Undone:
        taken = await self.write(lambda tx: self.intake.undo(tx, name, sent), self._reopened)
        cards = await run_in_threadpool(self.cards.show, [taken.given])
        return api.Undone(assignment=cards[0], answer=taken.answer)

    async def flag(self, name: str, sent: api.Flag) -> api.Receipt:
        taken = await self.write(lambda tx: self.intake.flag(tx, name, sent), self._taken)
        return api.Receipt(seq=taken.seq, duplicate=taken.duplicate)

    async def history(self, name: str) -> list[api.Entry]:
        """A person's last answers, newest first."""
        return await run_in_threadpool(self._history, name)

    async def progress(self, name: str) -> api.Progress:
        if not self.desk.knows(name):
            await run_in_threadpool(self._meet, name)
        mine, answered, asked, waiting = self.desk.progress(name)
        return api.Progress(mine=mine, answered=answered, asked=asked, waiting=waiting)

    async def set_overlap(self, overlap: int, actor: str) -> None:
        """From now on each question needs so many answers."""
        events = [row(f"project:{uuid.uuid4().hex}", "project", "", actor, {"overlap": overlap})]
        await self.write(lambda tx: tx.extend(events), lambda _: self.load(overlap))

    async def set_guideline(self, text: str, actor: str) -> api.Guideline:
        """From now on assignments are made under this guideline."""
        made = api.Guideline(version=version_of(text), text=text)
        event = guideline_event(text, actor)

        def note(_: object) -> None:
            self.guideline = made

        await self.write(lambda tx: tx.append(event), note)
        return made

    async def agree(self, name: str, version: str) -> None:
        """Somebody agrees to what people are asked for. Raises `Refused` where they have read another version."""
        if version != self.consent.version or not version:
            raise Refused(409, "this text is not the one that counts any more: read the new one")
        event = agreement_event(name, version)

        def note(_: object) -> None:
            self.consent.agreed[name] = version

        await self.write(lambda tx: tx.append(event), note)

    async def ask(self, queries: Sequence[Query]) -> None:
        """Ask what a trainer elsewhere wants to know; what was asked before is left alone."""
        try:
            await run_in_threadpool(self.store.ask, queries)
        except OperationalError:  # somebody else has locked the database
            raise Unavailable("this could not be stored: try again in a moment") from None
        await run_in_threadpool(self.refresh)

    @property
    def store_id(self) -> str:
        """What tells this store from all others, in browsers that know several; "" before its first event."""
        if not self._store_id:
            with self.store.log.reading() as connection:
                self._store_id = records.store_id(connection)
        return self._store_id

    @cached_property
    def dashboard(self) -> Dashboard:
        """The figures for admins, made when the first one looks: a server is up in half the time without scipy."""
        from prefrl.page.figures import Dashboard

        clips = named(self.terms.page.kind).shows == "clip"
        return Dashboard(self.terms.fps if clips else None, self.terms.check_warn)

    @property
    def read_only(self) -> bool:
        """Whether the disk is full."""
        return self.store.log.full

    @property
    def trouble(self) -> Literal["ok", "read-only"] | str:
        if self.read_only:
            return "read-only"
        return self.writer.trouble or ("ok" if self.writer.alive else "nothing can be stored: the writer has ended")

    def _take_up(self, kept: Fields) -> None:
        """The texts and settings that hold: those that were made on the page before those that this was started with.

        The guideline that we ship gives way to any other. What is agreed to can be changed by the settings alone.
        """
        terms, text = self.terms, kept.get("guideline", "")
        ours = not text or kept.get(OFFERED) == version_of(text)
        if ours and text != terms.guideline:
            text = terms.guideline
            self.append([guideline_event(text, ""), offered_event(version_of(text) if terms.offered else "")])
        self.guideline = api.Guideline(version=version_of(text), text=text)
        if terms.consent != kept.get(TEXT, ""):
            self.append([text_event(terms.consent)])
        self.consent = Consent(terms.consent, version_of(terms.consent), agreements(kept))
        self.notes = list(ignored(terms, self.desk.policy.overlap, self.guideline))

    def _meet(self, name: str) -> None:
        with self.store.log.reading() as connection:
            past = records.past(connection, name)
        if not self.desk.knows(name):
            self.desk.tell(name, past)

    def _moves(self, candidate: str) -> Moves:
        assert self.terms.shows is not None
        return self.terms.shows.moves(self.store.candidate(candidate))

    def _measure(self, name: str, sent: api.Draft) -> api.Measured:
        with self.store.log.reading() as connection:
            given, _ = records.own(connection, name, sent.assignment_id)
        shows = self.terms.shows
        if shows is None:
            raise Refused(422, "this project asks for judgements")
        (own,) = self.store.query(given.query).candidates
        length, longest = shows.lengths(own, sent.shown)
        try:
            shows.behaviour(own, sent.shown)
        except Refused as refused:
            return api.Measured(length=length, longest=longest, fault=refused.error)
        return api.Measured(length=length, longest=longest, fault="")

    async def _look_at_checks(self, name: str) -> None:
        """Pause an annotator who surely fails too many check questions."""
        who = self.access.person(name)
        if who is None or who.role != "annotator" or who.state != "active":
            return
        if why := await run_in_threadpool(self._failing, name):
            await self.record(self.access.change(name, "paused", why))

    def _failing(self, name: str) -> str:
        from prefrl.page.tallies import failing  # it needs scipy; see `dashboard`

        with self.store.log.reading() as connection:
            return failing(connection, name, self.terms.check_pause)

    def _history(self, name: str) -> list[api.Entry]:
        with self.store.log.reading() as connection:
            last = records.last_answers(connection, name)
        last = [one for one in last if not self.desk.undone(one[0])]
        cards = self.cards.show([given for given, _, _ in last])
        return [
            api.Entry(assignment=card, answer=answer, at=at) for card, (_, answer, at) in zip(cards, last, strict=True)
        ]

    # --- in the writer's thread, after the commit ------------------------------------------------------------

    def _taken(self, taken: Taken) -> None:
        self.seq = max(self.seq, taken.seq)
        if taken.given is not None:
            self.desk.answered(taken.given, taken.answers, taken.skipped)
        with self.changed:
            self.changed.notify_all()

    def _reopened(self, taken: Reopened) -> None:
        if taken.question is not None:
            self.desk.reopened(taken.given, taken.question)
        self.seq += 1

    def _noted(self, events: list[Event], numbers: list[int]) -> None:
        self.seq = max(self.seq, *numbers, 0)
        self.access.note([one for one in events if one["kind"] in ("annotator", "state", "token", "revoke")])
