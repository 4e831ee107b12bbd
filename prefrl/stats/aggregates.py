"""Statistics over several runs, after Agarwal et al. 2021 ("Deep RL at the edge of the statistical precipice").

Runs are resampled within their task (stratified), so that a task with more seeds does not count for more. Intervals
are 95 % percentiles of the bootstrap; it knows only the runs that there are, and is narrow for few.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias

import numpy as np

from prefrl.stats.estimates import Estimate, undefined
from prefrl.types import Floats

Strata: TypeAlias = Sequence[Floats]
"""The scores of runs (S,) of each task."""
RESAMPLES = 2000
FEW = 3
"""With fewer runs of a task than this there is no interval."""


def interquartile_mean(scores: Floats, axis: int | None = None) -> Floats:
    """The mean of the middle half: as robust to outliers as a median, and steadier."""
    from scipy import stats  # a second, which few commands need

    return np.asarray(stats.trim_mean(scores, 0.25, axis=axis))


def of_runs(strata: Strata, rng: np.random.Generator, resamples: int = RESAMPLES) -> Estimate:
    """The interquartile mean over all runs."""
    return _estimate(strata, lambda drawn: interquartile_mean(np.concatenate(drawn, axis=1), axis=1), rng, resamples)


def improvement(ours: Strata, theirs: Strata, rng: np.random.Generator, resamples: int = RESAMPLES) -> Estimate:
    """How likely a run of ours is better than one of theirs on the same task, ties as halves; the mean over tasks."""
    if len(ours) != len(theirs):
        raise ValueError(f"expected as many tasks on both sides, got {len(ours)} and {len(theirs)}")

    def better(drawn: Sequence[Floats]) -> Floats:
        halves = zip(drawn[: len(ours)], drawn[len(ours) :], strict=True)
        pairs = [np.sign(x[:, :, None] - y[:, None, :]).mean(axis=(1, 2)) for x, y in halves]
        return np.asarray((1 + np.mean(pairs, axis=0)) / 2)

    return _estimate([*ours, *theirs], better, rng, resamples)


def profile(
    strata: Strata, thresholds: Floats, rng: np.random.Generator, resamples: int = RESAMPLES
) -> tuple[Floats, Floats, Floats]:
    """(T,) shares of runs above each threshold (T,), and the lower and upper ends of their intervals."""

    def above(drawn: Sequence[Floats]) -> Floats:
        return np.stack([(np.concatenate(drawn, axis=1) > at).mean(axis=1) for at in thresholds], axis=1)

    low, high = np.quantile(above(_drawn(strata, rng, resamples)), (0.025, 0.975), axis=0)
    return above([scores[None] for scores in strata])[0], low, high


def _drawn(strata: Strata, rng: np.random.Generator, resamples: int) -> list[Floats]:
    """For each task (resamples, S): its runs, drawn with replacement."""
    return [scores[rng.integers(len(scores), size=(resamples, len(scores)))] for scores in strata]


def _estimate(
    strata: Strata, statistic: Callable[[Sequence[Floats]], Floats], rng: np.random.Generator, resamples: int
) -> Estimate:
    sizes = [len(scores) for scores in strata]
    if not all(sizes) or not sizes:
        return undefined("no finished run")
    value = float(statistic([scores[None] for scores in strata])[0])
    if min(sizes) < FEW:
        return Estimate(value=value, count=sum(sizes), how=f"fewer than {FEW} runs: no interval")
    low, high = np.quantile(statistic(_drawn(strata, rng, resamples)), (0.025, 0.975))
    return Estimate(
        value=value, low=float(low), high=float(high), count=sum(sizes), how="stratified bootstrap over runs"
    )
