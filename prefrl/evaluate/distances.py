"""How far two rewards are apart, step by step, whatever their scale and shaping."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement
from math import comb, sqrt
from typing import Any, TypeAlias

import numpy as np

from prefrl.evaluate.card import Distance
from prefrl.protocols import RewardModel, StepRewardModel
from prefrl.stats.estimates import Estimate, undefined
from prefrl.types import Candidate, Floats, Segment

Reward: TypeAlias = Callable[[Floats, Floats, Floats], Floats]
"""(n, O) observations, (n, A) actions, (n, O) next observations -> (n,) rewards."""
MAX_FEATURES = 600
ROWS_PER_FEATURE = 4
FEWEST = 10
"""Segments with gold that a distance needs."""
EXPLAINED = 0.9
"""R^2 from which a regression may stand in for gold."""


@dataclass(frozen=True)
class Transitions:
    """n steps."""

    observations: Floats
    """(n, O)"""
    actions: Floats
    """(n, A)"""
    following: Floats
    """(n, O): the next observations."""

    def __len__(self) -> int:
        return len(self.observations)


def transitions(segments: Sequence[Segment]) -> Transitions:
    """The steps of segments. What follows a step is the next row, so each segment's last step is left out."""
    return Transitions(
        np.concatenate([s.observations[:-1] for s in segments]),
        np.concatenate([s.actions[:-1] for s in segments]),
        np.concatenate([s.observations[1:] for s in segments]),
    )


def pearson_distance(x: Floats, y: Floats) -> float | None:
    """sqrt((1 - rho) / 2) of two rows (n,): 0 for a positive affine map, 1 for a negative one; None if one is constant.

    Gleave et al. 2021, section 4.
    """
    if len(x) < 2 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return None
    return sqrt(max(0.0, 1.0 - float(np.corrcoef(x, y)[0, 1])) / 2.0)  # rounding can take a correlation above 1


def canonical(
    reward: Reward, steps: Transitions, states: Floats, actions: Floats, discount: float, chunk: int = 256
) -> Floats:
    """(n,) canonically shaped rewards of n steps: potential shaping drops out (Gleave et al. 2021, section 4).

    R(s, a, s') + g E[R(s', A, X)] - E[R(s, A, X)] - g E[R(S, A, X)], where A and X are drawn apart from each other:
    `actions` (m, A) and `states` (m, O) are the m draws, and S runs over `states` as well.
    """

    def mean_from(here: Floats) -> Floats:
        means = []
        for part in np.array_split(here, max(1, len(here) // chunk)):  # all pairs at once would be n x m rows
            left = np.repeat(part, len(states), 0)
            values = reward(left, np.tile(actions, (len(part), 1)), np.tile(states, (len(part), 1)))
            means.append(values.reshape(len(part), len(states)).mean(1))
        return np.concatenate(means)

    raw = reward(steps.observations, steps.actions, steps.following)
    shaped: Floats = raw + discount * mean_from(steps.following) - mean_from(steps.observations)
    shaped -= discount * mean_from(states).mean()
    return shaped


def epic(
    first: Reward,
    second: Reward,
    steps: Transitions,
    discount: float,
    rng: np.random.Generator,
    draws: tuple[int, int] = (512, 128),
) -> float | None:
    """The EPIC distance of two rewards on the coverage distribution of `steps` (Gleave et al. 2021, section 4).

    `draws`: how many steps the distance is taken over, and how many (action, state) pairs each mean. Both are drawn
    from `steps` without replacement; actions and states apart from each other. None where a reward is constant.
    """
    count, means = (min(n, len(steps)) for n in draws)
    at = rng.permutation(len(steps))[:count]
    some = Transitions(steps.observations[at], steps.actions[at], steps.following[at])
    # Two permutations: together, actions and states would be drawn from the joint distribution, not the product.
    actions, states = (x[rng.permutation(len(steps))[:means]] for x in (steps.actions, steps.observations))
    x, y = (canonical(reward, some, states, actions, discount) for reward in (first, second))
    return pearson_distance(_rounded(x), _rounded(y))


def _rounded(values: Floats) -> Floats:
    """Rounding errors of a reward that is constant after shaping are no signal."""
    return np.round(values.astype(np.float64), 9)


def regress(segments: Sequence[Segment], rng: np.random.Generator) -> tuple[Reward, float] | None:
    """A polynomial of (observation, action) for the gold of stored steps, and its R^2 on a fifth of the segments.

    Gold is known at stored steps only; a distance that asks about other actions needs a function. The degree is the
    highest of 4, 3, 2, 1 with at most `MAX_FEATURES` terms and `ROWS_PER_FEATURE` rows for each; None where even the
    last one is too much.
    """
    gold = [np.asarray(s.gold, np.float64) for s in segments]
    inputs = [np.concatenate([s.observations, s.actions], 1).astype(np.float64) for s in segments]
    # Split by segment: steps of one segment are too alike to be on both sides.
    test, train = np.split(rng.permutation(len(segments)), [max(1, len(segments) // 5)])
    x, y = (np.concatenate([rows[i] for i in train]) for rows in (inputs, gold))
    degree, mean, std = _degree(x.shape[1], len(x)), x.mean(0), x.std(0)
    if not degree:
        return None

    def features(rows: Floats) -> Floats:
        return monomials((rows - mean) / np.where(std > 1e-9, std, 1.0), degree)

    weights = np.linalg.lstsq(features(x), y, rcond=1e-10)[0]  # many products are collinear: the shortest solution
    unseen, seen_as = (np.concatenate([rows[i] for i in test]) for rows in (gold, inputs))
    squares = float(((unseen - unseen.mean()) ** 2).sum())
    explained = 1.0 - float(((unseen - features(seen_as) @ weights) ** 2).sum()) / squares if squares else 0.0
    return lambda s, a, _: features(np.concatenate([s, a], 1)) @ weights, explained


def monomials(x: Floats, degree: int) -> Floats:
    """(n, d) -> (n, F): 1 and all products of at most `degree` columns."""
    terms = [t for k in range(1, degree + 1) for t in combinations_with_replacement(range(x.shape[1]), k)]
    return np.stack([np.ones(len(x)), *(np.prod(x[:, t], 1) for t in terms)], 1)


def _degree(width: int, rows: int) -> int:
    """0 where no degree will do."""
    sizes = {k: comb(width + k, k) for k in (4, 3, 2, 1)}
    return next((k for k, n in sizes.items() if n <= min(MAX_FEATURES, rows // ROWS_PER_FEATURE)), 0)


def distance_part(
    reward: RewardModel[Any],
    candidates: Sequence[Candidate],
    known: Sequence[Candidate],
    discount: float,
    rng: np.random.Generator,
) -> Distance:
    """How far a learned reward is from the gold of the candidates' steps; `known` helps to guess gold in between."""
    steps = _with_gold(candidates)
    if not isinstance(reward, StepRewardModel) or len(steps) < FEWEST:
        control = isinstance(candidates[0], Segment)
        none = undefined(f"fewer than {FEWEST} segments with gold" if control else "for control only")
        return Distance(epic=none, direct=none, explained=none, coverage="")
    gold = [np.asarray(s.gold, np.float64) for s in steps]
    learned = [reward.rewards(s.observations[None], s.actions[None])[0] for s in steps]
    direct, count = pearson_distance(np.concatenate(learned), np.concatenate(gold)), sum(map(len, gold))
    # By id, since a segment can be among both.
    stand_in = regress(list({s.id: s for s in [*steps, *_with_gold(known)]}.values()), rng)
    return Distance(
        epic=_epic_part(reward, stand_in, steps, discount, rng),
        direct=_constant() if direct is None else Estimate(value=direct, count=count),
        explained=Estimate(value=stand_in[1], count=count) if stand_in else undefined("too few steps for a regression"),
        coverage=f"the stored steps of {len(steps)} segments; the next state is the segment's next row",
    )


def _epic_part(
    reward: StepRewardModel,
    stand_in: tuple[Reward, float] | None,
    steps: Sequence[Segment],
    discount: float,
    rng: np.random.Generator,
) -> Estimate:
    if reward.memory != 1:
        return undefined("the reward looks back at earlier steps: it is no function of a state and an action")
    if stand_in is None or stand_in[1] < EXPLAINED:
        found = f"a polynomial explains {stand_in[1]:.2f} of it" if stand_in else "there are too few for a regression"
        return undefined(f"gold is known at stored steps only, and {found}")

    def learned(states: Floats, actions: Floats, _: Floats) -> Floats:
        return reward.rewards(states[:, None], actions[:, None])[:, 0]

    taken = transitions(steps)
    value = epic(learned, stand_in[0], taken, discount, rng)
    return _constant() if value is None else Estimate(value=value, count=len(taken), how="gold by regression")


def _constant() -> Estimate:
    return undefined("a reward is the same at every step")


def _with_gold(candidates: Sequence[Candidate]) -> list[Segment]:
    """The segments whose gold is known at every step."""
    return [c for c in candidates if isinstance(c, Segment) and _has_gold(c)]


def _has_gold(segment: Segment) -> bool:
    gold = segment.gold
    return gold is not None and len(gold) == len(segment) > 1 and bool(np.isfinite(gold).all())
