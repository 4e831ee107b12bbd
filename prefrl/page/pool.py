"""The open questions: which are free, who holds them and until when, and the first one for a person.

Each person goes down the list once. What becomes free again behind a person's back is put on a small heap of theirs,
so the next question is found in amortised constant time, however many there are.
"""

from __future__ import annotations

import heapq
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

from prefrl.page.questions import BETWEEN, Question


@dataclass
class _Walk:
    """How far one person has come."""

    places: dict[int, int] = field(default_factory=dict)
    """Batch -> how far down its list."""
    returned: list[tuple[int, int, str]] = field(default_factory=list)
    """A heap of questions that became free after this person had passed them."""
    seen_free: int = 0
    """How many free questions this person was given already."""


class Pool:
    """Not locked: the desk, which owns it, is."""

    def __init__(self, overlap: int, lease_seconds: float, clock: Callable[[], float]) -> None:
        self.overlap, self.lease_seconds, self._clock = overlap, lease_seconds, clock
        self.free = 0
        """How many questions somebody more can be given."""
        self._questions: dict[str, Question] = {}
        self._lists: defaultdict[int, list[str]] = defaultdict(list)
        self._batches: list[int] = []
        self._walks: defaultdict[str, _Walk] = defaultdict(_Walk)
        self._expiries: list[tuple[float, str, str]] = []

    def __len__(self) -> int:
        return len(self._questions)

    def __contains__(self, id: str) -> bool:
        return id in self._questions

    def get(self, id: str) -> Question | None:
        return self._questions.get(id)

    def add(self, questions: Sequence[Question]) -> None:
        """More questions, which nobody holds."""
        for question in questions:
            self._questions[question.id] = question
            self._lists[question.batch].append(question.id)
            question.free = self._room(question)
        self._batches = sorted(self._lists, reverse=True)
        free = [question.names for question in questions if question.free]
        self.free += len(free)
        times = Counter(BETWEEN.join(free).split(BETWEEN))
        for name in times.keys() - {""}:
            self._walks[name].seen_free += times[name]

    def restore(self, question: Question) -> None:
        """A question that was here before, and that people may have gone past."""
        self.add([question])
        if question.free:
            self._return(question)

    def remove(self, question: Question) -> None:
        """Put a question away that has all its answers."""
        del self._questions[question.id]

    def first(self, annotator: str) -> Question | None:
        """The first free question that this person was never given: the newest batch first, then as asked."""
        walk = self._walks[annotator]
        while walk.returned and not self._suits(walk.returned[0][2], annotator):
            heapq.heappop(walk.returned)  # taken by somebody else since, or closed
        found = [self._questions[walk.returned[0][2]]] if walk.returned else []
        for batch in self._batches:
            ids, place = self._lists[batch], walk.places.get(batch, 0)
            while place < len(ids) and not self._suits(ids[place], annotator):
                place += 1
            walk.places[batch] = place
            if place < len(ids):
                found.append(self._questions[ids[place]])
                break
        return min(found, key=lambda question: question.key, default=None)

    def lease(self, question: Question, annotator: str) -> None:
        """Hold a question for somebody from now on, or for longer."""
        if annotator not in question.seen:
            question.seen.add(annotator)
            self._walks[annotator].seen_free += question.free
        until = self._clock() + self.lease_seconds
        question.leases[annotator] = until
        # An older entry of the same lease is left on the heap: `sweep` sees that the lease was extended.
        heapq.heappush(self._expiries, (until, question.id, annotator))
        self._update(question)

    def forget(self, question: Question, annotator: str) -> None:
        """Somebody was never given a question after all."""
        question.seen.discard(annotator)
        walk = self._walks[annotator]
        walk.seen_free -= question.free
        question.leases.pop(annotator, None)
        self._update(question)
        heapq.heappush(walk.returned, question.key)

    def release(self, question: Question, annotator: str) -> None:
        """Somebody holds a question no longer."""
        question.leases.pop(annotator, None)
        self._update(question)

    def count(self, question: Question, answers: int) -> None:
        """So many answers stand now."""
        question.answered = answers
        self._update(question)

    def note_skip(self, question: Question, annotator: str, skipped: bool) -> None:
        """Whether somebody's word on a question is a skip now."""
        question.skipped = question.skipped | {annotator} if skipped else question.skipped - {annotator}

    def sweep(self) -> None:
        """End the leases whose time is up."""
        now = self._clock()
        while self._expiries and self._expiries[0][0] <= now:
            _, id, annotator = heapq.heappop(self._expiries)
            question = self._questions.get(id)
            if question is not None and question.leases.get(annotator, now + 1) <= now:
                self.release(question, annotator)

    def left(self, annotator: str) -> int:
        """How many free questions this person was never given."""
        return self.free - self._walks[annotator].seen_free

    def leased(self) -> int:
        return sum(bool(question.leases) for question in self._questions.values())

    def stuck(self, people: Iterable[str]) -> int:
        """How many questions all of these people have skipped, and nobody has judged or holds; none without people.

        A question that was given out and left, or that needs answers of more people than there are, only waits.
        """
        names = frozenset(people)
        untouched = (q for q in self._questions.values() if not (q.answered or q.leases))
        return sum(names <= q.skipped for q in untouched) if names else 0

    # --- keeping count ---------------------------------------------------------------------------------------

    def _suits(self, id: str, annotator: str) -> bool:
        question = self._questions.get(id)
        return question is not None and question.free and annotator not in question.seen

    def _room(self, question: Question) -> bool:
        return question.answered + len(question.leases) < self.overlap

    def _update(self, question: Question) -> None:
        """See whether a question is free, and have those find it who have gone past it."""
        free = self._room(question)
        if free == question.free:
            return
        self._recount(question, -1)
        question.free = free
        self._recount(question)
        if free:
            self._return(question)

    def _recount(self, question: Question, sign: int = 1) -> None:
        """Count a free question in, or out."""
        if question.free:
            self.free += sign
            for name in question.seen:
                self._walks[name].seen_free += sign

    def _return(self, question: Question) -> None:
        for name, walk in self._walks.items():
            if name not in question.seen:
                heapq.heappush(walk.returned, question.key)
