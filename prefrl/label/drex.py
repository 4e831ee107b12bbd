"""Judgements that nobody gives: of a policy's own episodes, those with fewer blind actions are better.

Variant: D-REX (Brown, Goo and Niekum 2019, "Better-than-Demonstrator Imitation Learning via Automatically-Ranked
Demonstrations", algorithm 1): a policy, as a rule a clone of what was shown, acts while a share of its actions is drawn
at random. The more of them, the worse it does, so rankings come for free, and a reward that is fitted on them can ask
for more than the policy does. Pairs are pieces of any two episodes whose shares are unlike enough. Left out: cloning,
which is a run of its own, and the standard reward that the authors bring to rank 1.

A reward that sees actions learns to tell drawn ones, and not what they lead to: set reward.features=observations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Literal

import numpy as np
from pydantic import Field

from prefrl.components import ConfigError, Settings
from prefrl.judgements import Comparison
from prefrl.label.expert import at_random, known
from prefrl.policies.acting import Actor, forgetful, played
from prefrl.policies.rollout import whole_episodes
from prefrl.policies.saved import expert
from prefrl.protocols import ControlTask, Mixed, Store, Task, simulated
from prefrl.sample.segments import first_episodes, piece
from prefrl.types import Bools, Floats, Query, Segment


class DrexSettings(Settings):
    """Play a policy's episodes with more and more blind actions, and call a piece with fewer of them the better one."""

    kind: Literal["drex"] = "drex"
    name: str = Field("drex", min_length=1)
    """Who judges; kept with every answer."""
    policy: Path | None = None
    """Whose episodes they are: the folder of a run of control on this task, a clone say, or a zip of stable-baselines3
    or sb3-contrib, by its mode. Null for the expert that is known for the task, which Pendulum-v1 has."""
    levels: int = Field(11, ge=2, le=1000)
    """How many shares of blind actions there are, evenly from 0 to 1."""
    episodes: int = Field(10, ge=1)
    """Whole episodes with each share, of each task where there are several. Their steps are the simulator's, and in no
    ledger."""
    pairs: int = Field(1000, ge=1)
    """How many pairs of pieces are judged, each of `task.segment_steps` steps, or of all of a shorter episode."""
    gap: float = Field(0.25, gt=0, le=1)
    """By how much the shares of a pair differ at least."""
    asks_itself: ClassVar[bool] = True

    def build(self, task: Task) -> Drex:
        found = simulated(task, f"labeler kind {self.kind!r} acts in control tasks")
        bounds = found.action_bounds
        if bounds is not None and not np.isfinite(bounds).all():
            raise ConfigError(f"labeler.kind=drex draws actions within their bounds, and {found.name} has none")
        actor = forgetful(known(found)) if self.policy is None else expert(self.policy, found, "labeler.policy").actor
        return Drex(self, found, actor)


@dataclass
class Drex:
    """A `Labeler` of its own segments."""

    settings: DrexSettings
    task: ControlTask
    actor: Actor
    """Who acts, without a generator."""
    demonstrates: bool = False
    corrects: bool = False
    asked: bool = field(default=False, init=False)
    """Whether its own pairs are known to be in the store."""

    @property
    def name(self) -> str:
        return self.settings.name

    def answer(self, store: Store[Segment], rng: np.random.Generator) -> None:
        """Play, ask and judge all pairs, once. What others ask and answer in the same store stays theirs."""
        own = [query for query in store.open_queries(self.name) if self._is_own(query)]
        if not (own or self.asked or any(self._is_own(one.query) for one in store.judged())):
            own = self.drawn(rng)
            store.ask(own)
        # What was open was asked here, by a round that was killed in between.
        store.answer([self._judged(query) for query in own])
        self.asked = True

    def _is_own(self, query: Query[Segment]) -> bool:
        return all(one.episode.startswith(f"{self.name}/") for one in query.candidates)

    def drawn(self, rng: np.random.Generator) -> list[Query[Segment]]:
        """Pairs of pieces of episodes that were played with unlike shares. Raises ValueError where there are none."""
        tasks = len(self.task.names) if isinstance(self.task, Mixed) else 1  # neighbours are of one task after another
        shares = np.repeat(np.linspace(0, 1, self.settings.levels), self.settings.episodes * tasks)
        episodes = self.play(shares, rng)
        better, worse = np.nonzero(shares[None] - shares[:, None] > max(self.settings.gap - 1e-9, 0))
        pairs = [(episodes[i], episodes[j]) for i, j in zip(better.tolist(), worse.tolist(), strict=True)]
        pairs = [(one, other) for one, other in pairs if one.context == other.context]
        if not pairs:
            raise ValueError(f"labeler.gap={self.settings.gap}: no two episodes of one task are so far apart")
        drawn = (pairs[at] for at in rng.integers(len(pairs), size=self.settings.pairs))
        queries = [Query((self._cut(one, rng), self._cut(other, rng))) for one, other in drawn]
        return list({query.id: query for query in queries}.values())

    def play(self, shares: Floats, rng: np.random.Generator) -> Sequence[Segment]:
        """One whole episode with each share (n,); its name says the share."""
        acting = played(self.actor, None)

        def act(observations: Floats, legal: Bools | None, begins: Bools) -> tuple[Floats, Floats]:
            clean = acting(observations, legal, begins)[0]
            drawn = at_random(self.task, len(observations), legal, rng)
            done = np.where(rng.random(len(shares))[:, None] < shares[:, None], drawn, clean)
            return done, done

        rollout = whole_episodes(self.task, act, len(shares), rng)
        return first_episodes(self.task, rollout, [f"{self.name}/{share:.4f}" for share in shares])

    def _cut(self, one: Segment, rng: np.random.Generator) -> Segment:
        length = min(self.task.segment_steps, len(one))
        return piece(one, int(rng.integers(len(one) - length + 1)), length)

    def _judged(self, query: Query[Segment]) -> Comparison:
        first, second = (float(one.episode.removeprefix(f"{self.name}/").split("/")[0]) for one in query.candidates)
        return Comparison(query.id, 0.5 + 0.5 * float(np.sign(second - first)), self.name)
