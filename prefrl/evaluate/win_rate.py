"""Win rates: how often a policy's responses beat another's to the same prompts, and how sure that is.

Who wins a pair is said by scores (a reward model's, or the hidden gold) or by a labeler, which sees each pair in both
orders (position swap: Zheng et al. 2023, section 3.4). A tie is half a win, and the same text twice is a tie. What
hangs together for an interval is a prompt, with all responses to it. No score is corrected for length (as in Dubois
et al. 2024): how long both sides are, and how often the longer one won, is said instead.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from itertools import count
from typing import NamedTuple, TypeAlias

import numpy as np

from prefrl.judgements import Judged, implied_pairs
from prefrl.protocols import Labeler, Store, Swapping, Verdict
from prefrl.stats.estimates import Estimate, Part
from prefrl.stats.intervals import mean
from prefrl.types import Bools, Floats, Query, Response

Pair: TypeAlias = tuple[Response, Response]
"""Ours and theirs, to one prompt."""
TIE = 0.5
EQUAL = 1e-5
"""A preference this near to a tie is one: batches of another make-up move probabilities by float32's rounding."""


class Order(Part):
    """The order of two responses, and what it did to a labeler's answers."""

    position_bias: float | None = None
    """Mean preference for the response shown first, minus 0.5; None where no pair was judged."""
    flipped: float | None = None
    """Share of pairs whose two answers name different winners: by the order, or by a labeler's chance."""


class WinRate(Part):
    """The outcome of N pairs, one response of either side each."""

    rate: Estimate
    """Wins, and half of the ties, over the pairs that were judged; the interval is over prompts."""
    wins: int
    ties: int
    losses: int
    unjudged: int
    """Pairs that a labeler skipped, or whose score is missing: they count in no rate."""
    prompts: int
    """Distinct ones."""
    tokens: float
    """Mean length of this side's responses, the end token included, by this side's tokenizer."""
    other_tokens: float
    longer_won: Estimate
    """Of decided pairs that differ in characters, the share in which the longer response won."""
    order: Order | None = None
    """Where a labeler was asked."""

    @property
    def pairs(self) -> int:
        """N, the unjudged ones too."""
        return self.wins + self.ties + self.losses + self.unjudged


class Asked(NamedTuple):
    """The answers of a labeler to N pairs, each asked twice; NaN where it gave none."""

    ours: Floats
    """(N, 2) the preference for our response: asked about first, and second. A labeler may show the two in an order of
    its own, which its answer tells (`shown`)."""
    first: Floats
    """(N, 2) the preference for the response that was shown first."""

    @property
    def won(self) -> Floats:
        """(N,) 1, 0.5 or 0 by the mean of both answers, so that two which contradict each other are a tie."""
        both = self.ours.mean(1)
        found: Floats = np.where(np.abs(both - TIE) < EQUAL, TIE, (1 + np.sign(both - TIE)) / 2)
        return np.where(np.isnan(both), np.nan, found)

    @property
    def order(self) -> Order:
        sound = ~np.isnan(self.ours).any(1)
        if not sound.any():
            return Order()
        lean = self.ours[sound] - TIE
        turned = (lean.prod(1) < 0) & (np.abs(lean) > EQUAL).all(1)
        return Order(position_bias=float(self.first[sound].mean() - TIE), flipped=float(turned.mean()))


def win_rate(
    ours: Sequence[Response],
    theirs: Sequence[Response],
    won: Floats,
    rng: np.random.Generator,
    order: Order | None = None,
) -> WinRate:
    """Count `won` (N,): 1 for a win of ours, 0.5 for a tie, 0 for a loss, NaN for a pair that was not judged.

    Two equal texts are a tie, whatever was said of them. Raises `ValueError` where a pair answers different prompts.
    """
    prompts = [one.prompt for one in ours]
    if not prompts or prompts != [one.prompt for one in theirs]:
        raise ValueError("a win rate needs pairs of responses to one prompt each, and at least one pair")
    won = np.where(alike(ours, theirs), TIE, won)
    judged, unit = ~np.isnan(won), np.unique(prompts, return_inverse=True)[1]
    longer = np.sign([float(len(a.text) - len(b.text)) for a, b in zip(ours, theirs, strict=True)])
    telling = judged & (won != TIE) & (longer != 0)
    hits = (longer == np.sign(won - TIE)).astype(float)
    return WinRate(
        rate=mean(won[judged], unit[judged], rng, what="prompts"),
        wins=int((won > TIE).sum()),
        ties=int((won == TIE).sum()),
        losses=int((won < TIE).sum()),
        unjudged=int((~judged).sum()),
        prompts=len(set(prompts)),
        tokens=float(np.mean([len(one.tokens) for one in ours])),
        other_tokens=float(np.mean([len(one.tokens) for one in theirs])),
        longer_won=mean(hits[telling], unit[telling], rng, what="prompts"),
        order=order,
    )


def alike(ours: Sequence[Response], theirs: Sequence[Response]) -> Bools:
    """(N,) whether both sides wrote the same text."""
    return np.array([a.text == b.text for a, b in zip(ours, theirs, strict=True)], bool)


def by_scores(ours: Floats, theirs: Floats) -> Floats:
    """(N,) who has the higher score; equal ones tie, and NaN on either side leaves the pair unjudged."""
    won = np.where(ours == theirs, TIE, (ours > theirs).astype(float))  # not by a difference: two infinities have none
    return np.where(np.isnan(ours) | np.isnan(theirs), np.nan, won)


def by_labeler(
    ours: Sequence[Response],
    theirs: Sequence[Response],
    labeler: Labeler[Response],
    store: Store[Response],
    rng: np.random.Generator,
) -> Asked:
    """Ask a labeler about each pair in both orders, equal texts excepted: of those nothing is said (NaN).

    It is asked through `store`, an empty one, unless it compares pairs in both orders by itself.
    """
    differ = ~alike(ours, theirs)
    pairs = [(ours[i], theirs[i]) for i in np.flatnonzero(differ).tolist()]
    asked = Asked(np.full((len(ours), 2), np.nan), np.full((len(ours), 2), np.nan))
    said = _swapped(labeler.compare(pairs)) if isinstance(labeler, Swapping) else _through(store, labeler, pairs, rng)
    asked.ours[differ], asked.first[differ] = said.ours, said.first
    return asked


def _swapped(said: Sequence[Verdict]) -> Asked:
    ours = np.array([(one.forward, one.backward) for one in said], float).reshape(-1, 2)
    return Asked(ours, _other_side(ours))


def _other_side(preference: Floats) -> Floats:
    """(n, 2) preferences for our response -> those for the first of the two, and back: in column 1 ours is second."""
    return np.column_stack([preference[:, 0], 1 - preference[:, 1]])


def _through(
    store: Store[Response], labeler: Labeler[Response], pairs: Sequence[Pair], rng: np.random.Generator
) -> Asked:
    """As two queries for each pair."""
    queries = [(in_order(a, b), in_order(b, a)) for a, b in pairs]
    store.ask(list({query.id: query for both in queries for query in both}.values()))
    labeler.answer(store, rng)
    answers = _answers(store.judged())
    said = np.array([[answers.get(query.id, (np.nan, np.nan)) for query in both] for both in queries], float)
    said = said.reshape(-1, 2, 2)  # pairs; orders; the preference for the query's first, and for what was shown first
    return Asked(_other_side(said[:, :, 0]), said[:, :, 1])


def _answers(judged: Sequence[Judged[Response]]) -> dict[str, tuple[float, float]]:
    """Of each query of two: the preference for its first candidate, and for the one that was shown first.

    The mean, where several labelers answered.
    """
    found: dict[str, list[tuple[float, float]]] = defaultdict(list)
    for one in judged:
        ((i, _, better),) = implied_pairs(one.judgement, 2)
        first = better if i == 0 else 1 - better  # a choice is told from the side of the best
        lead = one.judgement.shown[:1] or (0,)
        found[one.query.id].append((first, first if lead[0] == 0 else 1 - first))
    return {id: (mean_of[0], mean_of[1]) for id, said in found.items() for mean_of in [np.mean(said, 0)]}


def in_order(first: Response, second: Response) -> Query[Response]:
    """A query that holds two texts in this order, for labelers that show them as they come.

    A query is ordered by the ids of its candidates, so marks are tried until it is this order. They stand in the place
    of tokens, for it is texts that are asked about.
    """
    marked = ([replace(one, prompt_tokens=(mark,), tokens=()) for one in (first, second)] for mark in count())
    return next(Query((a, b)) for a, b in marked if a.id < b.id)
