"""What a person sees of a question: texts or the addresses of clips, in the order of the slots, and nothing else."""

from __future__ import annotations

import re
import threading
from collections import OrderedDict
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from prefrl.kinds import Shown, logged
from prefrl.page import api, records
from prefrl.page.questions import Given, Terms
from prefrl.page.shown import Moves
from prefrl.storage.log import EventLog
from prefrl.types import Json

REMEMBERED = 1000
"""Queries whose candidates are kept in memory."""


def whole(text: str) -> str:
    """A text without halves of surrogate pairs, which cannot be sent: a model may break off within a character."""
    return re.sub("[\ud800-\udfff]", "\N{REPLACEMENT CHARACTER}", text)


def _shown(candidate: Json) -> Shown:
    return logged(candidate["type"]).shown(candidate)


class ClipSource(Protocol):
    """Where clips come from; see `prefrl.page.clips.queue.Clips`."""

    def names(self, candidate: str) -> list[str]:
        """The addresses of a candidate's clip, best format first."""

    def want(self, candidate: str, soon: bool = False) -> None:
        """Have a clip drawn ahead."""

    async def get(self, name: str, wait: float) -> Path:
        """The file of a clip, by the last part of its address."""

    def counts(self) -> dict[str, int]:
        """Clips drawn, failed, cached and waiting."""


class Cards:
    """Makes the cards. May be used from any thread; it reads from the disk what it does not remember."""

    def __init__(
        self, events: EventLog, terms: Terms, clips: ClipSource | None, moves: Callable[[str], Moves] | None = None
    ) -> None:
        """`moves` says what was done in a candidate, where people are to see it."""
        self._log = events
        self._terms = terms
        self._clips = clips
        self._moves = moves
        self._known: OrderedDict[str, list[Json]] = OrderedDict()
        self._lock = threading.Lock()

    def show(self, given: Sequence[Given]) -> list[api.Assignment]:
        """The cards of questions, the first of which is looked at now, and the others soon."""
        found = self._candidates([one.query for one in given])
        cards = [self._card(one, found[one.query]) for one in given]
        if self._clips is not None:
            for number, one in enumerate(given):
                for candidate in found[one.query]:
                    self._clips.want(candidate["id"], soon=number == 0)
        return cards

    def _card(self, given: Given, candidates: list[Json]) -> api.Assignment:
        shown = [candidates[i] for i in given.shown]
        prompt = _shown(shown[0]).prompt
        return api.Assignment(
            assignment_id=given.id,
            query_id=given.query,
            kind=self._terms.page.kind,
            prompt=None if prompt is None else whole(prompt),
            items=[self._item(slot, candidate) for slot, candidate in enumerate(shown)],
            guideline=given.guideline,
            lease_seconds=self._terms.policy.lease_seconds,
        )

    def _item(self, slot: int, candidate: Json) -> api.Item:
        shown = _shown(candidate)
        if shown.text is not None:
            return api.Item(slot=slot, text=whole(shown.text))
        media = self._clips.names(candidate["id"]) if self._clips is not None else []
        moves = self._moves(candidate["id"]) if self._moves is not None else None
        return api.Item(slot=slot, media=media, steps=shown.steps, fps=self._terms.fps, actions=moves)

    def _candidates(self, queries: Sequence[str]) -> dict[str, list[Json]]:
        with self._lock:
            found = {id: self._known[id] for id in queries if id in self._known}
        new = [id for id in queries if id not in found]
        if new:
            with self._log.reading() as connection:
                found |= records.candidates(connection, new)
        with self._lock:
            for id in queries:
                self._known[id] = found[id]
                self._known.move_to_end(id)
            while len(self._known) > REMEMBERED:
                self._known.popitem(last=False)
        return found
