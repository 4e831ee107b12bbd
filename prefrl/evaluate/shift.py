"""How far a policy is from an expert, step by step: mistakes lead to states that nobody has shown, where more are made.

Measured, not asked: the expert is a labeler at hand, whose advice in the states of an evaluation nobody learns from, so
it costs no label. Ross and Bagnell 2010, theorem 2.1: with an error of eps in the expert's own states, mistakes in H
steps can grow as eps H^2; where the policy finds its way back they grow as eps H.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np

from prefrl.evaluate.card import Mistakes, Shift, read_part
from prefrl.policies.rollout import Rollout, collect
from prefrl.protocols import Acts, ControlTask
from prefrl.storage.files import write_file
from prefrl.types import Bools, Floats, Segment

FILE = "shift.json"
MOST = 1000
"""Points of a curve: of longer episodes each is the mean of several steps."""

Advice: TypeAlias = Callable[[Floats], Floats]


@dataclass(frozen=True, eq=False)
class Yardstick:
    """An expert, and where it went by itself."""

    task: ControlTask
    advice: Advice
    own: Rollout
    """A row is an episode of the expert's, without noise, up to its first end."""

    @classmethod
    def of(cls, task: ControlTask, advice: Advice, episodes: int, rng: np.random.Generator) -> Yardstick:
        def act(observations: Floats, legal: Bools | None, begins: Bools) -> tuple[Floats, Floats]:
            actions = advice(observations)
            return actions, actions

        # On this rank alone, whose environments are its own.
        envs = task.environments(episodes)
        return cls(task, advice, collect(envs, envs.reset(rng), task.horizon, act)[0])

    def mistakes(self, number: int, learner: Acts, episodes: Sequence[Segment]) -> Mistakes:
        """Of a round's policy, in its own episodes and in the expert's."""
        whole = np.zeros((len(episodes), max(map(len, episodes))))  # (n, T)
        going = np.arange(whole.shape[1]) < np.array([[len(one)] for one in episodes])
        for row, one in zip(whole, episodes, strict=True):
            row[: len(one)] = errors(self.task, one.actions, self.advice(one.observations))
        blocks = _blocks(whole, going, every(self.task.horizon))
        return Mistakes(
            round=number,
            eps=self._eps(learner),
            error=[float(e.sum() / max(g.sum(), 1)) for e, g in zip(*blocks, strict=True)],
            running=[float(g.mean()) for g in blocks[1]],
        )

    def _eps(self, learner: Acts) -> float:
        act, memory, found = learner.actor(), None, []
        for t in range(self.own.ends.shape[1]):
            actions, memory = act(self.own.observations[:, t], None, memory)
            found.append(errors(self.task, actions, self.own.actions[:, t]))
        alive = np.cumsum(self.own.ends, 1) - self.own.ends == 0  # (n, T): up to the first end, that step included
        return float(np.stack(found, 1)[alive].mean())


def errors(task: ControlTask, actions: Floats, shown: Floats) -> Floats:
    """(n, A) actions beside what was shown -> (n,): 0 or 1 where they are discrete, else the mean over a step's actions
    of the distance as a share of the range, which is taken to be 2 for what has no bounds."""
    if task.action_bounds is None:
        wrong: Floats = (actions.argmax(-1) != shown.argmax(-1)).astype(np.float64)
        return wrong
    low, high = (np.asarray(side, np.float64) for side in task.action_bounds)
    bounded = np.isfinite(low) & np.isfinite(high)
    width = np.where(bounded, np.where(bounded, high, 1) - np.where(bounded, low, -1), 2)
    distance: Floats = np.minimum(np.abs(actions - shown) / width, 1).mean(-1)
    return distance


def every(horizon: int) -> int:
    """Steps to a point."""
    return math.ceil(horizon / MOST)


def _blocks(whole: Floats, going: Bools, width: int) -> tuple[list[Floats], list[Bools]]:
    """Errors and who goes on, in blocks of `width` steps."""
    cuts = range(width, whole.shape[1], width)
    return np.split(whole, list(cuts), 1), np.split(going, list(cuts), 1)


def keep_mistakes(folder: Path, found: Mistakes, episodes: int, horizon: int) -> None:
    """Write a round into the file of a run's folder; what is there of it, or of later ones, is replaced."""
    before = read_part(Shift, folder / FILE)
    rounds = [one for one in (before.rounds if before else ()) if one.round < found.round]
    shift = Shift(episodes=episodes, every=every(horizon), rounds=(*rounds, found))
    write_file(folder / FILE, shift.model_dump_json().encode())
