"""All rounds by one reward, the newest: each fit has a scale of its own, so what each round's reward said of its own
policy cannot be compared. What was evaluated is kept, and scored once more.

The evaluations of two rounds begin alike, candidate by candidate, so a round also meets the start: how often is its
behaviour worth more?
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from prefrl.evaluate.card import Hindsight, Seen
from prefrl.evaluate.win_rate import by_scores
from prefrl.kinds import Arrays, kind_of, named
from prefrl.protocols import RewardModel
from prefrl.stats.estimates import Estimate, undefined
from prefrl.stats.intervals import average, mean
from prefrl.storage.checkpoints import load_state, save_state
from prefrl.storage.files import whole_folder
from prefrl.types import C, Candidate, Floats, Json

FOLDER, FILE = "evaluations", "hindsight.json"
MOST = 4_000_000
"""Bytes of arrays that are kept of a round: of long episodes with many observations only the first ones."""


def keep(folder: Path, number: int, candidates: Sequence[Candidate]) -> None:
    """Keep what a round's evaluation measured, in a run's folder. Gold and simulator states are left out."""
    keep_in(_place(folder, number), candidates)


def keep_in(place: Path, candidates: Sequence[Candidate]) -> None:
    """Keep candidates in a folder of their own, to be scored again."""
    kind = kind_of(candidates[0])
    bodies: list[Json] = []
    arrays: list[Arrays] = []
    size = 0
    for one in candidates:
        found = kind.arrays(kind.plain(one))
        size += sum(array.nbytes for array in found.values())
        if bodies and size > MOST:
            break
        bodies.append(kind.describe(one))
        arrays.append(found)
    with whole_folder(place) as work:
        save_state(work, "candidates", {"kind": kind.name, "bodies": bodies, "arrays": arrays})


def hindsight(
    folder: Path, last: int, fitted_round: int | None, reward: RewardModel[C], rng: np.random.Generator
) -> Hindsight | None:
    """What the rounds up to `last` are worth by a reward; None where none was kept, or the reward is not fitted."""
    kept = [number for number in range(last + 1) if _place(folder, number).exists()]
    if not kept or not reward.fitted:
        return None
    start = read(folder, kept[0])
    first = reward.score(start)
    rounds = []
    for number in kept:
        candidates = start if number == kept[0] else read(folder, number)
        scores = first if number == kept[0] else reward.score(candidates)
        alike = [a.context for a in candidates] == [b.context for b in start]
        won = _won(scores, first, rng) if alike and number > 0 else undefined("there is nothing to compare it with")
        rounds.append(Seen(round=number, learned=average(scores[~np.isnan(scores)]), won=won))
    return Hindsight(fitted_round=fitted_round, rounds=tuple(rounds))


def read(folder: Path, number: int) -> list[C]:
    """What was kept of a round. Raises `DamagedError` where it is not as it was written."""
    return read_from(_place(folder, number))


def read_from(place: Path) -> list[C]:
    """What `keep_in` wrote. Raises `DamagedError` where it is not as it was written."""
    state = load_state(place, "candidates")
    kind = named(state["kind"])
    pairs = zip(state["bodies"], state["arrays"], strict=True)
    return [kind.load(body, partial(dict, arrays)) for body, arrays in pairs]


def _won(scores: Floats, start: Floats, rng: np.random.Generator) -> Estimate:
    won = by_scores(scores, start)
    won = won[~np.isnan(won)]
    return mean(won, np.arange(len(won)), rng)


def _place(folder: Path, number: int) -> Path:
    return folder / FOLDER / f"round-{number:04d}"
