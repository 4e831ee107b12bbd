"""A crowd of simulated teachers, each with faults of its own.

Variant: our own. Each annotator is an `Oracle`, so one of B-Pref's teachers (Lee et al. 2021), and draws its noise
apart from the others; who judges a query is drawn at random. Left out: faults that annotators share, and giving a query
to those who are good at it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from prefrl.components import Settings
from prefrl.judgements import Answer
from prefrl.label.oracle import Oracle, OracleSettings
from prefrl.label.teachers import Limits, survey
from prefrl.protocols import Store, Task
from prefrl.seeding import draw_seed, keyed
from prefrl.types import C, Floats, Query


class CrowdSettings(Settings):
    """Several simulated teachers; each query goes to some of them."""

    kind: Literal["crowd"] = "crowd"
    annotators: tuple[OracleSettings, ...] = Field(min_length=1)
    """The settings of each teacher, with a name of its own."""
    overlap: int = Field(1, ge=1)
    """How many of them judge each query. Who skips is replaced by another, as long as there are any."""

    @model_validator(mode="after")
    def _can_be_told_apart(self) -> CrowdSettings:
        names = [a.name for a in self.annotators]
        if len(set(names)) < len(names):
            raise ValueError(f"annotators need a name each, all different, got {', '.join(names)}")
        if self.overlap > len(names):
            raise ValueError(f"overlap must be at most the number of annotators, {len(names)}, got {self.overlap}")
        return self

    def build(self, task: Task) -> Crowd:
        return Crowd(self, tuple(a.build(task) for a in self.annotators))


@dataclass(frozen=True)
class Crowd:
    """Has every open query judged by `overlap` annotators, drawn at random for each query.

    Answers stand under the annotators' own names, and all those to a query are filed in one transaction: one
    judgement closes a query, so nobody could add to it later.
    """

    settings: CrowdSettings
    annotators: tuple[Oracle, ...]
    name: str = "crowd"

    @property
    def by_gold(self) -> bool:
        return any(one.by_gold for one in self.annotators)

    def answer(self, store: Store[C], rng: np.random.Generator) -> None:
        """A query that all annotators skip stays open, in its place, for another labeler."""
        base = draw_seed(rng)
        queries = store.open_queries(self.name)
        if not queries:
            return
        # Once, before anybody answers: limits must not hang on who of the crowd came first.
        asked = survey(store, self.name)
        limits = {a.name: a.limits(asked) for a in self.annotators}
        willing = {a.name: {q.id for q in store.open_queries(a.name)} for a in self.annotators}
        answers: list[Answer] = []
        for query in queries:
            able = {a.name: limits[a.name] for a in self.annotators if query.id in willing[a.name]}
            answers += self._ask(query, asked.gold[query.id], base, able)
        store.answer(answers)

    def _ask(self, query: Query[C], gold: list[Floats], base: int, able: Mapping[str, Limits]) -> list[Answer]:
        """One annotator after the other, in an order of the query's own, until enough have judged it."""
        answers: list[Answer] = []
        for i in keyed(base, query.id).permutation(len(self.annotators)):
            one = self.annotators[i]
            if sum(a.reason is None for a in answers) == self.settings.overlap:
                break
            if one.name in able:
                # A generator for each: who else answers does not change what is said.
                answers.append(one.judge(query, gold, keyed(base, f"{query.id}/{one.name}"), able[one.name]))
        return answers
