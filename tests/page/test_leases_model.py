"""Any order of what people, admins, trainers and time can do: the desk and the store keep their promises."""

from __future__ import annotations

import asyncio
import secrets
import tempfile
from collections import Counter, defaultdict
from collections.abc import Coroutine
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, TypeVar

import pytest
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from stores import responses
from web_service import STRENGTHS, Clock, answering, page

from prefrl.page import api, desk, records
from prefrl.page.questions import Policy, Terms
from prefrl.page.security import Refused
from prefrl.page.service import Service
from prefrl.storage.maintenance import verify_store
from prefrl.store import Store

T = TypeVar("T")
PEOPLE = ("ann", "ben", "cid")
LEASE = 60.0
OUTCOMES = ("first", "second", "tie", "incomparable", "skip")
COUNTED = ("first", "second", "tie", "incomparable")
who = st.sampled_from(PEOPLE)
number = st.integers(0, 10_000)


@dataclass
class Task:
    """An assignment as its receiver knows it."""

    id: str
    name: str
    query: str
    purpose: str
    outcome: str = ""
    """Of the answer that stands; "" where none does."""
    seq: int = 0
    taken_back: bool = False
    """And waiting for another answer, as far as the server that runs now knows."""


@dataclass
class Known:
    """What was sent, and what was received."""

    overlap: int
    tasks: dict[str, Task] = field(default_factory=dict)
    asked: set[str] = field(default_factory=set)
    late: Counter[str] = field(default_factory=Counter)
    """Query -> answers that nobody waited for any more."""
    sent: list[tuple[str, api.Answer | api.Undo, int]] = field(default_factory=list)
    """By whom, what, and the number of its event; 0 where it made none."""

    def answers(self, query: str) -> int:
        """Answers that stand, skips not among them."""
        mine = [one for one in self.tasks.values() if one.query == query and one.purpose != "repeat"]
        return sum(one.outcome in COUNTED for one in mine)

    def closed(self) -> int:
        return sum(self.answers(query) >= self.overlap for query in self.asked)

    def had(self, name: str, query: str) -> bool:
        return any((one.name, one.query) == (name, query) for one in self.tasks.values())

    def answered(self) -> list[Task]:
        return [one for one in self.tasks.values() if one.outcome and not one.taken_back]

    def open(self) -> list[Task]:
        return [one for one in self.tasks.values() if not one.outcome or one.taken_back]

    def crowded(self, query: str) -> bool:
        """Whether more people may be at work on a query than it needs."""
        waiting = [one for one in self.open() if one.query == query and one.purpose == "label"]
        return self.answers(query) + len(waiting) > self.overlap


class Labelling(RuleBasedStateMachine):
    """People who label, as the HTTP handlers serve them, on a clock that the test turns."""

    def __init__(self) -> None:
        super().__init__()
        self.folder = tempfile.TemporaryDirectory()
        self.runner = asyncio.Runner()
        self.clock = Clock()
        self.store = Store[Any](Path(self.folder.name))
        self.pairs = iter(responses(200))
        self.known = Known(1)
        self.paused: set[str] = set()
        self.restarts = 1

    @initialize(overlap=st.integers(1, 3), count=st.integers(1, 6), share=st.sampled_from([0.0, 0.3]))
    def begin(self, overlap: int, count: int, share: float) -> None:
        self.known.overlap = overlap
        self.policy = Policy(overlap, LEASE, share, share)
        checks = [next(self.pairs) for _ in range(3)]
        self.store.ask(checks, purpose="check", expected=[0] * 3)
        self.ask(count)
        self.open()
        for name in PEOPLE:
            self.service.append(self.service.access.invite(name)[1])

    def open(self) -> None:
        self.service = Service(self.store, Terms(page("text"), self.policy, STRENGTHS), clock=self.clock)
        self.service.open()

    def run(self, work: Coroutine[Any, Any, T]) -> T:
        return self.runner.run(work)

    def ask(self, count: int) -> None:
        queries = [next(self.pairs) for _ in range(count)]
        self.store.ask(queries)
        self.known.asked |= {query.id for query in queries}

    def leases(self, query: str) -> dict[str, float]:
        question = self.service.desk._pool.get(query)
        leases = {} if question is None else question.leases
        return {name: until for name, until in leases.items() if until > self.clock.now}

    # --- being given questions -------------------------------------------------------------------------------

    @rule(name=who, want=st.integers(1, api.AHEAD))
    def come(self, name: str, want: int) -> None:
        self.take(name, want)

    def take(self, name: str, want: int) -> None:
        if name not in self.paused:
            self.assign(name, want)

    def assign(self, name: str, want: int) -> list[str]:
        before = {query: self.known.answers(query) for query in self.known.asked}
        cards = self.run(self.service.assign(name, want))
        ids = [card.assignment_id for card in cards]
        assert len(set(ids)) == len(ids) <= want
        for card in cards:
            if card.assignment_id in self.known.tasks:
                task = self.known.tasks[card.assignment_id]
                assert task.name == name
                assert not task.outcome or task.taken_back
            else:
                self.check_new(name, card, before)
        if len(cards) < want:
            self.check_nothing_is_left(name)
        return ids

    def check_new(self, name: str, card: api.Assignment, before: dict[str, int]) -> None:
        with self.store.log.reading() as connection:
            found = records.given(connection, card.assignment_id)
        assert found is not None
        given = found[0]
        assert (given.annotator, given.query) == (name, card.query_id)
        mine = [one for one in self.known.tasks.values() if (one.name, one.query) == (name, card.query_id)]
        if given.purpose == "repeat":
            assert [one.purpose for one in mine] == ["label"]
            assert mine[0].outcome
        else:
            assert not mine, "the same question twice to the same person"
        if given.purpose == "label":
            assert before[card.query_id] < self.known.overlap, "more answers asked for than are needed"
            assert name in self.leases(card.query_id)
        self.known.tasks[given.id] = Task(given.id, name, given.query, given.purpose)

    def check_nothing_is_left(self, name: str) -> None:
        for query in self.known.asked:
            room = self.known.answers(query) + len(self.leases(query)) < self.known.overlap
            assert not room or self.known.had(name, query), "somebody goes without, and there is a question"

    @rule(name=who)
    def stay(self, name: str) -> None:
        held = [one.id for one in self.known.open() if one.name == name][: api.AHEAD]
        self.service.desk.extend(name, held)

    # --- answering -------------------------------------------------------------------------------------------

    @rule(several=st.lists(st.tuples(who, st.sampled_from(OUTCOMES)), min_size=1, max_size=5))
    def work(self, several: list[tuple[str, str]]) -> None:
        for name, outcome in several:
            if name not in self.paused:
                for id in self.assign(name, 1):
                    self.file(self.known.tasks[id], outcome)

    @precondition(lambda self: self.known.open())
    @rule(pick=number, outcome=st.sampled_from(OUTCOMES))
    def answer(self, pick: int, outcome: str) -> None:
        """Whatever was given and not answered, be it long ago."""
        tasks = self.known.open()
        self.file(tasks[pick % len(tasks)], outcome)

    def file(self, task: Task, outcome: str) -> None:
        held = task.name in self.leases(task.query)
        sent = api.Answer(**answering(task.id, outcome))
        receipt = self.run(self.service.answer(task.name, sent))
        assert not receipt.duplicate
        self.known.sent.append((task.name, sent, receipt.seq))
        task.outcome, task.seq, task.taken_back = outcome, receipt.seq, False
        if task.purpose == "label" and outcome in COUNTED and not held:
            self.known.late[task.query] += 1

    @precondition(lambda self: self.known.answered())
    @rule(pick=number)
    def answer_again(self, pick: int) -> None:
        tasks = self.known.answered()
        task = tasks[pick % len(tasks)]
        receipt = self.run(self.service.answer(task.name, api.Answer(**answering(task.id, "second"))))
        assert (receipt.duplicate, receipt.seq) == (True, task.seq)

    @precondition(lambda self: self.known.sent)
    @rule(pick=number)
    def send_again(self, pick: int) -> None:
        """As a browser does that heard nothing."""
        name, sent, seq = self.known.sent[pick % len(self.known.sent)]
        newest = self.store.sequence
        if isinstance(sent, api.Answer):
            receipt = self.run(self.service.answer(name, sent))
            assert (receipt.duplicate, receipt.seq) == (True, seq)
        else:
            assert self.run(self.service.undo(name, sent)).assignment.assignment_id == sent.assignment_id
        assert self.store.sequence == newest

    @precondition(lambda self: self.known.sent)
    @rule(pick=number)
    def send_something_else_under_an_old_id(self, pick: int) -> None:
        name, sent, seq = self.known.sent[pick % len(self.known.sent)]
        if seq:
            other = api.Answer(**answering(sent.assignment_id) | {"submission_id": sent.submission_id, "comment": "x"})
            self.check_refused(409, self.service.answer(name, other))

    @precondition(lambda self: self.known.tasks)
    @rule(pick=number)
    def meddle(self, pick: int) -> None:
        """With somebody else's question, or with one that never was."""
        task = list(self.known.tasks.values())[pick % len(self.known.tasks)]
        other = PEOPLE[(PEOPLE.index(task.name) + 1) % len(PEOPLE)]
        for status, id in ((409, task.id), (404, secrets.token_hex(16))):
            self.check_refused(status, self.service.answer(other, api.Answer(**answering(id))))
            undo = api.Undo(submission_id=secrets.token_hex(16), assignment_id=id)
            self.check_refused(status, self.service.undo(other, undo))

    def check_refused(self, status: int, work: Coroutine[Any, Any, Any]) -> None:
        newest = self.store.sequence
        with pytest.raises(Refused) as told:
            self.run(work)
        assert (told.value.status, self.store.sequence) == (status, newest)

    @precondition(lambda self: self.known.answered())
    @rule(pick=number)
    def undo(self, pick: int) -> None:
        tasks = self.known.answered()
        task = tasks[pick % len(tasks)]
        sent = api.Undo(submission_id=secrets.token_hex(16), assignment_id=task.id)
        told = self.run(self.service.undo(task.name, sent))
        assert (told.assignment.assignment_id, told.answer["outcome"]) == (task.id, task.outcome)
        task.taken_back = True
        if task.purpose != "repeat":  # of a repetition the first answer stays, until there is another one
            task.outcome = ""
            self.known.sent.append((task.name, sent, self.store.sequence))
        if task.name not in self.paused:
            assert task.id in self.assign(task.name, 1)

    # --- what happens around them ----------------------------------------------------------------------------

    @rule(seconds=st.sampled_from([5.0, 31.0, 61.0]), name=who)
    def wait(self, seconds: float, name: str) -> None:
        """And then somebody comes."""
        self.clock.now += seconds
        self.take(name, api.AHEAD)

    @rule(count=st.integers(1, 3))
    def ask_more(self, count: int) -> None:
        self.ask(count)
        self.service.refresh()

    @rule(overlap=st.integers(1, 3))
    def change_overlap(self, overlap: int) -> None:
        self.run(self.service.set_overlap(overlap, "boss"))
        self.known.overlap = overlap
        self.forgotten()

    def forgotten(self) -> None:
        """A repetition's answer that was taken back stands again: nothing of that was written down."""
        for task in self.known.tasks.values():
            task.taken_back = task.taken_back and task.purpose != "repeat"

    @rule(name=who, state=st.sampled_from(["paused", "active"]))
    def pause_or_resume(self, name: str, state: Any) -> None:
        self.run(self.service.record(self.service.access.change(name, state)))
        (self.paused.add if state == "paused" else self.paused.discard)(name)
        found = self.service.access.person(name)
        assert found is not None
        assert found.state == state

    @precondition(lambda self: len(self.known.sent) >= 4 * self.restarts)
    @rule()
    def restart(self) -> None:
        self.restarts += 1
        before = {name: self.assign(name, api.AHEAD) for name in PEOPLE if name not in self.paused}
        self.service.close()
        self.open()
        self.forgotten()
        for name, ids in before.items():
            tasks = {id: self.known.tasks[id] for id in ids}
            alone = [id for id, task in tasks.items() if task.taken_back or not self.known.crowded(task.query)]
            now = self.assign(name, api.AHEAD)
            again = [id for id in now if id in alone]
            kept = [id for id in alone if tasks[id].purpose != "repeat" or id in again]
            assert again == kept[: len(again)]
            assert len(again) == len(kept) or len(now) == api.AHEAD, "what others held came first"

    # --- promises --------------------------------------------------------------------------------------------

    @invariant()
    def no_question_is_held_by_too_many(self) -> None:
        for query in self.known.asked:
            people = self.known.answers(query) + len(self.leases(query))
            if self.leases(query):
                assert people <= self.known.overlap + self.known.late[query]

    @invariant()
    def the_desk_counts_as_the_store_does(self) -> None:
        counts = self.service.desk.counts()
        with self.store.log.reading() as connection:
            closed = records.closed(connection, self.known.overlap)
            asked, _ = records.judged(connection)
        assert (counts.asked, counts.answered) == (asked, closed) == (len(self.known.asked), self.known.closed())

    @invariant()
    def stuck_is_what_all_have_skipped(self) -> None:
        people = [name for name in PEOPLE if name not in self.paused]
        words = {(one.name, one.query): one.outcome for one in self.known.tasks.values() if one.purpose == "label"}
        untouched = [one for one in self.known.asked if not (self.known.answers(one) or self.leases(one))]
        skipped = [one for one in untouched if people and all(words.get((name, one)) == "skip" for name in people)]
        assert self.service.desk.stuck(people) == len(skipped)

    @invariant()
    def progress_is_what_was_done(self) -> None:
        for name in PEOPLE:
            told = self.run(self.service.progress(name))
            mine = [one for one in self.known.answered() if one.name == name]
            assert (told.mine, told.answered, told.asked) == (len(mine), self.known.closed(), len(self.known.asked))
            assert 0 <= told.waiting <= len(self.known.asked) + len(self.known.open())

    def teardown(self) -> None:
        if hasattr(self, "service"):
            self.service.close()
        numbers: dict[str, list[int]] = defaultdict(list)
        for event in self.store.log.since(0):
            numbers[(event["body"].get("about") or {}).get("submission", "")].append(event["seq"])
        self.store.close()
        assert verify_store(Path(self.folder.name)).ok
        self.runner.close()
        self.folder.cleanup()
        numbers.pop("", None)
        assert numbers == {sent.submission_id: [seq] for _, sent, seq in self.known.sent if seq}


def run(examples: int, steps: int) -> None:
    """Live through so many stories; which ones, the seed of the tests decides."""
    how = settings(
        max_examples=examples,
        stateful_step_count=steps,
        phases=[Phase.generate],  # a story of forty steps is read sooner than it is shrunk
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    run_state_machine_as_test(Labelling, settings=how)


@pytest.fixture(autouse=True)
def _repeats_come_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(desk, "APART", 1)


def test_promises_hold_whatever_happens() -> None:
    run(6, 30)


@pytest.mark.slow
def test_promises_hold_whatever_happens_for_long() -> None:
    run(16, 80)


@pytest.mark.nightly
def test_promises_hold_whatever_happens_in_400_stories() -> None:
    run(400, 80)
