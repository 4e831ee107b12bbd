"""Several processes on one computation: who is who, and what they share.

Every rank holds the same batch, the same parameters and the same generators; only what is dear is shared out, by rows
(a prompt to answer, a response to score or to learn from, an environment to step): each rank computes its own, and all
get the whole. So counts, baselines, minibatches and metrics are of the whole batch wherever they are computed, and no
result hangs on the number of ranks but by rounding. A process by itself is a world of one, where all of this does
nothing.
"""

from __future__ import annotations

import math
import os
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import TypeVar, cast

import numpy as np
import torch
import torch.distributed as dist
from torch import Tensor
from torch._C._distributed_c10d import Store

from prefrl.seeding import to_numpy

T = TypeVar("T")

PATIENCE = timedelta(days=365)
"""People may take days to answer; a rank that dies is noticed at once, by its closed connections."""
MEETING = timedelta(minutes=2)
"""How long ranks wait for each other at the start."""


class LostRanksError(ConnectionError):
    """Another rank has ended while this one went on."""


@dataclass(frozen=True)
class World:
    """The processes that compute together, and which of them this is."""

    rank: int = 0
    size: int = 1

    @property
    def mine(self) -> slice:
        """This rank's rows. Every size-th one: of rows in order of length each rank gets short and long ones."""
        return slice(self.rank, None, self.size)

    def whole(self, mine: Tensor, count: int) -> Tensor:
        """All `count` rows, from the rows (c, ...) that each rank computed of its own."""
        if self.size == 1:
            return mine
        most = -(-count // self.size)
        padded = mine.new_zeros(most, *mine.shape[1:])
        padded[: len(mine)] = mine
        found = [torch.empty_like(padded) for _ in range(self.size)]
        with _heard():
            dist.all_gather(found, padded)
        return torch.stack(found, 1).flatten(0, 1)[:count]  # (most, size, ...): row by row, and rank by rank in each

    def any(self, here: bool) -> bool:
        """Whether it is so on any rank."""
        if self.size == 1:
            return here
        found = torch.tensor(float(here))
        with _heard():
            dist.all_reduce(found, dist.ReduceOp.MAX)
        return bool(found)

    def gathered(self, mine: T) -> list[T]:
        """What each rank has, in their order."""
        if self.size == 1:
            return [mine]
        found: list[T | None] = [None] * self.size
        with _heard():
            dist.all_gather_object(found, mine)
        return cast("list[T]", found)

    def share(self, count: int) -> range:
        """This rank's of `count` things that each stay with one rank: neighbours, as many on each rank as can be."""
        return range(self.rank * count // self.size, (self.rank + 1) * count // self.size)

    def each(self, call: Callable[[], T]) -> list[T]:
        """What `call` returns on each rank, in their order; what it raises on any of them, all raise."""
        if self.size == 1:
            return [call()]
        with alone():  # others may do something else meanwhile
            mine = _outcome(call)
        found = self.gathered(mine)
        for one in found:
            if isinstance(one, Exception):
                raise one
        return cast("list[T]", found)

    def sum_gradients(self, parameters: Iterable[torch.nn.Parameter]) -> None:
        """Give every rank the sum of all ranks' gradients, to the same bits; a missing one counts as 0.

        Of parameters that are spread over ranks that was done while they were computed.
        """
        if self.size == 1:
            return
        from torch.distributed.tensor import DTensor  # takes half a second to load

        learning = [p for p in parameters if p.requires_grad]
        if isinstance(learning[0], DTensor):
            return
        # Behind them, whether there is one at all: what no rank has a gradient of is left alone by optimisers.
        some = learning[0].new_tensor([p.grad is not None for p in learning], dtype=torch.float32)
        gradients = [(torch.zeros_like(p) if p.grad is None else p.grad).flatten() for p in learning]
        flat = torch.cat([*gradients, some])
        with _heard():
            dist.all_reduce(flat)
        *totals, some = flat.split([*(p.numel() for p in learning), len(learning)])  # type: ignore[no-untyped-call]
        for parameter, total, known in zip(learning, totals, some.tolist(), strict=True):
            parameter.grad = total.view_as(parameter).to(parameter.dtype) if known else None

    def clip_gradients(self, parameters: Iterable[torch.nn.Parameter], longest: float) -> float:
        """Shorten the gradient where it is longer than that; returns how long it was."""
        if self.size == 1:
            return _shorten([p.grad for p in parameters if p.grad is not None], longest)
        from torch.distributed.tensor import DTensor

        norm = torch.nn.utils.clip_grad_norm_(parameters, longest)
        return float(norm.full_tensor() if isinstance(norm, DTensor) else norm)

    def first(self, call: Callable[[], T]) -> T:
        """What `call` returns on rank 0, on all ranks; what it raises there, all raise. The others do not call it."""
        if self.size == 1:
            return call()
        found: list[T | Exception | None] = [None]
        if self.rank == 0:
            with alone():  # nobody would answer
                found = [_outcome(call)]
        with _heard():
            dist.broadcast_object_list(found)
        if isinstance(found[0], Exception):
            raise found[0]
        return cast("T", found[0])


_joined = World()
"""All processes of this computation."""
_now = World()
"""Those that compute together at this moment."""


def world() -> World:
    """The processes that compute together now: this one alone, unless `together` says otherwise."""
    return _now


def joined() -> World:
    """All processes of this computation, whether or not they compute together now."""
    return _joined


@contextmanager
def together() -> Iterator[World]:
    """Meanwhile all ranks do the same, and share what is dear: every one of them has to come here."""
    with _among(_joined) as one:
        yield one


@contextmanager
def alone() -> Iterator[None]:
    """Meanwhile this rank does what the others do not."""
    with _among(World()):
        yield


def join(rank: int, size: int, meeting: str = "env://") -> None:
    """Meet the other ranks: at an address of torch's `init_method`. On GPUs each rank takes one of its machine's.

    All use as many threads as the one with the fewest: sums over other numbers of them round otherwise. Raises
    `LostRanksError` where somebody does not come.
    """
    global _joined
    if torch.cuda.is_available():
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", rank)) % torch.cuda.device_count())
    backend = "cpu:gloo,cuda:nccl" if torch.cuda.is_available() else "gloo"
    store, rank, size = next(dist.rendezvous(meeting, rank, size, timeout=MEETING))  # type: ignore[attr-defined]
    _wait_for_all(store, rank, size)
    dist.init_process_group(backend, store=store, rank=rank, world_size=size, timeout=PATIENCE)
    _joined = World(rank, size)
    torch.set_num_threads(min(_joined.gathered(torch.get_num_threads())))


def _wait_for_all(store: Store, rank: int, size: int) -> None:
    """In short steps, so that Ctrl-C is heard meanwhile."""
    store.set(f"prefrl {rank}", "here")
    everybody, begin = [f"prefrl {other}" for other in range(size)], time.monotonic()
    while not store.check(everybody):
        if time.monotonic() - begin > MEETING.total_seconds():
            raise LostRanksError(f"rank {rank} of {size} waited {MEETING.seconds} s for the others, and not all came")
        time.sleep(0.02)


def leave() -> None:
    """Part from the other ranks."""
    global _joined
    if _joined.size > 1:
        dist.destroy_process_group()
    _joined = World()


@contextmanager
def _among(those: World) -> Iterator[World]:
    global _now
    before, _now = _now, those
    try:
        yield those
    finally:
        _now = before


@contextmanager
def _heard() -> Iterator[None]:
    """What goes wrong here is that others do not answer."""
    try:
        yield
    except RuntimeError as error:
        raise _lost() from error


@contextmanager
def heard_by_torch() -> Iterator[None]:
    """Here torch speaks to the other ranks by itself: what goes wrong may be that they do not answer."""
    try:
        yield
    except RuntimeError as error:
        if isinstance(error, dist.DistBackendError) or "gloo" in str(error):
            raise _lost() from error
        raise


def _shorten(gradients: list[Tensor], most: float) -> float:
    """Scale gradients so that together they are no longer than `most`; returns how long they were.

    torch's clip_grad_norm_ does the same, and for a small network takes as long as a layer.
    """
    if len(gradients) == 1 and gradients[0].is_cpu:
        found = to_numpy(gradients[0])
        norm = math.sqrt(np.vdot(found, found))
        if norm > most:
            found *= most / (norm + 1e-6)
        return norm
    norm = float(torch.linalg.vector_norm(torch.stack(torch._foreach_norm(gradients))))
    if norm > most:
        torch._foreach_mul_(gradients, most / (norm + 1e-6))
    return norm


def _lost() -> LostRanksError:
    return LostRanksError(
        f"rank {_joined.rank} of {_joined.size} hears no more of another one, which has ended; what was finished is "
        "kept: start again, and the run goes on from there"
    )


def _outcome(call: Callable[[], T]) -> T | Exception:
    try:
        return call()
    except Exception as error:
        return error


def each_tensor(state: T, change: Callable[[Tensor], Tensor]) -> T:
    """The same dictionaries and lists, with their tensors changed."""
    found: object = state
    if isinstance(state, dict):
        found = {key: each_tensor(one, change) for key, one in state.items()}
    elif isinstance(state, list):
        found = [each_tensor(one, change) for one in state]
    elif isinstance(state, Tensor):
        found = change(state)
    return cast("T", found)
