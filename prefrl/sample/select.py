"""Which candidates are worth a label. One signature for control and text: a query's candidates share a context.

Variants: uniform; greedy k-center; or the best of many random proposals by an ensemble's spread (Christiano et al.
2017, section 2.2.4), its entropy, or BALD (Houlsby et al. 2011). No two queries of a round share a candidate, and a
round's best may be thinned to a diverse batch. Left out: distance to what earlier rounds asked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Generic, Literal

import numpy as np
from pydantic import Field, model_validator

from prefrl.components import Settings
from prefrl.protocols import RewardModel, Selector
from prefrl.sample.acquisition import SCORES, joint_information
from prefrl.sample.diversity import dpp, k_center, k_medoids
from prefrl.sample.queries import asked, disjoint, groups, newest, proposals, query_features, topped_up
from prefrl.types import C, Floats, Integers, Query


class PoolSettings(Settings):
    """What may be asked about."""

    newest: float = Field(1.0, gt=0, le=1)
    """The share of the pool, from its end where the newest are, that may be asked about."""
    imagined: bool = False
    """Ask about what the policy would do, in the learner's world, and not about what it did: behaviour that would be
    dear or dangerous never has to happen (Reddy et al. 2020). For learners with a learned world."""


class UnscoredSettings(PoolSettings):
    """Ask without a look at what the reward model predicts; both kinds work before the first fit."""

    kind: Literal["uniform", "coverage"] = "uniform"
    """At random, or about queries that are far from one another (greedy k-center)."""
    candidates: int = Field(2, ge=1, le=8)
    """K: how many candidates a query puts side by side; 1 for an expert, who shows what to do instead."""
    best_of: int = Field(1, ge=1)
    """With one candidate, that of so many which the newest reward scores highest (to one prompt, for texts): people are
    then shown the better answer, to make it better still. Before the first fit it is any of them. `loop.pool` has to be
    as large."""

    @model_validator(mode="after")
    def _one_is_the_best(self) -> UnscoredSettings:
        if self.best_of > 1 and (self.kind != "uniform" or self.candidates > 1):
            raise ValueError("best_of chooses the one candidate that is shown: it takes kind=uniform and candidates=1")
        return self

    def build(self) -> Selector[C]:
        return Coverage(self) if self.kind == "coverage" else Uniform(self)


@dataclass(frozen=True)
class Uniform(Generic[C]):
    """Draws queries at random; with `best_of` each is what the reward likes best of a group drawn at random."""

    settings: UnscoredSettings

    def select(self, pool: Sequence[C], reward: RewardModel[C], count: int, rng: np.random.Generator) -> list[Query[C]]:
        pool = newest(pool, self.settings.newest)
        drawn = groups(pool, max(self.settings.candidates, self.settings.best_of), rng)[:count]
        if self.settings.best_of > 1:
            drawn = _best(pool, reward, drawn) if reward.fitted else drawn[:, :1]
        return asked(pool, drawn)


def _best(pool: Sequence[C], reward: RewardModel[C], drawn: Integers) -> Integers:
    """(Q, 1) indices of the candidate with the highest score in each of (Q, K)."""
    scores = reward.score([pool[i] for i in drawn.ravel().tolist()]).reshape(drawn.shape)
    return np.take_along_axis(drawn, scores.argmax(1)[:, None], 1)


@dataclass(frozen=True)
class Coverage(Generic[C]):
    """Draws queries at random, as many as the pool gives, and keeps those that lie far from one another.

    Distances are between the reward model's features of both candidates. The first query is a random one.
    """

    settings: UnscoredSettings

    def select(self, pool: Sequence[C], reward: RewardModel[C], count: int, rng: np.random.Generator) -> list[Query[C]]:
        pool = newest(pool, self.settings.newest)
        queries = groups(pool, self.settings.candidates, rng)
        if len(queries) > count:
            queries = queries[k_center(query_features(reward.features(pool), queries), count)]
        return asked(pool, queries)


class ScoredSettings(PoolSettings):
    """Ask where the answer is worth most to an ensemble: information is BALD's (Houlsby et al. 2011)."""

    kind: Literal["disagreement", "entropy", "information"] = "disagreement"
    """The members' spread of the preference probability, the entropy of their mean, or what the answer tells about
    which member is right."""
    candidates: int = Field(2, ge=2, le=8)
    """K: how many candidates a query puts side by side."""
    proposals: int = Field(8, ge=1)
    """In how many possible queries, about, each candidate is tried; at most one of them is asked."""
    diversify: Literal["none", "k_medoids", "dpp", "batch"] = "none"
    """How a round's queries are kept from being alike: by their features (k_medoids, or dpp, which weighs in the
    score), or by what they tell the ensemble together (batch)."""
    shortlist: int = Field(3, ge=2)
    """How many times the queries asked for are kept by score, before `diversify` chooses among them."""

    def build(self) -> Scored[C]:
        return Scored(self)

    def needs_members(self) -> bool:
        """Whether one member alone has nothing to say."""
        return self.kind != "entropy" or self.diversify == "batch"


@dataclass(frozen=True)
class Scored(Generic[C]):
    """Scores many possible queries and asks the best, each candidate at most once.

    Before the first fit scores are noise, and with one member nothing disagrees: the draw is then uniform.
    """

    settings: ScoredSettings

    def select(self, pool: Sequence[C], reward: RewardModel[C], count: int, rng: np.random.Generator) -> list[Query[C]]:
        settings, pool = self.settings, newest(pool, self.settings.newest)
        if not reward.fitted or (reward.members < 2 and settings.needs_members()):
            return asked(pool, groups(pool, settings.candidates, rng)[:count])
        queries = proposals(pool, settings.candidates, settings.proposals, rng)
        if not len(queries):
            return []
        scores = reward.raw_member_scores(pool)[:, queries]  # (E, N) -> (E, Q, K): each candidate is scored once
        values = SCORES[settings.kind](scores)
        kept = count if settings.diversify == "none" else count * settings.shortlist
        rows = disjoint(queries, np.argsort(-values, kind="stable"), kept)
        if len(rows) > count:
            rows = rows[self._diverse(_Shortlist(pool, reward, queries[rows], scores[:, rows], values[rows]), count)]
        return asked(pool, topped_up(pool, queries[rows], count, rng))

    def _diverse(self, shortlist: _Shortlist[C], count: int) -> Integers:
        if self.settings.diversify == "batch":
            return joint_information(shortlist.scores, count)
        if self.settings.diversify == "dpp":
            return dpp(shortlist.features(), shortlist.values, count)
        return k_medoids(shortlist.features(), count)


@dataclass(frozen=True, eq=False)
class _Shortlist(Generic[C]):
    """The queries with the highest values, best first."""

    pool: Sequence[C]
    reward: RewardModel[C]
    queries: Integers
    """(Q, K) indices into the pool."""
    scores: Floats
    """(E, Q, K) raw scores."""
    values: Floats
    """(Q,) what each is worth."""

    def features(self) -> Floats:
        """(Q, 2 d)."""
        return query_features(self.reward.features(self.pool), self.queries)
