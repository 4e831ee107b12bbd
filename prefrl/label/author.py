"""An author who shows texts of their own, to be learned by `learner.kind=sft`.

Variant: as an expert's whole episodes in control, each text is a demonstration that stands for itself. Left out: better
responses to what the learner wrote, which would be DAgger for text.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from pydantic import Field

from prefrl.components import ConfigError, Settings
from prefrl.judgements import Demonstration
from prefrl.protocols import Authored, Store, Task, text
from prefrl.types import Query, Response

TRIES = 20
"""For each text that is wanted, since some come twice."""


class AuthorSettings(Settings):
    """Show good texts, once, before anything is learned: each is the best by gold of a few that the task can write."""

    kind: Literal["author"] = "author"
    name: str = Field("author", min_length=1)
    """Who shows; kept with every answer."""
    texts: int = Field(200, ge=1)
    """How many are shown; those that are there already count."""
    best_of: int = Field(8, ge=1)
    """Of so many drafts, each with a prompt of its own, the one with the highest gold is shown; 1 for any."""

    def shrunk(self) -> AuthorSettings:
        return self.model_copy(update={"texts": min(self.texts, 4), "best_of": min(self.best_of, 2)})

    def build(self, task: Task) -> Author:
        found = text(task, f"labeler kind {self.kind!r} writes texts")
        if not isinstance(found, Authored):
            raise ConfigError(
                f"labeler.kind={self.kind}: the task {task.name!r} has no writer of its own, as task.kind=reviews has: "
                'import JSON lines with "prompt" and "completion", and learn them with learner.kind=sft'
            )
        return Author(self, found)


@dataclass(frozen=True)
class Author:
    """A `Labeler` of responses."""

    settings: AuthorSettings
    task: Authored
    demonstrates: bool = True
    corrects: bool = False

    @property
    def name(self) -> str:
        return self.settings.name

    def answer(self, store: Store[Response], rng: np.random.Generator) -> None:
        """Show the texts, once. Raises `ValueError` where there is a question about somebody else's."""
        missing = self.settings.texts - sum(one.demonstration.labeler == self.name for one in store.demonstrations())
        shown = drafts(self.task, missing, self.settings.best_of, rng)
        if {query.id for query in store.open_queries(self.name)} - {Query((one,)).id for one in shown}:
            raise ValueError(
                "an author shows texts of their own, and answers no question about others': set loop.labels=0, or "
                "choose another labeler"
            )
        queries = [Query((one,)) for one in shown]
        store.ask(queries)
        # In the same order, so that a round that was killed in between, and is done again, goes on from there.
        store.answer([Demonstration(query.id, query.candidates[0].id, self.name) for query in queries])


def drafts(task: Authored, count: int, best_of: int, rng: np.random.Generator) -> list[Response]:
    """So many different texts, each the best of a few, with their gold."""
    found: dict[str, Response] = {}
    tries = 0
    while len(found) < count:
        if (tries := tries + 1) > TRIES * count:
            raise ValueError(
                f"labeler.texts: the task wrote only {len(found)} different texts in {TRIES * count} tries, and "
                f"{count} are to be shown: ask for fewer"
            )
        written = task.written(best_of, rng)
        golds = task.gold(written)
        best = int(golds.argmax())
        one = replace(written[best], gold=np.array([golds[best]]))
        found[one.id] = one
    return list(found.values())
