"""A simulated teacher that sees the hidden gold."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from prefrl.components import Settings
from prefrl.protocols import Store, Task
from prefrl.seeding import draw_seed, keyed
from prefrl.types import C, Comparison, Judgement, Query, Ranking


class OracleSettings(Settings):
    """Prefer the candidate with the higher gold."""

    kind: Literal["oracle"] = "oracle"
    mistake_rate: float = Field(0.0, ge=0, le=1)
    """The probability that a judgement is turned upside down (B-Pref's mistake teacher)."""
    tie_within: float = Field(0.0, ge=0)
    """Gold scores that differ by no more than this are judged equal."""

    def build(self, task: Task) -> Oracle:
        return Oracle(self)


@dataclass(frozen=True)
class Oracle:
    """Answers every open query at once."""

    settings: OracleSettings
    name: str = "oracle"

    def answer(self, store: Store[C], rng: np.random.Generator) -> None:
        """Each answer hangs on its query alone, not on the order: a resumed run gets the same ones."""
        base = draw_seed(rng)
        queries = store.open_queries(self.name)
        store.answer([self.judge(q, store.gold(q.candidates), keyed(base, q.id)) for q in queries])

    def judge(self, query: Query[C], gold: Sequence[np.ndarray], rng: np.random.Generator) -> Judgement:
        """Judge one query from the gold of its candidates, shown in a random order."""
        scores = np.array([values.sum() for values in gold], float)
        if not np.isfinite(scores).all():
            raise ValueError(
                f"the oracle needs finite gold, got {scores} for query {query.id[:12]}; use another labeler"
            )
        if rng.random() < self.settings.mistake_rate:
            scores = -scores
        shown = tuple(int(i) for i in rng.permutation(len(scores)))
        ranks = _ranks(scores, self.settings.tie_within)
        if len(ranks) > 2:
            return Ranking(query.id, ranks, self.name, shown)
        return Comparison(query.id, 0.5 + 0.5 * float(np.sign(ranks[1] - ranks[0])), self.name, shown)


def _ranks(scores: np.ndarray, tie_within: float) -> tuple[int, ...]:
    """0 for the best; a score joins the group above while it is within reach of that group's best."""
    ranks, rank, best = [0] * len(scores), -1, np.inf
    for i in np.argsort(-scores, kind="stable"):
        if rank < 0 or best - scores[i] > tie_within:
            rank, best = rank + 1, scores[i]
        ranks[i] = rank
    return tuple(ranks)
