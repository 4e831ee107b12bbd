"""Which candidates are worth a label. One signature for control and text: a query's candidates share a context."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Generic, Literal

import numpy as np
from pydantic import Field

from prefrl.components import Settings
from prefrl.protocols import RewardModel
from prefrl.types import C, Candidate, Floats, Query, Segment


def overlap(a: Candidate, b: Candidate) -> bool:
    """Whether two segments share steps of one episode; responses never do."""
    if not (isinstance(a, Segment) and isinstance(b, Segment)) or a.episode != b.episode:
        return False
    return a.start < b.start + len(b) and b.start < a.start + len(a)


def groups(pool: Sequence[C], size: int, rng: np.random.Generator) -> list[Query[C]]:
    """Disjoint random queries of `size` candidates of one context each, in random order.

    A candidate stands in at most one query, so that no query repeats or half-repeats another, and never beside one
    that it overlaps: what they share says nothing. Candidates left without enough others are dropped.
    """
    by_context: dict[str, list[C]] = defaultdict(list)
    for candidate in {c.id: c for c in pool}.values():
        by_context[candidate.context].append(candidate)
    found: list[Query[C]] = []
    for members in by_context.values():
        found += _first_fit([members[i] for i in rng.permutation(len(members))], size)
    return [found[i] for i in rng.permutation(len(found))]


def _first_fit(members: Sequence[C], size: int) -> list[Query[C]]:
    """Each candidate joins the first open group without one that it overlaps, else it opens a group."""
    found: list[Query[C]] = []
    opened: list[list[C]] = []  # few: whoever opened the newest overlaps a member of each
    for candidate in members:
        fits = (i for i, group in enumerate(opened) if not any(overlap(candidate, other) for other in group))
        at = next(fits, len(opened))
        if at == len(opened):
            opened.append([])
        opened[at].append(candidate)
        if len(opened[at]) == size:
            found.append(Query(tuple(opened.pop(at))))
    return found


class UniformSettings(Settings):
    """Ask about candidates drawn at random."""

    kind: Literal["uniform"] = "uniform"
    candidates: int = Field(2, ge=2, le=8)
    """K: how many candidates a query puts side by side."""

    def build(self) -> Uniform[C]:
        return Uniform(self)


@dataclass(frozen=True)
class Uniform(Generic[C]):
    """Draws queries at random."""

    settings: UniformSettings

    def select(self, pool: Sequence[C], reward: RewardModel[C], count: int, rng: np.random.Generator) -> list[Query[C]]:
        return groups(pool, self.settings.candidates, rng)[:count]


class DisagreementSettings(Settings):
    """Ask where the members of an ensemble disagree most (Christiano et al. 2017, section 2.2.4)."""

    kind: Literal["disagreement"] = "disagreement"
    candidates: int = Field(2, ge=2, le=8)
    """K: how many candidates a query puts side by side."""

    def build(self) -> Disagreement[C]:
        return Disagreement(self)


@dataclass(frozen=True)
class Disagreement(Generic[C]):
    """Draws queries at random, as many as the pool gives, and keeps those with the highest disagreement.

    Before the first fit the members' disagreement is noise, so the draw is uniform.
    """

    settings: DisagreementSettings

    def select(self, pool: Sequence[C], reward: RewardModel[C], count: int, rng: np.random.Generator) -> list[Query[C]]:
        queries = groups(pool, self.settings.candidates, rng)
        if not reward.fitted or reward.members < 2 or len(queries) <= count:
            return queries[:count]
        flat = [candidate for query in queries for candidate in query.candidates]
        scores = reward.raw_member_scores(flat).reshape(reward.members, len(queries), self.settings.candidates)
        best = np.argsort(-disagreement(scores), kind="stable")[:count]
        return [queries[i] for i in best]


def disagreement(scores: Floats) -> Floats:
    """(E, Q, K) raw scores -> (Q,): the members' std of the preference probability, averaged over candidate pairs.

    Raw scores are the logits of the fitted likelihood; settled ones are on another scale, and would saturate.
    """
    pairs = combinations(range(scores.shape[2]), 2)
    spread = [(0.5 + 0.5 * np.tanh((scores[:, :, i] - scores[:, :, j]) / 2)).std(0) for i, j in pairs]
    mean: Floats = np.mean(spread, axis=0)
    return mean
