"""One run on several ranks: rank 0 has the folder, the store, the labeler and the selector; all the others follow.

Every rank goes through the same `Loop`. What belongs to rank 0 is asked there, and all are told what it answered; what
samples, fits, improves and evaluates shares its rows (`prefrl.distributed`). In control only environments are dear
(`prefrl.policies.divided`): rank 0 fits and learns, and the others take over what it has learned.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Generic, Literal, cast

import numpy as np
import torch

from prefrl.components import Settings
from prefrl.distributed import each_tensor, heard_by_torch, joined, together, world
from prefrl.fit.settings import FittingSettings
from prefrl.fit.trainer import fit
from prefrl.judgements import Answer, Demonstrated, Judged
from prefrl.loop import Loop
from prefrl.protocols import Attended, Divides, Labeler, Learner, RewardModel, Selector, Store, text
from prefrl.seeding import to_host, to_numpy
from prefrl.types import C, Fitted, Floats, Json, Query, Round


class RanksError(ValueError):
    """Ranks that should have the same parameters do not."""


@dataclass(frozen=True)
class SharedStore(Generic[C]):
    """A `Store` that rank 0 alone has."""

    own: Store[C]

    @property
    def sequence(self) -> int:
        return world().first(lambda: int(self.own.sequence))

    def judged(self, upto: int | None = None) -> list[Judged[C]]:
        return world().first(lambda: list(self.own.judged(upto)))

    def demonstrations(self, upto: int | None = None) -> list[Demonstrated[C]]:
        return world().first(lambda: list(self.own.demonstrations(upto)))

    def open_queries(self, labeler: str = "") -> list[Query[C]]:
        return world().first(lambda: list(self.own.open_queries(labeler)))

    def gold(self, candidates: Sequence[C]) -> list[Floats]:
        return world().first(lambda: list(self.own.gold(candidates)))

    def ask(self, queries: Sequence[Query[C]]) -> None:
        world().first(lambda: self.own.ask(queries))

    def keep(self, candidates: Sequence[C]) -> None:
        world().first(lambda: self.own.keep(candidates))

    def answer(self, answers: Sequence[Answer]) -> None:
        world().first(lambda: self.own.answer(answers))

    def retract(self, query: str, labeler: str) -> None:
        world().first(lambda: self.own.retract(query, labeler))

    def counts(self) -> dict[str, int]:
        return world().first(lambda: dict(self.own.counts()))

    def asked_before(self, ids: Sequence[str], sequence: int) -> set[str]:
        return world().first(lambda: set(self.own.asked_before(ids, sequence)))


@dataclass(frozen=True)
class SharedLabeler(Generic[C]):
    """A `Labeler` whom rank 0 alone asks, and for whom it alone has anything open."""

    own: Labeler[C]

    @property
    def name(self) -> str:
        return self.own.name

    def answer(self, store: Store[C], rng: np.random.Generator) -> None:
        assert isinstance(store, SharedStore)
        world().first(lambda: self.own.answer(store.own, rng))

    def open(self, store: Store[C], fixed: bool = False) -> list[str]:
        return self.own.open(store, fixed) if isinstance(self.own, Attended) else []

    def close(self) -> None:
        if isinstance(self.own, Attended):
            self.own.close()


class Elsewhere(Settings):
    """The labeler of other ranks than the first: nobody, so that a judge's model is not loaded by all of them."""

    kind: Literal["elsewhere"] = "elsewhere"

    def build(self, task: object) -> Labeler[C]:
        return cast("Labeler[C]", None)


@dataclass(frozen=True)
class SharedSelector(Generic[C]):
    """A `Selector` that rank 0 alone asks."""

    own: Selector[C]

    def select(self, pool: Sequence[C], reward: RewardModel[C], count: int, rng: np.random.Generator) -> list[Query[C]]:
        return world().first(lambda: self.own.select(pool, reward, count, rng))


def shared(loop: Loop[C]) -> Loop[C]:
    """The same loop, or where there are several ranks, one that they go through together.

    Other ranks than the first never look at their own store. Raises `ConfigError` where the work of a learner cannot be
    shared, or not by so many.
    """
    size = joined().size
    if size == 1:
        return loop
    loop = replace(
        loop,
        store=SharedStore(loop.store),
        labeler=SharedLabeler(loop.labeler),
        selector=SharedSelector(loop.selector),
    )
    if isinstance(loop.learner, Divides):
        loop.learner.check_ranks(size)
        return replace(loop, fit=fit_once)
    name = type(loop.learner).__name__
    text(loop.task, f"{size} ranks can share the learner {name} on text alone (of control, learner.kind=control)")
    return loop


def fit_once(
    reward: RewardModel[C],
    store: Store[C],
    fitting: FittingSettings,
    rng: np.random.Generator,
    unjudged: Sequence[C] = (),
) -> Fitted:
    """`prefrl.fit.trainer.fit` on rank 0, whose reward model the others take over.

    For small ones that takes less time than adding up gradients in every step, and the result has the same bits on any
    number of ranks. `rng` is not used again.
    """
    assert isinstance(store, SharedStore)
    own = store.own
    fitted, state = world().first(
        lambda: (fit(reward, own, fitting, rng, unjudged), each_tensor(reward.state(), to_host))
    )
    if world().rank:
        reward.load(state)
    return fitted


def lead(settings: Json, loop: Loop[C]) -> None:
    """Tell the ranks that `follow` what to run, and from where."""
    if joined().size == 1:
        return
    with together() as ranks:
        ranks.first(lambda: settings)
        _align(loop)


def follow(build: Callable[[Json], Loop[C]]) -> None:
    """Go through rank 0's run with it, to its end: a loop that is built, on any store, from what `lead` says."""
    with together() as ranks:
        settings: Json = ranks.first(dict)
    loop = shared(build(settings))
    with together():
        _align(loop)
    for _ in rounds(loop):
        pass


def rounds(loop: Loop[C]) -> Iterator[Round[C]]:
    """`loop.run()`, each round on all ranks together; alone again in between. Raises `RanksError` where they part."""
    found = loop.run()
    while True:
        with together() as ranks:
            with heard_by_torch():
                round = next(found, None)
            if round is None:
                return
            if len(set(ranks.gathered(_digest(loop.learner, loop.reward) if ranks.size > 1 else ""))) > 1:
                raise RanksError(
                    f"after round {round.number} the ranks have other parameters than each other: use one kind of "
                    "machine and one version of torch on all of them"
                )
        yield round


def _align(loop: Loop[C]) -> None:
    """Stand where rank 0 stands."""
    # Not from GPU to GPU: each rank would have a copy on that of rank 0.
    learner, reward = world().first(lambda: each_tensor([loop.learner.state(), loop.reward.state()], to_host))
    stands = world().first(lambda: (loop.round, loop.sequence, loop.fitted_on))
    if world().rank:
        loop.round, loop.sequence, loop.fitted_on = stands
        loop.learner.load(learner)
        loop.reward.load(reward)


def _digest(*parts: Learner[C] | RewardModel[C]) -> str:
    """Of everything that was learned."""
    found = hashlib.sha256()
    for part in parts:
        for array in _arrays(part.state()):
            found.update(array.tobytes())
    return found.hexdigest()


def _arrays(state: object) -> Iterator[np.ndarray]:
    """What is in a state, tensors as bytes."""
    if isinstance(state, dict):
        for key in state:
            yield from _arrays(state[key])
    elif isinstance(state, list | tuple):
        for value in state:
            yield from _arrays(value)
    elif isinstance(state, torch.Tensor):
        yield to_numpy(state.contiguous().flatten().view(torch.uint8))
    elif isinstance(state, np.ndarray):
        yield state
