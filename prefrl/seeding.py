"""One seed -> independent streams of random numbers, one for each stage of each round; and the device to compute on.

A stream is a function of (seed, round, stage) alone, so a resumed run draws what an unbroken one would have
drawn, and no generator's state has to be saved. All numbers are drawn on the CPU, then moved: a seed means the same
starting weights and the same draws on every device.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Literal, TypeAlias

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:  # torch is heavy, and who reads settings needs none
    import torch

Device: TypeAlias = Literal["auto", "cpu", "cuda"]
"""Where tensors are made; `auto` is the GPU where there is one."""


@dataclass(frozen=True)
class Streams:
    """The generators of one round."""

    build: np.random.Generator
    sample: np.random.Generator
    select: np.random.Generator
    label: np.random.Generator
    fit: np.random.Generator
    improve: np.random.Generator
    evaluate: np.random.Generator
    """The same in every round: policies are compared on the same starts and prompts."""


def streams(seed: int, round: int) -> Streams:
    """The streams of a round (0 is before the first)."""
    # By place: a new stage belongs at the end, or every stage after it would draw other numbers.
    keys = {f.name: (0 if f.name == "evaluate" else round, i) for i, f in enumerate(fields(Streams))}
    return Streams(
        **{name: np.random.default_rng(np.random.SeedSequence(seed, spawn_key=k)) for name, k in keys.items()}
    )


def keyed(base: int, key: str) -> np.random.Generator:
    """A generator for one named thing (a query, say): the same whatever was drawn before it."""
    # Not Python's hash(), which differs from one process to the next.
    return np.random.default_rng([base, int.from_bytes(hashlib.sha256(key.encode()).digest()[:8], "big")])


def draw_seed(rng: np.random.Generator) -> int:
    """A seed for a library that keeps its own generator (torch, gymnasium)."""
    return int(rng.integers(2**31 - 1))


def generator(rng: np.random.Generator) -> torch.Generator:
    """A generator of torch's for drawing on the CPU, seeded from `rng`."""
    import torch

    return torch.Generator("cpu").manual_seed(draw_seed(rng))


def device_of(name: Device) -> torch.device:
    """The device that a setting names. Raises `ValueError` for a GPU that torch cannot find."""
    import torch

    found = torch.cuda.is_available()
    if name == "cuda" and not found:
        raise ValueError(
            "learner.device=cuda, but torch finds no GPU: set it to auto or cpu, or install a torch with CUDA"
        )
    return torch.device(("cuda" if found else "cpu") if name == "auto" else name)


@contextmanager
def threads(count: int | None) -> Iterator[None]:
    """Let torch and BLAS compute with so many threads meanwhile; None leaves them as they are.

    Between the products of small networks several threads only wait for one another, and they wait by spinning.
    """
    if count is None:
        yield
        return
    import torch
    from threadpoolctl import threadpool_limits

    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        with threadpool_limits(count):
            yield
    finally:
        torch.set_num_threads(before)


def keep_freed_memory() -> None:
    """Let glibc's malloc keep what is freed, up to 64 MB, for the arrays that come next.

    Else it gives a gradient step's arrays back to the system, and the next step's come again a page at a time. Its
    thresholds rise to the largest block so far, of at most 32 MB, that was freed (mallopt(3), M_MMAP_THRESHOLD).
    """
    np.empty(31 << 20, np.uint8)  # freed at once, and never written to: it takes no memory


def to_host(value: torch.Tensor) -> torch.Tensor:
    """In the memory of the CPU."""
    return value.cpu()


def to_numpy(tensor: torch.Tensor) -> npt.NDArray[Any]:
    """A tensor of any device as an array; of one on the CPU it is a view."""
    found: npt.NDArray[Any] = tensor.detach().cpu().numpy()
    return found
