"""A simulated teacher that sees the hidden gold, as rational or as faulty as its settings say."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal, TypeAlias

import numpy as np
from pydantic import Field, model_validator

from prefrl.components import ConfigError, Settings
from prefrl.envs.heights import HEIGHTS
from prefrl.judgements import Answer, Choice, Comparison, Ranking, Rating, Skip
from prefrl.kinds import named, only
from prefrl.label import teachers
from prefrl.label.teachers import Limits, Survey
from prefrl.protocols import Store, Task
from prefrl.seeding import draw_seed, keyed
from prefrl.types import C, Floats, Query, Segment

ONE_OF = (
    ["rationality", "error_rate"],
    ["skip_below", "skip_rate", "skip_epsilon"],
    ["tie_within", "tie_rate", "tie_epsilon"],
)
"""Ways of saying the same thing."""
RELATIVE = ("error_rate", "skip_rate", "tie_rate", "skip_epsilon", "tie_epsilon", "length_bias")
"""Settings that are measured against the gold of what has been asked."""
Measure: TypeAlias = Callable[[Floats], Floats]
"""Simulator states (T, S) -> what a teacher sees of each step, (T,)."""


class OracleSettings(Settings):
    """Prefer the candidate with the higher gold; the faults of B-Pref's teachers can be switched on."""

    kind: Literal["oracle"] = "oracle"
    name: str = Field("oracle", min_length=1)
    """Who answers; kept with every answer."""
    judgement: Literal["ranking", "choice", "rating"] = "ranking"
    """What is said of K candidates: their order (two: a comparison), the best one, or a level for each."""
    sees: Literal["gold", "height"] = "gold"
    """What it goes by: gold, or how high the tip of an acrobot or a mountain car stands, on average over a segment, for
    want of any gold before the goal is reached. Gold stays the environment's own."""
    scale: int = Field(5, ge=2)
    """Levels of a rating; each is given to an equal share of all candidates asked about so far."""
    rationality: float | None = Field(None, gt=0)
    """Beta of Bradley-Terry, and of Plackett-Luce for rankings, in 1 / gold; never wrong when not given."""
    error_rate: float | None = Field(None, gt=0, le=0.49)
    """In the place of rationality: the share of decided pairs, of all asked so far, that is expected to be wrong."""
    mistake_rate: float = Field(0.0, ge=0, le=1)
    """The probability that a judgement is turned upside down; ties stay ties."""
    skip_below: float | None = None
    """Queries whose best candidate has less gold are skipped."""
    skip_rate: float = Field(0.0, ge=0, lt=1)
    """The same, with the threshold at this quantile of the best candidates of all queries asked so far."""
    skip_epsilon: float = Field(0.0, ge=0)
    """The same, with the threshold at this share of the mean gold of a candidate in this session (B-Pref's)."""
    tie_within: float = Field(0.0, ge=0)
    """Gold scores that differ by no more than this are judged equal."""
    tie_rate: float = Field(0.0, ge=0, lt=1)
    """The same, so wide that this share of the pairs asked so far and not skipped is judged equal."""
    tie_epsilon: float = Field(0.0, ge=0)
    """The same, at this share of the mean gold of a candidate in this session (B-Pref's)."""
    discount: float = Field(1.0, gt=0, le=1)
    """Of earlier steps against the last one: below 1 the teacher is myopic. Control only."""
    position_bias: float = Field(0.0, ge=0, le=1)
    """The probability that candidates are ranked as they were shown, whatever they are; ties stay ties."""
    length_bias: float = 0.0
    """What a typical difference in length is worth, in typical differences in gold (root mean squares). Text only."""
    bpref_compat: bool = False
    """Multiply by epsilon twice after the first session, as the code of B-Pref and its family does."""

    @model_validator(mode="after")
    def _no_contradiction(self) -> OracleSettings:
        fields = type(self).model_fields
        for names in ONE_OF:
            if len(given := [name for name in names if getattr(self, name) != fields[name].default]) > 1:
                raise ValueError(f"give one of {' and '.join(given)}: both say the same thing")
        if self.bpref_compat and not (self.skip_epsilon or self.tie_epsilon):
            raise ValueError("bpref_compat changes skip_epsilon and tie_epsilon only: give one of them")
        if self.sees != "gold" and (self.skip_epsilon or self.tie_epsilon):
            raise ValueError(
                f"skip_epsilon and tie_epsilon are shares of gold, and sees={self.sees}: use skip_rate and tie_rate"
            )
        if self.judgement == "rating" and self.position_bias:
            raise ValueError("position_bias changes an order, and a rating has none: leave it at 0")
        return self

    @property
    def relative(self) -> bool:
        """Whether the noise hangs on what else has been asked."""
        return self.judgement == "rating" or any(getattr(self, name) for name in RELATIVE)

    def build(self, task: Task) -> Oracle:
        kind = named(task.kind)
        if not kind.stepwise and self.discount != 1:
            raise ConfigError(
                f"labeler.discount: the gold of a {kind.noun} has one step, so expected 1, got {self.discount}; "
                "a myopic teacher needs a control task"
            )
        if not kind.lengthy and self.length_bias:
            raise ConfigError(
                f"labeler.length_bias: only texts differ in length; expected 0 for a task of kind {task.kind!r}"
            )
        return Oracle(self, self._measure(task))

    def _measure(self, task: Task) -> Measure | None:
        """Of what is seen in the place of gold."""
        if self.sees == "gold":
            return None
        if task.name not in HEIGHTS:
            raise ConfigError(
                f"labeler.sees={self.sees}: expected a task whose heights are known ({', '.join(HEIGHTS)}), got "
                f"{task.name}; use sees=gold"
            )
        return HEIGHTS[task.name]


@dataclass(frozen=True)
class Oracle:
    """Answers every open query at once (B-Pref's simulated teachers: Lee et al. 2021, section 4.2)."""

    settings: OracleSettings
    measure: Measure | None = None
    """What it goes by in the place of gold."""

    @property
    def name(self) -> str:
        return self.settings.name

    @property
    def by_gold(self) -> bool:
        return self.measure is None

    def answer(self, store: Store[C], rng: np.random.Generator) -> None:
        """Each answer hangs on its query and on the set of queries asked so far, not on the order of either.

        So a run that was killed gives the same ones when it goes on. Raises `ValueError` where gold is not finite.
        """
        base = draw_seed(rng)
        # A generator for each query by its id: who answered what before, and in which order, changes nothing.
        queries = store.open_queries(self.name)
        limits = self.limits(teachers.survey(store, self.name) if queries and self.settings.relative else None)
        store.answer([self.judge(q, store.gold(q.candidates), keyed(base, q.id), limits) for q in queries])

    def limits(self, asked: Survey[C] | None) -> Limits:
        """The teacher's noise in units of gold; relative settings need to know what has been asked."""
        s = self.settings
        found = Limits(-np.inf if s.skip_below is None else s.skip_below, s.tie_within, s.rationality)
        if not s.relative or asked is None or not asked.queries:
            return found
        # In this order: thresholds are taken of what is seen, length included, and noise of what is not skipped.
        found = self._with_length(found, asked)
        seen = teachers.blocks([self.see(q, asked.gold[q.id], found) for q in asked.queries])
        return self._with_noise(self._with_thresholds(found, asked, seen), seen)

    def _with_length(self, found: Limits, asked: Survey[C]) -> Limits:
        """The price of a character, from the spread of gold and of length within queries."""
        if not self.settings.length_bias:
            return found
        sizes = [teachers.lengths(q) for q in asked.queries]
        long = teachers.gaps(teachers.blocks(sizes))
        wide = teachers.gaps(teachers.blocks([self.see(q, asked.gold[q.id], found) for q in asked.queries]))
        if not long.any():
            return found
        price = self.settings.length_bias * float(np.sqrt(np.mean(wide**2) / np.mean(long**2)))
        return replace(found, length_price=price, length_mean=float(np.concatenate(sizes).mean()))

    def _with_thresholds(self, found: Limits, asked: Survey[C], seen: list[Floats]) -> Limits:
        s = self.settings
        below = found.skip_below
        within = found.tie_within
        if s.skip_rate:
            below = teachers.skip_threshold(seen, s.skip_rate)
        if s.skip_epsilon and (threshold := teachers.session_threshold(asked, s.skip_epsilon, s.bpref_compat)) > 0:
            below = threshold
        kept = _unskipped(seen, below)  # ties are a share of what is judged, so what is skipped goes first
        if s.tie_rate and kept:
            within = teachers.tie_threshold(kept, s.tie_rate)
        if s.tie_epsilon:
            within = max(0.0, teachers.session_threshold(asked, s.tie_epsilon, s.bpref_compat))
        return replace(found, skip_below=below, tie_within=within)

    def _with_noise(self, found: Limits, seen: list[Floats]) -> Limits:
        s = self.settings
        beta = found.rationality
        kept = _unskipped(seen, found.skip_below)
        if s.error_rate and kept:
            beta = teachers.rationality_for(kept, found.tie_within, s.error_rate)
        if s.judgement != "rating":
            return replace(found, rationality=beta)
        every = np.concatenate([block.ravel() for block in seen])  # blocks differ in K
        cuts = np.quantile(every, np.arange(1, s.scale) / s.scale)  # (scale - 1,)
        return replace(found, rationality=beta, cuts=tuple(cuts.tolist()))

    def see(self, query: Query[C], gold: Sequence[Floats], limits: Limits) -> Floats:
        """(K,) what each candidate seems to be worth: its gold, discounted, plus what its length adds.

        A teacher that does not go by gold has a measure of its own in the place of it.
        """
        steps = gold if self.measure is None else [self.measure(states) for states in _states(query)]
        try:
            seen = teachers.discounted(steps, self.settings.discount)
        except ValueError as error:
            raise ValueError(f"query {query.id[:12]}: {error}") from None
        return seen + limits.length_price * (teachers.lengths(query) - limits.length_mean)

    def judge(self, query: Query[C], gold: Sequence[Floats], rng: np.random.Generator, limits: Limits) -> Answer:
        """Answer one query from the gold of its candidates, shown in a random order."""
        seen = self.see(query, gold, limits)
        mistaken = bool(rng.random() < self.settings.mistake_rate)
        shown = tuple(int(i) for i in rng.permutation(len(seen)))
        if seen.max() < limits.skip_below:
            return Skip(query.id, "skip", self.name, shown)
        groups = teachers.tie_groups(seen[None], limits.tie_within)
        worth = teachers.group_means(seen[None], groups)[0]
        if limits.rationality is not None:  # the order of values plus Gumbel noise is a draw from Plackett-Luce
            worth = worth + (rng.gumbel(size=len(seen))[groups[0]] - np.euler_gamma) / limits.rationality
        if self.settings.judgement == "rating":
            return self._rate(query, worth, mistaken, shown, limits)
        if rng.random() < self.settings.position_bias:
            # A group stands where its first one was shown: what is equal stays equal.
            worth = -np.array([min(shown.index(j) for j in np.flatnonzero(groups[0] == g)) for g in groups[0]], float)
        return self._order(query, -worth if mistaken else worth, shown, rng)

    def _rate(self, query: Query[C], worth: Floats, mistaken: bool, shown: tuple[int, ...], limits: Limits) -> Rating:
        scale = self.settings.scale
        levels = [int(level) for level in np.searchsorted(limits.cuts, worth, side="right")]
        levels = [scale - 1 - level for level in levels] if mistaken else levels
        return Rating(query.id, tuple(levels), scale, self.name, shown)

    def _order(self, query: Query[C], worth: Floats, shown: tuple[int, ...], rng: np.random.Generator) -> Answer:
        """Equal worth is a tie; the best of several equal ones is drawn at random."""
        if len(worth) < 2:
            raise ValueError(
                f"query {query.id[:12]} has one candidate, which can only be rated: use labeler.judgement=rating"
            )
        ranks = np.unique(-worth, return_inverse=True)[1]
        if self.settings.judgement == "choice":
            return Choice(query.id, int(rng.choice(np.flatnonzero(ranks == 0))), self.name, shown)
        if len(ranks) > 2:
            return Ranking(query.id, tuple(ranks.tolist()), self.name, shown)
        return Comparison(query.id, 0.5 + 0.5 * float(np.sign(ranks[1] - ranks[0])), self.name, shown)


def _states(query: Query[C]) -> list[Floats]:
    """The simulator states of each candidate. Raises `ValueError` where one has none."""
    error = ValueError(
        f"query {query.id[:12]} has candidates without simulator states, from which labeler.sees measures; leave "
        "task.after_end and task.options as they are, or use sees=gold"
    )
    found = [segment.states for segment in only(Segment, query.candidates, error)]
    if any(states is None for states in found):
        raise error
    return [states for states in found if states is not None]


def _unskipped(seen: list[Floats], skip_below: float) -> list[Floats]:
    """The queries that are judged."""
    kept = [block[block.max(1) >= skip_below] for block in seen]
    return [block for block in kept if len(block)]
