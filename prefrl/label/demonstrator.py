"""Demonstrations that judge: a piece of what was shown is better than each piece of the learner's own.

Variant: imitation by an adversary (GAIL, Ho and Ermon 2016) with the likelihood of preferences in place of the
discriminator's, in the loop that is there: the reward is fitted on "shown is better than own", the policy gets better
at it, and its newer behaviour is asked about again. With `fitting.newest` only the newest answers count, as an
adversary's do; without it this is near maximum entropy inverse reinforcement learning (Ziebart et al. 2008).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field

from prefrl.components import ConfigError, Settings
from prefrl.exchange.recordings import recorded
from prefrl.judgements import Demonstration
from prefrl.label.expert import Expert, ExpertSettings
from prefrl.protocols import ControlTask, Store, Task, control
from prefrl.sample.segments import piece, placed
from prefrl.types import Query, Segment

MORE = "set labeler.data or labeler.expert.episodes"


class DemonstratorSettings(Settings):
    """Answer each segment of the learner's own with a piece of recorded demonstrations, whatever it is."""

    kind: Literal["demonstrator"] = "demonstrator"
    name: str = Field("demonstrator", min_length=1)
    """Who answers; kept with every answer."""
    data: Path | None = None
    """What was shown: a folder of demonstrations, an .npz of segments, or a Minari data set. Null for whole episodes
    that are shown first, by `expert`, or that are in the store already."""
    expert: ExpertSettings = ExpertSettings()
    """Who shows them, and how many; of no use where `data` is named."""

    def build(self, task: Task) -> Demonstrator:
        found = control(task, f"labeler kind {self.kind!r} answers about segments of control")
        if self.data is not None:
            return Demonstrator(self.name, shown(self.data, found))
        return Demonstrator(self.name, (), self.expert.build(task) if self.expert.episodes else None)


def shown(path: Path, task: ControlTask) -> Sequence[Segment]:
    """The recorded demonstrations. Raises `ConfigError` where they do not fit the task."""
    try:
        segments = recorded(path, task)
    except ValueError as error:
        raise ConfigError(f"labeler.data: {error}") from error
    if max(map(len, segments)) < task.segment_steps:
        raise ConfigError(
            f"labeler.data: no demonstration of {path} has task.segment_steps={task.segment_steps} steps: make them "
            "shorter, or choose another one"
        )
    return placed(task, segments)


@dataclass(frozen=True)
class Demonstrator:
    """A `Labeler` of segments that knows what was shown."""

    name: str
    shown: Sequence[Segment]
    expert: Expert | None = None
    """Who shows whole episodes first."""
    demonstrates: bool = True
    corrects: bool = True

    def check_shown(self, shows: bool, judged: bool) -> None:
        if not (self.shown or self.expert or shows):
            raise ConfigError(f"labeler.kind=demonstrator answers with what was shown, and nothing was: {MORE}")

    def answer(self, store: Store[Segment], rng: np.random.Generator) -> None:
        """Answer every open query with a random piece of the same length.

        Raises ValueError where nothing was shown that is as long.
        """
        if self.expert is not None:
            self.expert.show(store, rng)
        queries = store.open_queries(self.name)
        known = self.shown or [one.like for one in store.demonstrations() if one.query.candidates[0].id == one.like.id]
        likes = [_like(query, known, rng) for query in queries]
        store.keep(likes)
        store.answer([Demonstration(q.id, like.id, self.name) for q, like in zip(queries, likes, strict=True)])


def _like(query: Query[Segment], known: Sequence[Segment], rng: np.random.Generator) -> Segment:
    length, context = len(query.candidates[0]), query.candidates[0].context
    known = [one for one in known if one.context == context]  # of several tasks, its own
    starts = np.array([max(0, len(one) - length + 1) for one in known], int)
    if not starts.sum():
        where = f" in {context}" if context else ""
        raise ValueError(
            f"labeler.kind=demonstrator answers with {length} steps of what was shown{where}, and there are none: "
            f"{MORE}, or make task.segment_steps shorter"
        )
    at = int(rng.integers(starts.sum()))  # each piece is as probable as any other
    which = int(np.searchsorted(starts.cumsum(), at, side="right"))
    return piece(known[which], at - int(starts[:which].sum()), length)
