"""Who is asked what next: leases, overlap, check questions and repeats. In memory only; the log is kept elsewhere.

A question goes to `overlap` different people: answers that stand and live leases together are never more. A lease
runs out by the monotonic clock, whatever happens to the wall clock; an answer that comes later counts all the same.
"""

from __future__ import annotations

import threading
import time
import uuid
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from itertools import islice

from prefrl.page.pool import Pool
from prefrl.page.questions import Counts, Given, Past, Person, Policy, Question
from prefrl.seeding import keyed

APART = 10
"""Answers between a question and its repetition, at least."""
REMEMBERED = 200
"""Answers of a person from which repeats are taken."""


class Desk:
    """See the module's docstring. All methods may be called from any thread."""

    def __init__(self, policy: Policy, clock: Callable[[], float] = time.monotonic) -> None:
        self.policy, self._clock = policy, clock
        self._lock = threading.RLock()
        self._reset()

    def _reset(self) -> None:
        self._pool = Pool(self.policy.overlap, self.policy.lease_seconds, self._clock)
        self._checks: dict[str, Question] = {}
        self._people: dict[str, Person] = {}
        self._closed = 0

    # --- what there is ---------------------------------------------------------------------------------------

    def load(
        self,
        questions: Iterable[Question],
        held: Iterable[Given],
        closed: int,
        overlap: int,
        taken_back: Iterable[Given] = (),
    ) -> None:
        """Begin anew from what the store holds: open questions, unanswered assignments, how many are closed.

        Those of the assignments that were `taken_back` come first, the last of them before all. Who held a question
        before gets it back, as far as there is room: who was given it last comes first, since those before may have
        let it go.
        """
        with self._lock:
            self.policy = replace(self.policy, overlap=overlap)
            self._reset()
            self.add(questions)
            self._closed = closed
            held = list(held)
            for given in held:
                self._person(given.annotator).held[given.id] = given
            for given in taken_back:
                self._wait(given)
            for given in reversed(held):
                self._revive(given)

    def add(self, questions: Iterable[Question]) -> None:
        """More questions; those that are known already are left alone."""
        with self._lock:
            new = [q for q in questions if q.id not in self._pool]
            self._checks = {q.id: q for q in new if q.purpose == "check"} | self._checks
            self._pool.add([q for q in new if q.purpose != "check"])

    def knows(self, annotator: str) -> bool:
        """Whether this person's past was told."""
        return self._people.get(annotator, Person()).past is not None

    def tell(self, annotator: str, past: Past) -> None:
        """What a person has done so far; before they are given anything."""
        with self._lock:
            self._person(annotator).past = past

    # --- giving ----------------------------------------------------------------------------------------------

    def pick(self, annotator: str, want: int, guideline: str = "") -> tuple[list[Given], list[Given]]:
        """What a person holds already and may still answer, and new questions up to `want` together.

        The new ones are leased from now on; they are to be written down, or given to `abandon`.
        """
        with self._lock:
            # First: a question whose lease ran out in the meantime is free for this person.
            self._pool.sweep()
            mine = self._person(annotator).held.values()
            held = list(islice((given for given in mine if self._revive(given)), want))
            new: list[Given] = []
            while len(held) + len(new) < want and (one := self._next(annotator, guideline)) is not None:
                new.append(one)
            return held, new

    def abandon(self, given: Sequence[Given]) -> None:
        """New questions that could not be written down were never given."""
        with self._lock:
            for one in given:
                person = self._person(one.annotator)
                person.held.pop(one.id, None)
                if one.purpose == "check":
                    self._checks[one.query].seen.discard(one.annotator)
                elif one.purpose == "repeat" and person.past is not None:
                    person.past.repeated.discard(one.query)
                elif (question := self._pool.get(one.query)) is not None:
                    self._pool.forget(question, one.annotator)

    def extend(self, annotator: str, assignments: Iterable[str]) -> None:
        """Somebody is still at work on these: their leases begin anew."""
        with self._lock:
            self._pool.sweep()
            for id in assignments:
                if given := self._person(annotator).held.get(id):
                    self._revive(given)

    def _next(self, annotator: str, guideline: str) -> Given | None:
        """One new assignment, or None where there is no open question for this person."""
        question, person = self._pool.first(annotator), self._person(annotator)
        if question is None:
            return None
        assert person.past is not None  # `tell` comes first
        # By person and number: after a restart, checks and repeats come where they would have come without it.
        rng = keyed(self.policy.seed, f"{annotator}#{person.past.given}")
        draw, pick = rng.random(), float(rng.random())
        given: Given | None = None
        if draw < self.policy.check_share:
            given = self._check(annotator, pick, guideline)
        elif draw < self.policy.check_share + self.policy.repeat_share:
            given = self._repeat(person.past, pick, guideline)
        if given is None:  # also where no check or repeat is left for this person
            self._pool.lease(question, annotator)
            given = self._give(question, annotator, guideline)
        person.past.given += 1
        person.held[given.id] = given
        return given

    def _check(self, annotator: str, pick: float, guideline: str) -> Given | None:
        left = [question for question in self._checks.values() if annotator not in question.seen]
        if not left:
            return None
        question = left[int(pick * len(left))]
        question.seen.add(annotator)
        return self._give(question, annotator, guideline)

    def _repeat(self, past: Past, pick: float, guideline: str) -> Given | None:
        """A question that this person answered a while ago, with the sides turned round."""
        left = [given for given in past.recent[:-APART] if given.query not in past.repeated]
        if not left:
            return None
        old = left[int(pick * len(left))]
        past.repeated.add(old.query)
        return Given(uuid.uuid4().hex, old.query, old.annotator, "repeat", old.shown[::-1], guideline)

    def _give(self, question: Question, annotator: str, guideline: str) -> Given:
        """Sides are drawn for each person apart, and the same whenever they are drawn."""
        shown = keyed(self.policy.seed, f"{question.id}/{annotator}").permutation(question.size).tolist()
        return Given(uuid.uuid4().hex, question.id, annotator, question.purpose, tuple(shown), guideline)

    def _revive(self, given: Given) -> bool:
        """Lease a question again to who was given it before; whether it may still be answered."""
        question = self._pool.get(given.query) if given.purpose == "label" else None
        if question is not None and (given.annotator in question.leases or question.free):
            self._pool.lease(question, given.annotator)
            return True
        return given.purpose != "label" or given.id in self._person(given.annotator).undone

    # --- what comes back -------------------------------------------------------------------------------------

    def answered(self, given: Given, answers: int, skipped: bool = False) -> None:
        """An assignment was answered; `answers` are those to its query that stand now, skips not among them."""
        with self._lock:
            person = self._person(given.annotator)
            person.held.pop(given.id, None)
            person.undone.discard(given.id)
            if person.past is not None:
                person.past.answers += 1
                if given.purpose == "label":
                    person.past.recent = [*person.past.recent, given][-REMEMBERED:]
            question = self._pool.get(given.query)
            if given.purpose != "label" or question is None:
                return
            self._pool.note_skip(question, given.annotator, skipped)
            self._pool.count(question, answers)
            self._pool.release(question, given.annotator)
            if answers >= self.policy.overlap:
                self._pool.remove(question)
                self._closed += 1

    def reopened(self, given: Given, question: Question) -> None:
        """An answer was taken back: its assignment is the next that this person is given.

        `question` is as the store has it now; it may have been put away here.
        """
        with self._lock:
            person = self._wait(given)
            if person.past is not None:
                person.past.answers -= 1
                person.past.recent = [one for one in person.past.recent if one.id != given.id]
            if given.purpose != "label" or question.answered >= self.policy.overlap:
                return
            if (known := self._pool.get(question.id)) is None:
                self._closed -= 1
                self._pool.restore(question)
            else:
                self._pool.note_skip(known, given.annotator, skipped=False)
                self._pool.count(known, question.answered)
            self._revive(given)

    def _wait(self, given: Given) -> Person:
        """Have an assignment wait for another answer, before all others of its person."""
        person = self._person(given.annotator)
        person.held.pop(given.id, None)
        person.held = {given.id: given} | person.held  # a dict keeps its order, so this one comes first
        person.undone.add(given.id)
        return person

    def undone(self, given: Given) -> bool:
        """Whether an answer was taken back, and waits for another one."""
        return given.id in self._person(given.annotator).undone

    # --- looking ---------------------------------------------------------------------------------------------

    def counts(self) -> Counts:
        with self._lock:
            self._pool.sweep()
            return Counts(len(self._pool) + self._closed, self._closed, self._pool.leased(), self._pool.free)

    def progress(self, annotator: str) -> tuple[int, int, int, int]:
        """Answers of this person, questions that are done, all questions, and how many this person could be given."""
        with self._lock:
            self._pool.sweep()
            person = self._person(annotator)
            held = sum(given.query in self._pool or given.purpose != "label" for given in person.held.values())
            mine = person.past.answers if person.past is not None else 0
            asked = len(self._pool) + self._closed
            return mine, self._closed, asked, self._pool.left(annotator) + held

    def stuck(self, people: Iterable[str]) -> int:
        """How many open questions all of these people have skipped; see `Pool.stuck`."""
        with self._lock:
            self._pool.sweep()
            return self._pool.stuck(people)

    def _person(self, annotator: str) -> Person:
        return self._people.setdefault(annotator, Person())
