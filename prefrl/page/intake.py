"""What happens inside a transaction: giving out, answering, taking back, reporting a problem.

Each function runs in the writer's thread. It decides by what the database holds at that moment, so nothing that
happened at the same time, or before a crash, can lead it astray; the desk is told once the transaction is on disk.
"""

from __future__ import annotations

import hashlib
from collections import OrderedDict
from dataclasses import dataclass, field

import sqlalchemy as sql
from sqlalchemy import Connection

from prefrl.judgements import Answer, Comparison, Demonstration, Ranking, Skip
from prefrl.page import api, records
from prefrl.page.desk import Desk
from prefrl.page.questions import Given, Question
from prefrl.page.security import Refused
from prefrl.page.shown import Showing
from prefrl.storage.events import answer_body, answer_kind
from prefrl.storage.log import Transaction, row
from prefrl.storage.tables import assignment, canonical, submission
from prefrl.store import Store
from prefrl.types import Json

REMEMBERED = 10_000
"""Submissions that changed nothing."""
_KNOWN = sql.select(submission).where(submission.c.id == sql.bindparam("b_id"))


@dataclass(frozen=True)
class Taken:
    """An answer that is on disk."""

    seq: int
    duplicate: bool
    given: Given | None = None
    """What it answers; None for a duplicate."""
    answers: int = 0
    """How many answers to the query stand with it."""
    skipped: bool = False


@dataclass(frozen=True)
class Reopened:
    """An answer that was taken back."""

    given: Given
    answer: Json
    """As it was sent."""
    question: Question | None = None
    """Its query as it is now; None where the answer had been taken back before."""


@dataclass
class Intake:
    """See the module's docstring."""

    store: Store
    desk: Desk
    strengths: dict[str, float]
    """slight, clear and much as preferences."""
    shows: Showing | None = None
    """How what people show becomes a behaviour; None where they judge."""
    _idle: OrderedDict[str, str] = field(default_factory=OrderedDict)
    """The newest submissions that changed nothing, of which the log says nothing, and their digests."""

    def assign(self, tx: Transaction, name: str, want: int, guideline: str, picked: list[Given]) -> list[Given]:
        """What a person is to answer next. The new ones are noted in `picked` at once, should this fail later."""
        if not self.desk.knows(name):
            self.desk.tell(name, records.past(tx.connection, name))
        held, new = self.desk.pick(name, want, guideline)
        picked += new
        tx.extend(
            row(one.id, "assign", one.query, name, {k: getattr(one, k) for k in ("shown", "purpose", "guideline")})
            for one in new
        )
        return [*held, *new]

    def answer(self, tx: Transaction, name: str, sent: api.Answer) -> Taken:
        """File an answer. The same submission again changes nothing; nor does a second answer to an assignment.

        Raises `Refused` for an assignment that is unknown or somebody else's, and for a submission id that was used
        for something else.
        """
        digest = _digest(name, sent)
        # A client that got no reply sends again: the log knows whether the first one arrived, also after a crash.
        if (seq := self._known(tx.connection, sent.submission_id, digest)) is not None:
            return Taken(seq, duplicate=True)
        given, answered = records.own(tx.connection, name, sent.assignment_id)
        if answered is not None and not self.desk.undone(given):
            self._note_idle(sent.submission_id, digest)
            return Taken(answered, duplicate=True)
        about = self._about(sent, given, digest)
        if sent.shown is not None:
            seq = self._file_shown(tx, given, sent.shown, about)
        else:
            seq = self._file(tx, given, in_item_space(sent, given, self.strengths), about, again=answered is not None)
        answers = records.answers_to(tx.connection, given.query)
        return Taken(seq, False, given, answers, skipped=sent.outcome == "skip")

    def undo(self, tx: Transaction, name: str, sent: api.Undo) -> Reopened:
        """Take one of a person's last answers back. Doing it again changes nothing."""
        digest = _digest(name, sent)
        known = self._known(tx.connection, sent.submission_id, digest)
        given, answered = records.own(tx.connection, name, sent.assignment_id)
        answer = records.last_answer(tx.connection, given)
        if not answer:
            raise Refused(409, "this question was not answered yet: there is nothing to take back")
        if known is not None or answered is None or self.desk.undone(given):
            self._note_idle(sent.submission_id, digest)
            return Reopened(given, answer)
        if answered < _oldest(tx.connection, name):
            raise Refused(409, f"only one of the last {api.HISTORY} answers can be taken back")
        if given.purpose != "repeat":
            about = {"submission": sent.submission_id, "digest": digest, "assignment": given.id}
            self.store.take_back(tx, given.query, name, about)
        return Reopened(given, answer, records.question(tx.connection, given.query))

    def flag(self, tx: Transaction, name: str, sent: api.Flag) -> Taken:
        """File a problem that somebody reports."""
        digest = _digest(name, sent)
        if (seq := self._known(tx.connection, sent.submission_id, digest)) is not None:
            return Taken(seq, duplicate=True)
        query = records.own(tx.connection, name, sent.assignment_id)[0].query if sent.assignment_id else ""
        body = {"text": sent.text, "about": {"submission": sent.submission_id, "digest": digest}}
        return Taken(tx.append(row(f"flag:{sent.submission_id}", "flag", query, name, body)), duplicate=False)

    def _known(self, connection: Connection, id: str, digest: str) -> int | None:
        """The number of a submission that came before. Raises `Refused` where its id was used for something else."""
        found = connection.execute(_KNOWN, {"b_id": id}).first()
        before = self._idle.get(id, digest) if found is None else found.digest
        if before != digest:
            raise Refused(409, "this submission id was used for something else")
        return None if found is None else int(found.seq)

    def _note_idle(self, id: str, digest: str) -> None:
        self._idle[id] = digest
        if len(self._idle) > REMEMBERED:
            self._idle.popitem(last=False)

    def _about(self, sent: api.Answer, given: Given, digest: str) -> Json:
        """How an answer came about, kept beside it."""
        kept = sent.model_dump(exclude={"submission_id", "assignment_id"})
        ids = {"submission": sent.submission_id, "digest": digest, "assignment": given.id}
        return kept | ids | {"guideline": sent.guideline or given.guideline}

    def _file_shown(self, tx: Transaction, given: Given, shown: api.Shown, about: Json) -> int:
        """A demonstration, and the behaviour that it shows, in one transaction."""
        if self.shows is None or len(given.shown) != 1:
            raise Refused(422, "this question asks which of its candidates is better: expected a judgement of them")
        (own,) = self.store.query(given.query).candidates
        like = self.shows.behaviour(own, shown)
        return self.store.show(tx, like, Demonstration(given.query, like.id, given.annotator, given.shown), about)

    def _file(self, tx: Transaction, given: Given, answer: Answer, about: Json, again: bool) -> int:
        """A judgement. Of a repeated question nothing is learned, and the first answer stays where it was."""
        if given.purpose != "repeat":
            return self.store.put(tx, answer, about)
        id = f"repeat:{given.id}" + (f":{about['submission']}" if again else "")
        body = {"answer": {"kind": answer_kind(answer), **answer_body(answer)}, "about": about}
        return tx.append(row(id, "repeat", given.query, given.annotator, body))


def in_item_space(sent: api.Answer, given: Given, strengths: dict[str, float]) -> Answer:
    """An answer in the query's own order. Raises `Refused` where it does not fit the question."""
    query = given.query
    name = given.annotator
    shown = given.shown
    if sent.outcome in ("skip", "incomparable"):
        return Skip(query, "skip" if sent.outcome == "skip" else "incomparable", name, shown)
    if len(shown) < 2:
        raise Refused(422, f"this question has one candidate: expected what to do in its place, got {sent.outcome!r}")
    if sent.outcome == "ranking" or len(shown) > 2:
        return Ranking(query, _ranks(sent, shown), name, shown)
    if sent.outcome == "tie":
        return Comparison(query, 0.5, name, shown)
    strength = 1.0 if sent.strength is None else strengths[sent.strength]
    better = shown[0 if sent.outcome == "first" else 1]
    return Comparison(query, strength if better == 0 else 1.0 - strength, name, shown)


def _ranks(sent: api.Answer, shown: tuple[int, ...]) -> tuple[int, ...]:
    """The rank of each candidate, from the rank of each slot."""
    by_slot = [0] * len(shown) if sent.outcome == "tie" else sent.ranking
    if by_slot is None or len(by_slot) != len(shown):
        got = sent.outcome if by_slot is None else f"one of {len(by_slot)}"
        raise Refused(422, f"this question has {len(shown)} candidates: expected a ranking of them, got {got}")
    return tuple(rank for _, rank in sorted(zip(shown, by_slot, strict=True)))  # from slots to the query's own order


def _digest(name: str, sent: api.Body) -> str:
    """Of who sent what: the same id from somebody else is not the same submission."""
    told = canonical([name, type(sent).__name__, sent.model_dump()])
    return hashlib.sha256(told.encode()).hexdigest()


def _oldest(connection: Connection, name: str) -> int:
    """The number of the oldest answer of a person that can still be taken back."""
    mine = (assignment.c.annotator == name) & assignment.c.answered.is_not(None)
    some = sql.select(assignment.c.answered).where(mine).order_by(assignment.c.answered.desc())
    return int(connection.scalar(some.offset(api.HISTORY - 1).limit(1)) or 0)
