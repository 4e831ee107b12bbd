"""Where a reward model agrees with what was judged: by margin, by length, by labeler, by member."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt
from scipy.special import expit, log_expit, logsumexp

from prefrl.evaluate.card import Bucket, LabelerPart, Members
from prefrl.stats.estimates import Estimate, undefined
from prefrl.stats.intervals import mean
from prefrl.stats.raters import cohen
from prefrl.types import Floats, Integers

BUCKETS = 4


@dataclass(frozen=True, eq=False)
class Pairs:
    """M comparisons, and what is known of each."""

    logits: Floats
    """(E, M): each member's score of the first less that of the second."""
    preference: Floats
    """(M,)"""
    gold: Floats
    """(M,) gold of the first less that of the second; NaN where it is not known."""
    length: Floats
    """(M,) length of the first less that of the second."""
    labeler: npt.NDArray[np.str_]
    """(M,)"""
    cluster: Integers
    """(M,) which comparisons hang together."""
    clusters: str
    """In what sense; see `intervals.clusters`."""

    def __len__(self) -> int:
        return len(self.preference)

    def take(self, keep: npt.NDArray[np.bool_]) -> Pairs:
        """The comparisons where `keep` (M,) is true."""
        rows = {name: getattr(self, name)[keep] for name in ("preference", "gold", "length", "labeler", "cluster")}
        return replace(self, logits=self.logits[:, keep], **rows)

    @property
    def decided(self) -> Pairs:
        """Without ties."""
        return self.take(self.preference != 0.5)

    @property
    def predicted(self) -> Floats:
        """(M,) the members' mean probability that the first is better."""
        found: Floats = expit(self.logits).mean(0)
        return found

    @property
    def margin(self) -> Floats:
        """(M,) abs of the logit of `predicted`, right for probabilities that round to 0 or 1 as well."""
        # (M,) each: sums in place of means over members, whose log E cancels below.
        log_p, log_q = (logsumexp(log_expit(sign * self.logits), axis=0) for sign in (1, -1))
        found: Floats = np.abs(log_p - log_q)
        return found

    def accuracy(self, rng: np.random.Generator) -> Estimate:
        """How often the judged winner is predicted; ties are left out, an even prediction counts half."""
        some = self.decided
        return some.share(hits(some.predicted - 0.5, some.preference - 0.5), rng)

    def share(self, hit: Floats, rng: np.random.Generator) -> Estimate:
        """The mean of `hit` (M,) with an interval that knows which comparisons hang together."""
        return mean(hit, self.cluster, rng, what=self.clusters)


def hits(guess: Floats, truth: Floats) -> Floats:
    """(M,) 1 where the signs agree, 0 where they do not, 0.5 where one of them is 0."""
    found: Floats = 0.5 + 0.5 * np.sign(guess) * np.sign(truth)
    return found


def buckets(pairs: Pairs, margin: Floats, rng: np.random.Generator, lengths: bool = False) -> list[Bucket]:
    """Accuracy on decided comparisons by quantiles of a margin (M,) >= 0; equal margins stay together."""
    keep = (pairs.preference != 0.5) & np.isfinite(margin)
    some, margin = pairs.take(keep), margin[keep]
    if not len(some):
        return []
    # An observed value as a border, not one between two: equal margins then fall on one side of it.
    edges = np.unique(np.quantile(margin, np.linspace(0, 1, BUCKETS + 1)[1:-1], method="inverted_cdf"))
    at = np.searchsorted(edges, margin)
    return [_bucket(some.take(at == i), margin[at == i], rng, lengths) for i in np.unique(at)]


def _bucket(some: Pairs, margin: Floats, rng: np.random.Generator, lengths: bool) -> Bucket:
    longer = some.share(hits(some.length, some.preference - 0.5), rng) if lengths else None
    return Bucket(low=margin.min(), high=margin.max(), accuracy=some.accuracy(rng), longer=longer)


def against_gold(pairs: Pairs, guess: Floats, rng: np.random.Generator) -> Estimate:
    """How often `guess` (M,), positive for the first, names the better one by gold; equal golds are left out."""
    keep = np.isfinite(pairs.gold) & (pairs.gold != 0)
    if not keep.any():
        return undefined("no gold is known" if not np.isfinite(pairs.gold).any() else "all golds are equal")
    return pairs.take(keep).share(hits(guess[keep], pairs.gold[keep]), rng)


def labeler_part(pairs: Pairs, name: str, error_rate: float | None, rng: np.random.Generator) -> LabelerPart:
    """One labeler's judgements beside the model's."""
    some = pairs.take(pairs.labeler == name).decided
    missing = undefined("the fit did not estimate it")
    return LabelerPart(
        name=name or "(no name)",
        accuracy=some.accuracy(rng),
        kappa=kappa(some.predicted > 0.5, some.preference > 0.5),
        gold=against_gold(some, some.preference - 0.5, rng),
        error_rate=missing if error_rate is None else Estimate(value=error_rate, count=len(some)),
    )


def kappa(one: npt.NDArray[np.bool_], other: npt.NDArray[np.bool_]) -> Estimate:
    """Cohen's kappa of two raters who each name the first (true) or the second of M candidates (Cohen 1960)."""
    if not len(one):
        return undefined("no comparison of this sort")
    value = cohen(one.astype(np.int64), other.astype(np.int64))
    return undefined("both always name the same side") if value is None else Estimate(value=value, count=len(one))


def member_part(pairs: Pairs, rng: np.random.Generator) -> Members:
    """How far the members of the ensemble agree."""
    alone = [replace(pairs, logits=row[None]).accuracy(rng) for row in pairs.logits]
    if len(alone) < 2:
        return Members(accuracy=alone, unanimous=undefined("there is one member only"))
    same = np.abs(np.sign(pairs.logits).sum(0)) == len(alone)
    return Members(accuracy=alone, unanimous=pairs.share(same.astype(np.float64), rng))
