"""The loop: sample behaviours, ask and label, fit a reward model, improve the policy, evaluate, again.

It knows nothing of control or text: what is particular is in the task and the learner.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import perf_counter
from typing import Generic, Literal, TypeAlias, cast

import numpy as np
from pydantic import Field

from prefrl.components import Settings
from prefrl.evaluate.health import warnings
from prefrl.fit.settings import FittingSettings
from prefrl.protocols import (
    Attended,
    Demonstrates,
    Examined,
    Imagines,
    Imitates,
    Labeler,
    Learner,
    NeedsShowing,
    Paced,
    RewardModel,
    Selector,
    Settles,
    Store,
    Task,
)
from prefrl.seeding import Streams, streams, threads
from prefrl.types import C, Evaluation, Fitted, Metrics, Query, Round

Fit: TypeAlias = Callable[[RewardModel[C], Store[C], FittingSettings, np.random.Generator, Sequence[C]], Fitted]
"""What `prefrl.fit.trainer.fit` does."""


class LoopSettings(Settings):
    """How often, and how much is asked."""

    rounds: int = Field(10, ge=1)
    """Turns of the loop, the evaluation of the starting policy not counted."""
    labels: int = Field(200, ge=0)
    """Queries asked in all rounds together; skipped ones count, they cost a person's time too.

    With 0 the loop only improves and evaluates: for a reward model that was fitted before.
    """
    first_share: float = Field(0.25, gt=0, le=1)
    """The share of the labels that is asked in the first round."""
    spread: Literal["constant", "hyperbolic", "front"] = "constant"
    """How the rest is spread over the other rounds: evenly, or the n-th of them asks for 1 / n, or 1 / n^2, of what the
    first of them does: while the policy changes most, labels are worth most."""
    pool: float = Field(4.0, ge=1)
    """Candidates sampled for each one that is asked about, for the selector to choose from."""

    def shrunk(self) -> LoopSettings:
        return self.model_copy(update={"rounds": 1, "labels": min(self.labels, 8)})

    def asked_by(self, round: int) -> int:
        """How many labels have been asked for at the end of a round."""
        if round == 0 or self.rounds == 1:
            return self.labels * round
        power = {"constant": 0, "hyperbolic": 1, "front": 2}[self.spread]
        shares = [n**-power for n in range(1, self.rounds)]  # of the rounds after the first
        rest = (1 - self.first_share) * sum(shares[: round - 1]) / sum(shares)
        return round_half_up(self.labels * (self.first_share + rest))


@dataclass
class Loop(Generic[C]):
    """Everything that takes part, and where it stands.

    `for round in loop.run(): ...` runs it; printing, plotting, saving and stopping are the caller's.
    """

    task: Task
    learner: Learner[C]
    reward: RewardModel[C]
    labeler: Labeler[C]
    selector: Selector[C]
    store: Store[C]
    candidates: int
    """K: how many candidates a query puts side by side."""
    fitting: FittingSettings
    settings: LoopSettings
    seed: int = 0
    imagined: bool = False
    """Whether queries are about what the policy would do, in the learner's world."""
    threads: int | None = None
    """With how many threads torch and BLAS compute; None leaves that to them."""
    fit: Fit[C] | None = None
    """How stage 3 is done; None for `prefrl.fit.trainer.fit`."""
    round: int = -1
    """The last round that is done; 0 is the evaluation of the starting policy, -1 is nothing yet."""
    sequence: int = 0
    """The store's newest event when that round was done: a round that is done again asks the same."""
    fitted_on: int | None = None
    """The store's newest event when the reward was last fitted: without a newer one it stays as it is."""
    stage: str = "start"
    """What is going on, for whoever watches."""
    _seconds: Metrics = field(default_factory=dict)
    _notes: list[str] = field(default_factory=list)
    _warned: set[str] = field(default_factory=set)

    def check_shown(self) -> None:
        """Raises `ConfigError`, before anything is spent, where what the learner learns from neither is there nor will
        be, or where a labeler has nothing to answer with."""
        counts, labeler = self.store.counts(), self.labeler
        shown = counts.get("demonstrations", 0)
        shows = isinstance(labeler, Demonstrates) and labeler.demonstrates
        asks = self.settings.labels or isinstance(labeler, Attended) or self.store.open_queries()
        if isinstance(labeler, NeedsShowing) and asks:
            labeler.check_shown(bool(shown), judged=False)
        if isinstance(self.learner, NeedsShowing):
            judged = counts["answered"] > shown or bool(asks and not shows)
            self.learner.check_shown(shows or bool(shown), judged)

    def run(self) -> Iterator[Round[C]]:
        """Go on from where the loop stands to the last round."""
        while self.round < self.settings.rounds:
            with threads(self.threads):
                done = self.step() if self.round >= 0 else self.start()
            yield done

    def start(self) -> Round[C]:
        """Round 0: how good is the starting policy?"""
        evaluated = self._evaluate(streams(self.seed, 0))
        return self._finish(0, {}, evaluated, None)

    def step(self) -> Round[C]:
        """One turn of the loop: the five stages, in order."""
        number = self.round + 1
        rng = streams(self.seed, number)
        # A difference of rounded sums: over all rounds exactly `labels` are asked.
        pool = self.ask(self.settings.asked_by(number) - self.settings.asked_by(number - 1), rng)
        with self._timed("label"):
            self.labeler.answer(self.store, rng.label)
        fitted = self._fit(rng, pool)
        improved: Metrics = {}
        if self.reward.fitted or self.imitates:
            if isinstance(self.learner, Paced):
                self.learner.pace((number - 1) / self.settings.rounds, number / self.settings.rounds)
            with self._timed("improve"):
                improved = self.learner.improve(self.reward, self.store, rng.improve)
        return self._finish(number, improved, self._evaluate(rng), fitted)

    @property
    def imitates(self) -> bool:
        """Whether there is something to learn without a reward."""
        return isinstance(self.learner, Imitates) and self.learner.imitates(self.store)

    def ask(self, count: int, rng: Streams) -> list[C]:
        """Stage 1: sample a pool, and ask about the part of it that is worth a label; returns the pool.

        Raises `ValueError` where no two candidates of the pool can be compared.
        """
        if count <= 0:
            return []
        with self._timed("sample"):
            sample = cast(Imagines[C], self.learner).imagine if self.imagined else self.learner.sample
            pool = sample(int(count * self.candidates * self.settings.pool), rng.sample)
            queries = self.selector.select(pool, self.reward, count, rng.select)
            if not queries:
                raise ValueError(
                    f"{len(pool)} sampled candidates gave 0 of {count} queries of {self.candidates}: raise loop.pool, "
                    f"now {self.settings.pool}, or let the learner sample more that can be compared (for text "
                    "learner.asked_responses, for control shorter segments)"
                )
            queries = self._new(queries, pool, count, rng)
            self.store.ask(queries)
            if len(queries) < count:
                self._notes.append(
                    f"{len(pool)} sampled candidates gave {len(queries)} of {count} new queries of {self.candidates}"
                )
            return pool

    def _new(self, queries: list[Query[C]], pool: list[C], count: int, rng: Streams) -> list[Query[C]]:
        """Without those that were asked in rounds before: a policy may repeat itself. Others of the pool stand in."""
        # Up to the last finished round: one that was killed and is done again finds its own queries, and may ask them.
        known = self.store.asked_before([query.id for query in queries], self.sequence)
        if not known:
            return queries
        new = [query for query in queries if query.id not in known]
        used = {candidate.id for query in new for candidate in query.candidates}
        used |= self.store.asked_before([c.id for c in pool], self.sequence)
        return new + self.selector.select(
            [c for c in pool if c.id not in used], self.reward, count - len(new), rng.select
        )

    def _fit(self, rng: Streams, pool: list[C]) -> Fitted | None:
        from prefrl.fit.trainer import NothingToFit, fit  # torch is heavy, and who reads settings needs none

        newest = self.store.sequence
        if self.reward.fitted and newest == self.fitted_on:
            return None  # nothing new was said: more epochs would only fit the same answers closer
        with self._timed("fit"):
            try:
                fitted = (self.fit or fit)(self.reward, self.store, self.fitting, rng.fit, pool)
            except NothingToFit as error:  # people may not have answered yet: what is known stays
                if self.settings.labels and not self.imitates:
                    self._notes.append(f"nothing to fit: {error}")
                return None
        self.fitted_on = newest
        if self.fitting.held_out and not fitted.metrics["held_out"]:
            self._notes.append(
                "no judgement could be held out (too few, or all of the same behaviours): the fit ran all its epochs, "
                "and is not measured"
            )
        return fitted

    def _evaluate(self, rng: Streams) -> Evaluation[C]:
        with self._timed("evaluate"):
            evaluated = self.learner.evaluate(self.reward, rng.evaluate)
            settled = self.learner.settle(self.reward) if isinstance(self.learner, Settles) else None
        return settled or evaluated

    def _finish(self, number: int, improved: Metrics, evaluated: Evaluation[C], fitted: Fitted | None) -> Round[C]:
        """Gather the round's numbers, and count it as done."""
        of_itself = self.labeler.metrics if isinstance(self.labeler, Examined) else {}
        stages: dict[str, Metrics] = {
            "label": {name: float(n) for name, n in self.store.counts().items()} | of_itself,
            "fit": fitted.metrics if fitted else {},
            "improve": improved,
            "evaluate": evaluated.metrics,
            "steps": {name: float(n) for name, n in self.learner.steps.counted().items()},
            "seconds": self._seconds,
        }
        if not self.reward.fitted:
            stages["evaluate"].pop("learned", None)  # what an unfitted network says means nothing
        metrics = {f"{stage}/{name}": value for stage, values in stages.items() for name, value in values.items()}
        notes = (*self._notes, *evaluated.notes, *self._warnings(number, metrics))
        self.sequence = self.store.sequence
        self.round, self._seconds, self._notes, self.stage = number, {}, [], "idle"
        return Round(number, metrics, evaluated.examples, fitted, notes, evaluated.candidates)

    def _warnings(self, number: int, metrics: Metrics) -> list[str]:
        """What the round's numbers warn of, each thing once."""
        new = {name: text for name, text in warnings(number, metrics).items() if name not in self._warned}
        self._warned |= set(new)
        return list(new.values())

    @contextmanager
    def _timed(self, stage: str) -> Iterator[None]:
        self.stage, begin = stage, perf_counter()
        yield
        self._seconds[stage] = perf_counter() - begin


def round_half_up(x: float) -> int:
    return int(x + 0.5)
