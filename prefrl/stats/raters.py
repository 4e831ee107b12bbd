"""How far several raters agree, beyond chance too. What is not defined has no value, and says why; never NaN.

Answers come in long form, so that anybody may have judged anything. Intervals are a bootstrap over items (over clusters
of items where some hang together).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np
from scipy.sparse import coo_array, csr_array

from prefrl.stats.estimates import Estimate
from prefrl.stats.intervals import RESAMPLES, defined, draws, mean, numbered, patterns, resampled
from prefrl.types import Floats, Integers

MOST_CATEGORIES = 32
COMMON = 10
"""Two raters with fewer common items have no kappa that says anything."""
MOST_PAIRINGS = 5_000_000
"""Pairs of answers to one item that Cohen's kappa looks at."""
ALIKE = "all answers are alike, so nothing is left beyond chance"


@dataclass(frozen=True, eq=False)
class Ratings:
    """n answers of raters to items. A rater who did not judge an item is simply not there."""

    item: Integers
    """(n,) which item was judged."""
    rater: Integers
    """(n,) by whom; at most once for each item."""
    value: Integers
    """(n,) which category was given, of at most 32; in their order where categories have one."""
    cluster: Integers | None = None
    """(n,) which items hang together, such as the pairs of one ranking; each by itself when not given."""

    def __post_init__(self) -> None:
        """Raise `ValueError` for columns of different lengths, too many categories, or an item judged twice by one."""
        sizes = {len(column) for column in (self.item, self.rater, self.value, self.units)}
        if len(sizes) > 1:
            raise ValueError(f"ratings need columns of one length, got lengths {sorted(sizes)}")
        if self.size > MOST_CATEGORIES:
            raise ValueError(f"expected at most {MOST_CATEGORIES} categories, got {self.size}: put near ones together")
        # One number for each pair of item and rater, so that a second answer shows.
        if len(np.unique(self.items * (len(self.item) + 1) + self.raters)) < len(self.item):
            raise ValueError("a rater judged an item twice: keep the one answer that stands")

    @cached_property
    def items(self) -> Integers:
        """(n,) items numbered from 0, without gaps, in the order of `item`; `raters` and `values` likewise."""
        return numbered(self.item)

    @cached_property
    def raters(self) -> Integers:
        return numbered(self.rater)

    @cached_property
    def values(self) -> Integers:
        return numbered(self.value)

    @property
    def size(self) -> int:
        """V, how many categories were used."""
        return int(self.values.max(initial=-1)) + 1

    @property
    def units(self) -> Integers:
        return self.item if self.cluster is None else self.cluster

    @cached_property
    def counts(self) -> Integers:
        """(Q, V) how many raters gave each item each category."""
        length = int(self.items.max(initial=-1)) + 1
        return np.bincount(self.items * self.size + self.values, minlength=length * self.size).reshape(length, -1)

    @cached_property
    def unit_of_item(self) -> Integers:
        """(Q,) what each item is resampled with."""
        found = np.zeros(len(self.counts), np.int64)
        found[self.items] = numbered(self.units)
        return found

    def lacking(self) -> Estimate | None:
        """Why there is no agreement to speak of; None where two raters share an item."""
        if not len(self.item):
            return Estimate(why="there are no answers")
        if not self.raters.any():
            return Estimate(why="there is only one rater")
        return None if (self.counts.sum(1) > 1).any() else Estimate(why="no item was judged by two raters")


def entropies(ratings: Ratings) -> Floats:
    """(Q,) bits of each item's shares of answers, in the order of `item`: 0 where all say the same."""
    if not len(ratings.item):
        return np.zeros(0)
    from scipy import stats  # a second, which few commands need

    return np.asarray(stats.entropy(ratings.counts, base=2, axis=1), np.float64)


# --- agreement -----------------------------------------------------------------------------------------------------


def raw_agreement(ratings: Ratings, rng: np.random.Generator, resamples: int = RESAMPLES) -> Estimate:
    """How often two raters of one item say the same: the mean over items with two answers or more.

    Where all items agree alike a bootstrap sees no spread, and Wilson's interval over items stands in.
    """
    if lacking := ratings.lacking():
        return lacking
    counts, unit = _shared(ratings)
    return mean(_alike(counts), unit, rng, resamples)


def agreement_with_others(ratings: Ratings, rng: np.random.Generator, resamples: int = RESAMPLES) -> list[Estimate]:
    """For each rater, in the order of `rater`: the mean, over items, of the share of the others who say the same."""
    if not len(ratings.item):
        return []
    others = ratings.counts.sum(1)[ratings.items] - 1  # (n,): without the rater
    same = (ratings.counts[ratings.items, ratings.values] - 1) / np.maximum(others, 1)
    shared, unit = others > 0, ratings.unit_of_item[ratings.items]
    rows = [shared & (ratings.raters == rater) for rater in range(int(ratings.raters.max()) + 1)]
    alone = Estimate(why="nobody else judged what this rater did")
    return [mean(same[keep], unit[keep], rng, resamples) if keep.any() else alone for keep in rows]


def fleiss_kappa(ratings: Ratings, rng: np.random.Generator, resamples: int = RESAMPLES) -> Estimate:
    """Fleiss' kappa (Fleiss 1971), over items with two answers or more.

    Items may differ in their number of answers: an item's agreement is over its own pairs of answers, a category's
    share over all answers. With equal numbers this is the paper's.
    """
    if lacking := ratings.lacking():
        return lacking
    counts, unit = _shared(ratings)
    parts = np.column_stack([np.ones(len(counts)), _alike(counts), counts])
    return _beyond_chance(parts, unit, _fleiss, rng, resamples)


def krippendorff_alpha(
    ratings: Ratings,
    rng: np.random.Generator,
    level: Literal["nominal", "ordinal"] = "nominal",
    resamples: int = RESAMPLES,
) -> Estimate:
    """Krippendorff's alpha (Krippendorff 2011, "Computing Krippendorff's Alpha-Reliability"); answers may be missing.

    The interval resamples items, where Krippendorff resamples pairs of answers: those to one item hang together.
    """
    if lacking := ratings.lacking():
        return lacking
    counts, unit = _shared(ratings)
    size = ratings.size
    # (Q, V, V) ordered pairs of two different answers: an answer makes no pair with itself.
    pairs = counts[:, :, None] * (counts[:, None, :] - np.eye(size, dtype=np.int64))
    coincidences = (pairs / (counts.sum(1) - 1)[:, None, None]).reshape(-1, size * size)
    measure = _nominal if level == "nominal" else _ordinal
    return _beyond_chance(coincidences, unit, lambda sums: measure(sums.reshape(-1, size, size)), rng, resamples)


def cohen_kappa(ratings: Ratings, rng: np.random.Generator, resamples: int = RESAMPLES) -> Estimate:
    """Cohen's kappa (Cohen 1960): the mean over pairs of raters, each weighted with its number of common items.

    Where everybody judged everything that is the plain mean of Light (1971). Left out are pairs that always say one
    and the same thing, whose kappa is not defined, and pairs with fewer than 10 common items.
    """
    if lacking := ratings.lacking():
        return lacking
    many = ratings.counts.sum(1)
    if (pairings := int((many * (many - 1)).sum() // 2)) > MOST_PAIRINGS:
        return Estimate(why=f"{pairings} pairs of answers to one item are too many to go through")
    tables, items, size = _contingency(ratings)
    if not tables.shape[1]:
        return Estimate(why=f"no two raters judged {COMMON} items in common")

    def measure(sums: Floats) -> Floats:
        return _mean_kappa(sums.reshape(len(sums), -1, size, size))

    weights = resampled(*tables.shape, resamples, rng)
    drawn = (measure(np.asarray(some @ tables, np.float64)) for some in weights)
    found = Estimate(count=items, why=ALIKE)
    return defined(measure(np.asarray(tables.sum(0), np.float64)[None]), drawn, tables.shape[0], found)


def cohen(one: Integers, other: Integers) -> float | None:
    """Cohen's kappa of two raters' categories, (n,) each, of the same n items; None where it is not defined."""
    if not len(one):
        return None
    values = numbered(np.concatenate([one, other]).astype(np.int64))
    size = int(values.max()) + 1
    table = np.bincount(values[: len(one)] * size + values[len(one) :], minlength=size * size)
    value = float(_kappas(table.reshape(size, size).astype(np.float64)))
    return value if np.isfinite(value) else None


def _beyond_chance(
    parts: Floats, unit: Integers, measure: Callable[[Floats], Floats], rng: np.random.Generator, resamples: int
) -> Estimate:
    """A measure of the sums (B, D) of each item's parts (Q, D)."""
    rows, sizes = patterns(parts, unit)
    drawn = (measure(weights @ rows) for weights in draws(sizes, resamples, rng))
    found = Estimate(count=len(parts), why=ALIKE)
    return defined(measure(np.asarray(parts.sum(0, keepdims=True), np.float64)), drawn, int(sizes.sum()), found)


def _shared(ratings: Ratings) -> tuple[Integers, Integers]:
    """Counts (Q', V) and units (Q',) of the items with two answers or more."""
    keep = ratings.counts.sum(1) > 1
    return ratings.counts[keep], ratings.unit_of_item[keep]


def _contingency(ratings: Ratings) -> tuple[csr_array, int, int]:
    """How often, in each unit, each pair of raters gave each pair of categories: (U, pairs V V), items, and V.

    Only pairs with enough common items, and what they judged.
    """
    # By item, then rater: a pair of raters is always met in the same order, so its table is not split in two.
    order = np.lexsort((ratings.raters, ratings.items))
    item, rater, value = ratings.items[order], ratings.raters[order], ratings.values[order]
    # Answers to one item are neighbours: all pairs d places apart, for each d up to the longest run.
    rows = [np.flatnonzero(item[d:] == item[:-d]) for d in range(1, int(ratings.counts.sum(1).max()))]
    a = np.concatenate(rows)
    b = a + np.repeat(np.arange(1, len(rows) + 1), [len(row) for row in rows])
    pair = numbered(rater[a] * (int(rater.max()) + 1) + rater[b])
    keep = np.bincount(pair)[pair] >= COMMON
    a, b, pair = a[keep], b[keep], numbered(pair[keep])
    unit = numbered(ratings.unit_of_item[item[a]])
    column = (pair * ratings.size + value[a]) * ratings.size + value[b]
    shape = (int(unit.max(initial=-1)) + 1, (int(pair.max(initial=-1)) + 1) * ratings.size**2)
    table = coo_array((np.ones(len(a)), (unit, column)), shape=shape)
    return csr_array(table), len(np.unique(item[a])), ratings.size


def _alike(counts: Integers) -> Floats:
    """(Q,) the share of each item's pairs of answers that are the same."""
    total = counts.sum(1)
    found: Floats = (counts * (counts - 1)).sum(1) / (total * (total - 1))
    return found


def _fleiss(sums: Floats) -> Floats:
    """(B, 2 + V) -> (B,): items, their summed agreement, and answers of each category."""
    answers = sums[:, 2:]
    return _ratio(sums[:, 1] / sums[:, 0], (answers**2).sum(1), answers.sum(1) ** 2)


def _kappas(tables: Floats) -> Floats:
    """(..., V, V) contingency tables -> (...) Cohen's kappa, NaN where it is not defined."""
    total = tables.sum((-2, -1))
    by_chance = (tables.sum(-1) * tables.sum(-2)).sum(-1)
    # The maximum: a pair of raters may have no common item in a resample; its kappa is NaN below.
    observed = np.trace(tables, axis1=-2, axis2=-1) / np.maximum(total, 1)
    return _ratio(observed, by_chance, total**2)


def _mean_kappa(tables: Floats) -> Floats:
    """(B, P, V, V) -> (B,): of P pairs of raters, weighted with their common items."""
    kappas, total = _kappas(tables), tables.sum((-2, -1))
    some = np.isfinite(kappas)
    weight = np.where(some, total, 0).sum(1)
    found: Floats = np.where(some, kappas * total, 0).sum(1) / np.where(weight > 0, weight, np.nan)
    return found


def _ratio(observed: Floats, by_chance: Floats, total: Floats) -> Floats:
    """(observed - chance) / (1 - chance) with chance = by_chance / total: whole numbers, so 1 is exactly 1."""
    found: Floats = (observed * total - by_chance) / np.where(total > by_chance, total - by_chance, np.nan)
    return found


def _nominal(coincidences: Floats) -> Floats:
    """(B, V, V) -> (B,): alpha where categories are the same or not."""
    size = coincidences.shape[-1]
    return _alpha(coincidences, np.broadcast_to(1.0 - np.eye(size), coincidences.shape))


def _ordinal(coincidences: Floats) -> Floats:
    """(B, V, V) -> (B,): alpha where categories are as far apart as there are answers between their middles."""
    each = coincidences.sum(2)
    middle = each.cumsum(1) - each / 2
    return _alpha(coincidences, (middle[:, :, None] - middle[:, None, :]) ** 2)


def _alpha(coincidences: Floats, distance: Floats) -> Floats:
    """(B,) 1 - (n - 1) sum o_ck d_ck / sum n_c n_k d_ck, NaN where all answers are of one category."""
    each = coincidences.sum(2)
    expected = (each[:, :, None] * each[:, None, :] * distance).sum((1, 2))
    observed = (coincidences * distance).sum((1, 2)) * (each.sum(1) - 1)
    found: Floats = 1 - observed / np.where(expected > 0, expected, np.nan)
    return found
