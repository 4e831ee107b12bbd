"""Judgements of every kind as terms of one likelihood: choices among a few candidates, and ratings."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from itertools import combinations
from typing import Any, NamedTuple, TypeVar

import numpy as np
import torch
from torch import Tensor

from prefrl.fit.settings import Rankings, Ties
from prefrl.judgements import Choice, Comparison, Judged, Judgement, Ranking, Rating, implied_pairs, person
from prefrl.types import C

MOST_TIED = 10
"""Sets of so many candidates are a thousand terms."""


@dataclass(frozen=True, eq=False)
class Choices:
    """S times, one or several of at most K candidates were preferred to the others."""

    items: Tensor
    """(S, K) int64: which candidates; the rest of a row repeats one of them."""
    present: Tensor
    """(S, K) bool: false for the rest of a row."""
    target: Tensor
    """(S, K): the probability that each was chosen; rows sum to 1."""
    tied: Tensor
    """(S,) bool: the candidates with a target are equally good, rather than one of them chosen."""
    weight: Tensor
    """(S,)."""
    judgement: Tensor
    """(S,) int64: which judgement it is part of."""

    @property
    def pairs(self) -> bool:
        """Whether there are two candidates in every row."""
        return self.items.shape[1] == 2


@dataclass(frozen=True, eq=False)
class Ratings:
    """R times, a candidate was put on a scale."""

    items: Tensor
    """(R,) int64."""
    level: Tensor
    """(R,) int64: 0 is worst."""
    weight: Tensor
    """(R,)."""
    judgement: Tensor
    """(R,) int64."""


Rows = TypeVar("Rows", Choices, Ratings)


@dataclass(frozen=True, eq=False)
class Terms:
    """All terms of some judgements."""

    choices: Choices
    ratings: Ratings
    labeler: Tensor
    """(J,) int64: who gave each judgement."""
    labelers: tuple[str, ...]
    scale: int
    """Levels of the ratings, 0 where there are none."""

    def to(self, device: torch.device) -> Terms:
        """The same terms on a device."""
        choices, ratings = _moved(self.choices, device), _moved(self.ratings, device)
        return replace(self, choices=choices, ratings=ratings, labeler=self.labeler.to(device))

    def subset(self, keep: Tensor) -> Terms:
        """The terms of the judgements where `keep` (J,) is true, which are counted anew."""
        number = keep.cumsum(0) - 1  # (J,): what the judgements that are kept are counted as
        choices, ratings = (
            _take(self.choices, keep[self.choices.judgement]),
            _take(self.ratings, keep[self.ratings.judgement]),
        )
        return replace(
            self,
            choices=replace(choices, judgement=number[choices.judgement]),
            ratings=replace(ratings, judgement=number[ratings.judgement]),
            labeler=self.labeler[keep],
        )

    def over(self, numbers: Tensor) -> Terms:
        """The same terms over other candidates: those that stood at 0, 1, ... in `candidates` stand at `numbers`."""
        count = self.choices.items.numel()
        items = numbers[:count].view_as(self.choices.items)
        return replace(
            self,
            choices=replace(self.choices, items=items),
            ratings=replace(self.ratings, items=numbers[count : count + len(self.ratings.items)]),
        )

    def candidates(self) -> Tensor:
        """(S * K + R,) every mention of a candidate."""
        return torch.cat([self.choices.items.flatten(), self.ratings.items])

    def minibatches(self, order: Tensor, size: int) -> Iterator[Terms]:
        """These terms, `size` judgements at a time, in the order of a permutation of the judgements (J,)."""
        place = torch.empty_like(order)  # (J,): the inverse permutation
        place[order] = torch.arange(len(order), device=order.device)
        count = math.ceil(len(order) / size)
        choices = _partition(self.choices, place[self.choices.judgement] // size, count)
        ratings = _partition(self.ratings, place[self.ratings.judgement] // size, count)
        for some, others in zip(choices, ratings, strict=True):
            yield replace(self, choices=some, ratings=others)


class Stage(NamedTuple):
    """A row of `Choices` in the making, over a query's own candidates."""

    items: Sequence[int]
    target: Sequence[float]
    tied: bool
    weight: float


def terms(judged: Sequence[Judged[C]], ids: Sequence[str], ties: Ties, rankings: Rankings) -> Terms:
    """Terms over candidates that stand in the order of `ids`. Raises `ValueError` where ratings differ in scale."""
    index = {id: i for i, id in enumerate(ids)}
    scales = sorted({one.judgement.scale for one in judged if isinstance(one.judgement, Rating)})
    if len(scales) > 1:
        raise ValueError(f"ratings of one fit must share a scale, got scales of {scales} levels: fit them apart")
    wide = (Choice,) if rankings == "pairs" else (Choice, Ranking)
    if ties == "rao_kupper" and any(isinstance(j.judgement, wide) and len(j.query.candidates) > 2 for j in judged):
        raise ValueError(
            "ties=rao_kupper knows pairs only, and there are rankings or choices of more than two: set ties=davidson, "
            "or for rankings rankings=pairs"
        )
    if rankings != "pairs" and any(_tied_group(one.judgement) > MOST_TIED for one in judged):
        raise ValueError(
            f"a ranking ties more than {MOST_TIED} candidates, and has too many orders: set rankings=pairs"
        )
    if ties == "davidson" and any(
        isinstance(j.judgement, wide) and len(j.query.candidates) > MOST_TIED for j in judged
    ):
        raise ValueError(f"ties=davidson weighs all sets of candidates, of at most {MOST_TIED}: set ties=half")
    people = [person(one.judgement.labeler) for one in judged]
    names = tuple(dict.fromkeys(people))
    numbers = {name: i for i, name in enumerate(names)}
    return Terms(
        choices=_choices(judged, index, ties, rankings),
        ratings=_ratings(judged, index),
        labeler=torch.tensor([numbers[name] for name in people]),
        labelers=names,
        scale=scales[0] if scales else 0,
    )


def _tied_group(judgement: Judgement) -> int:
    """The largest number of candidates that share a rank."""
    return max(Counter(judgement.ranks).values()) if isinstance(judgement, Ranking) else 1


def stages(judgement: Judgement, size: int, ties: Ties, rankings: Rankings) -> list[Stage]:
    """What a judgement of `size` candidates says of choices. A ranking without ties weighs size - 1.

    With ties as halves a tied group stands for the mean over all its orders, which for two candidates is the target of
    0.5: each set of what is left of the group competes with what is worse. The number of stages is then 2^n for a
    group of n.
    """
    weight = judgement.weight
    if isinstance(judgement, Comparison):
        p = judgement.preference
        return [Stage((0, 1), (p, 1 - p), p == 0.5, weight)]
    if isinstance(judgement, Choice):
        return [Stage(range(size), [float(i == judgement.best) for i in range(size)], False, weight)]
    if isinstance(judgement, Rating):
        return []
    if rankings == "pairs":
        pairs = implied_pairs(judgement, size)
        share = weight * (size - 1) / len(pairs)  # together they weigh as much as the stages of the ranking
        return [Stage((i, j), (p, 1 - p), p == 0.5, share) for i, j, p in pairs]
    return [stage for group, worse in _groups(judgement) for stage in _group_stages(group, worse, weight, ties)]


def _groups(ranking: Ranking) -> Iterator[tuple[list[int], list[int]]]:
    """Each tied group, best first, with all candidates that are worse."""
    for rank in sorted(set(ranking.ranks)):
        group = [i for i, r in enumerate(ranking.ranks) if r == rank]
        yield group, [i for i, r in enumerate(ranking.ranks) if r > rank]


def _group_stages(group: list[int], worse: list[int], weight: float, ties: Ties) -> Iterator[Stage]:
    """One stage where ties have a likelihood of their own, else one for each part of the group."""
    if len(group) + len(worse) < 2:
        return
    if ties == "davidson":
        yield _stage(group, worse, weight)
        return
    for left in range(len(group), 0, -1):
        for part in combinations(group, left):
            if left + len(worse) > 1:
                # In all orders of the group, every part of this size is what is left equally often.
                yield _stage(part, worse, weight / math.comb(len(group), left))


def _stage(best: Sequence[int], worse: Sequence[int], weight: float) -> Stage:
    target = [1 / len(best)] * len(best) + [0.0] * len(worse)
    return Stage([*best, *worse], target, len(best) > 1, weight)


def _choices(judged: Sequence[Judged[C]], index: dict[str, int], ties: Ties, rankings: Rankings) -> Choices:
    rows: list[tuple[list[int], Stage, int]] = [
        ([index[one.query.candidates[i].id] for i in stage.items], stage, number)
        for number, one in enumerate(judged)
        for stage in stages(one.judgement, len(one.query.candidates), ties, rankings)
    ]
    return _stacked(rows, max((len(at) for at, _, _ in rows), default=2))


def _stacked(rows: Sequence[tuple[list[int], Stage, int]], width: int) -> Choices:
    """(candidates, stage, judgement) -> tensors, each row filled up to `width`."""
    items = [[*at, *[at[0]] * (width - len(at))] for at, _, _ in rows]  # any valid index; `present` hides it
    target = [[*stage.target, *[0.0] * (width - len(at))] for at, stage, _ in rows]
    sizes = _tensor([len(at) for at, _, _ in rows], np.int64)
    return Choices(
        items=_tensor(items, np.int64).view(-1, width),
        present=torch.arange(width) < sizes[:, None],
        target=_tensor(target, np.float32).view(-1, width),
        tied=_tensor([stage.tied for _, stage, _ in rows], np.bool_),
        weight=_tensor([stage.weight for _, stage, _ in rows], np.float32),
        judgement=_tensor([number for _, _, number in rows], np.int64),
    )


def _tensor(values: Sequence[Any], dtype: Any) -> Tensor:
    """By way of NumPy, which reads lists several times faster than torch."""
    return torch.from_numpy(np.array(values, dtype))


def _ratings(judged: Sequence[Judged[C]], index: dict[str, int]) -> Ratings:
    rows = [
        (index[candidate.id], level, one.judgement.weight, number)
        for number, one in enumerate(judged)
        if isinstance(one.judgement, Rating)
        for candidate, level in zip(one.query.candidates, one.judgement.levels, strict=True)
    ]
    columns = list(zip(*rows, strict=True)) if rows else [(), (), (), ()]
    items, level, judgement = (torch.tensor(columns[i], dtype=torch.int64) for i in (0, 1, 3))
    return Ratings(items, level, torch.tensor(columns[2], dtype=torch.float32), judgement)


def _moved(rows: Rows, device: torch.device) -> Rows:
    return type(rows)(*(getattr(rows, field.name).to(device) for field in fields(rows)))


def _take(rows: Rows, at: Tensor) -> Rows:
    return type(rows)(*(getattr(rows, field.name)[at] for field in fields(rows)))


def _partition(rows: Rows, part: Tensor, count: int) -> list[Rows]:
    """The rows of each of `count` parts, by the part (S,) that each belongs to."""
    sizes: list[int] = part.bincount(minlength=count).tolist()
    # Stable: the rows of a part keep their order, so that sums over them round the same way each time.
    return [_take(rows, at) for at in torch.split(part.argsort(stable=True), sizes)]
