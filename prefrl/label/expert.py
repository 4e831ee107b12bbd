"""An expert who answers with behaviour: "in these states I would have done this".

Variant: DAgger (Ross et al. 2011, algorithm 3.1) with the expert alone in control of its own first episodes and the
learner alone from then on (their beta_i = I(i = 1)); noise as in DART (Laskey et al. 2017) with a fixed width. Left
out: mixtures of both within one episode, and noise that is fitted to the learner's errors.

An expert with a memory (what a recurrent network carries on, or the plan that a flow is in) remembers an episode of its
own from the first step on. What came before a segment of the learner's is not known: there it remembers from the
segment's first step on, which is exact where the episode begins with the segment, and an approximation elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, TypeAlias

import numpy as np
from pydantic import Field

from prefrl.components import ConfigError, Settings
from prefrl.envs.experts import EXPERTS, MOODS
from prefrl.judgements import Demonstration
from prefrl.policies.acting import Actor, Memory, forgetful, played
from prefrl.policies.rollout import whole_episodes
from prefrl.policies.saved import expert
from prefrl.protocols import ControlTask, Store, Task, simulated
from prefrl.sample.segments import first_episodes
from prefrl.types import Bools, Floats, Integers, Query, Segment

Advice: TypeAlias = Callable[[Floats], Floats]
"""Observations (n, O) -> the actions (n, A) of an expert without a memory, within the bounds, or one-hot."""
Moods: TypeAlias = Callable[[Floats, Floats], Floats]
"""The same of an expert who does not act alike in all episodes: it is also given (n,) in [0, 1), drawn for each."""


class ExpertSettings(Settings):
    """Show what to do: whole episodes at first, then the right actions in the states that the learner came to."""

    kind: Literal["expert"] = "expert"
    name: str = Field("expert", min_length=1)
    """Who shows; kept with every answer."""
    policy: Path | None = None
    """Whose actions they are: the folder of a run of control on this task, or a zip of stable-baselines3 or
    sb3-contrib; whatever `prefrl.load_policy` acts with, and by its mode. An expert with a memory that corrects a
    segment remembers from the segment's first step on. Null for the expert that is known for the task, which
    Pendulum-v1 has."""
    episodes: int = Field(4, ge=0)
    """Whole episodes of the expert's own, shown before anything is asked; those that are there already count."""
    noise: float = Field(0.0, ge=0)
    """Of what is executed in these episodes, as a std in half the action bounds, or for discrete actions the share that
    is drawn at random. What is shown are the actions without it: so the learner sees how to come back."""

    def build(self, task: Task) -> Expert:
        found = simulated(task, f"labeler kind {self.kind!r} acts in control tasks")
        if found.action_bounds is None and self.noise > 1:
            raise ConfigError(
                f"labeler.noise: of discrete actions it is a share, so expected at most 1, got {self.noise}"
            )
        if self.policy is None:
            return Expert(self, found, forgetful(known(found)), MOODS.get(found.name))
        actor = expert(self.policy, found, "labeler.policy").actor
        # It is asked once, for an answer says whether it remembers; and who cannot act is known before the run.
        _, memory = actor(found.environments(1).reset(np.random.default_rng(0)), None, None)
        return Expert(self, found, actor, remembers=memory is not None)


@dataclass(frozen=True)
class Expert:
    """A `Labeler` of segments."""

    settings: ExpertSettings
    task: ControlTask
    actor: Actor
    """What it does; no generator is given to it."""
    moods: Moods | None = None
    """In its own episodes, where these are not all alike."""
    remembers: bool = False
    """Whether what it does hangs on what it saw before."""
    demonstrates: bool = True
    corrects: bool = True

    @property
    def name(self) -> str:
        return self.settings.name

    @property
    def wavers(self) -> bool:
        return self.moods is not None or self.remembers

    def advice(self, observations: Floats) -> Floats:
        """(n, O) -> (n, A), where it remembers nothing."""
        return self.actor(observations, None, None)[0]

    def answer(self, store: Store[Segment], rng: np.random.Generator) -> None:
        """Show the episodes, once, then answer every open query with what the expert does in its states."""
        self.show(store, rng)
        queries = store.open_queries(self.name)
        shown = [self._corrected(query) for query in queries]
        store.keep(shown)
        store.answer([Demonstration(q.id, s.id, self.name) for q, s in zip(queries, shown, strict=True)])

    def show(self, store: Store[Segment], rng: np.random.Generator) -> None:
        """Show the episodes that are not there yet."""
        missing = self.settings.episodes - self._already(store)
        if missing <= 0:
            return
        played = play(self.task, self.actor, missing, rng, self.settings, self.moods)
        queries = [Query((one,)) for one in played]
        store.ask(queries)
        # In the same order, so that a round that was killed in between, and is done again, goes on from there.
        store.answer([Demonstration(q.id, q.candidates[0].id, self.name) for q in queries])

    def _already(self, store: Store[Segment]) -> int:
        """How many episodes of its own are there; a correction may be what the learner did."""
        shown = (one.like for one in store.demonstrations() if one.demonstration.labeler == self.name)
        return sum(one.episode.startswith(f"{self.name}/") for one in shown)

    def _corrected(self, query: Query[Segment]) -> Segment:
        """The same states, with the expert's actions. Nothing is known of what they would have led to."""
        if len(query.candidates) > 1:
            raise ValueError(
                f"query {query.id[:12]} compares {len(query.candidates)} segments, and an expert answers with actions "
                "in the states of one: set select.candidates=1, or let another labeler answer"
            )
        (own,) = query.candidates
        right = self._followed(own.observations) if self.remembers else self.advice(own.observations)
        return replace(own, actions=right.astype(np.float32), gold=None)

    def _followed(self, observations: Floats) -> Floats:
        """(T, O) of a segment -> (T, A), with what is remembered from its first step on."""
        memory: Memory = None
        actions = []
        for now in observations:
            action, memory = self.actor(now[None], None, memory)
            actions.append(action[0])
        return np.stack(actions)


def known(task: ControlTask) -> Advice:
    """The expert known for a task. Raises `ConfigError` where there is none."""
    if task.name not in EXPERTS:
        raise ConfigError(
            f"labeler.policy: no expert is known for {task.name}, only for {', '.join(EXPERTS)}: name a run of control "
            "or a zip of stable-baselines3"
        )
    size, advice = EXPERTS[task.name]
    if task.observation_size != size:
        raise ConfigError(
            f"labeler.policy: the known expert for {task.name} sees all {size} numbers of an observation, and here "
            f"there are {task.observation_size} (task.hide, task.stack): name a run of control or a zip that acts on "
            "these"
        )
    return advice


def play(
    task: ControlTask,
    actor: Actor,
    episodes: int,
    rng: np.random.Generator,
    settings: ExpertSettings,
    moods: Moods | None = None,
) -> Sequence[Segment]:
    """Whole episodes in which the expert acts, with noise, and which hold what it would have done without."""
    noise, mood = np.random.default_rng(rng.integers(2**63)), np.zeros(episodes)
    acting = played(actor, None)

    def act(observations: Floats, legal: Bools | None, begins: Bools) -> tuple[Floats, Floats]:
        if moods is not None:
            mood[begins] = noise.random(int(begins.sum()))
        clean = acting(observations, legal, begins)[0] if moods is None else moods(observations, mood)
        return clean, _disturbed(clean, task, settings.noise, noise, legal)

    rollout = whole_episodes(task, act, episodes, rng)
    return first_episodes(task, replace(rollout, actions=rollout.choices), [settings.name] * episodes)


def _disturbed(
    actions: Floats, task: ControlTask, width: float, rng: np.random.Generator, legal: Bools | None
) -> Floats:
    if not width:
        return actions
    if task.action_bounds is None:
        drawn = at_random(task, len(actions), legal, rng)
        return np.where(rng.random((len(actions), 1)) < width, drawn, actions)
    low, high = task.action_bounds
    bounded = np.isfinite(low) & np.isfinite(high)
    half = np.where(bounded, (np.where(bounded, high, 1) - np.where(bounded, low, -1)) / 2, 1)  # what has no bounds: 1
    noisy = actions + width * half * rng.standard_normal(actions.shape)
    found: Floats = np.clip(noisy, low, high).astype(np.float32)
    return found


def at_random(task: ControlTask, count: int, legal: Bools | None, rng: np.random.Generator) -> Floats:
    """(count, A) actions, each as probable as any other that there is: within the bounds, or one-hot."""
    if task.action_bounds is None:
        among = rng.integers(task.action_size, size=count) if legal is None else _one_of(legal, rng)
        chosen: Floats = np.eye(task.action_size, dtype=np.float32)[among]
        return chosen
    found: Floats = rng.uniform(*task.action_bounds, (count, task.action_size)).astype(np.float32)
    return found


def _one_of(legal: Bools, rng: np.random.Generator) -> Integers:
    """(n, A) -> (n,): one that there is, each as probable."""
    found: Integers = (rng.random(legal.shape) * legal).argmax(1)
    return found
