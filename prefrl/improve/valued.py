"""What a rollout teaches: advantages by GAE and the critic's targets, of the learned reward."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
import torch
from torch import Tensor

from prefrl.improve.gradient import Batch, Beside
from prefrl.improve.objectives import gae, masked_whiten
from prefrl.policies.acting import ControlPolicy, Reading, in_chunks
from prefrl.policies.rollout import Rollout
from prefrl.types import Bools, Floats

Read: TypeAlias = Callable[[Bools], Reading[Any]]
"""A rollout as the policy reads it now; (n, T) of which steps it is to value what they led to."""


@dataclass(frozen=True, eq=False)
class Turn:
    """One rollout of a round, and how it is learned from."""

    rollout: Rollout
    read: Read
    left: float
    """What is left of the learning rate."""
    new: bool
    """Whether the critic has not seen this reward, and learns it first."""
    settled: bool
    """Whether the policy stays as it is, and the critic alone learns."""
    beside: Callable[[np.random.Generator], Beside[Any] | None]
    """What is learned beside the objective."""


@torch.no_grad()
def valued(
    policy: ControlPolicy[Any], rollout: Rollout, read: Read, rewards: Floats, discount: float, trace: float
) -> tuple[Batch[Any], float]:
    """What the update needs, in chunks of the policy's length, and how much of the returns the critic explains."""
    unseen = rollout.ends.copy()
    unseen[:, -1] = True  # what follows a row's last step is in the next rollout
    reading = read(unseen)
    values = reading.values  # (n, T)
    following = _next_values(rollout, values, reading.final, unseen)
    ends = _as(values, rollout.ends)
    scaled = _as(values, rewards).float() * _scale(discount)
    advantages = gae(scaled, values, following, ends, discount, _trace(trace, reading.decides, values))
    returns = advantages + values
    if reading.decides is not None:  # (n, T) -> (B, 1): each decision is a sequence of its own
        at = _as(values, reading.decides)
        advantages, returns = advantages[at][:, None], returns[at][:, None]
    # The clamp: returns that do not vary leave nothing to explain.
    explained = 1.0 - float(advantages.var() / returns.var().clamp(min=1e-12))
    # Whitened only now: the critic's targets above are in the units of the reward.
    white = masked_whiten(advantages, torch.ones_like(advantages))
    # From the network that is trained, not NumPy's actor, whose last bits differ: the ratio starts at exactly 1.
    logp, _ = policy.log_prob(reading.inputs)
    return Batch(reading.inputs, logp, in_chunks(white, policy.chunk), in_chunks(returns, policy.chunk)), explained


def _trace(trace: float, decides: Bools | None, there: Tensor) -> float | Tensor:
    """GAE's lambda, (n, T) where some steps only carry out what was decided before.

    Into such steps it is 1, and what they are worth cancels: between two decisions only rewards are summed.
    """
    if decides is None:
        return trace
    following = np.concatenate([decides[:, 1:], decides[:, :1]], 1)  # a row's last step leads out of it
    return _as(there, np.where(following, trace, 1.0).astype(np.float32))


def _next_values(rollout: Rollout, values: Tensor, final: Tensor, unseen: Bools) -> Tensor:
    """(n, T): the value of what each step led to; `final` (k,) are those that were `unseen` (n, T)."""
    # After an end the next column belongs to another episode, so the final observation is valued by itself. The
    # column that fills up the end of each row is among those replaced.
    following = torch.cat([values[:, 1:], values[:, :1]], 1)
    following[_as(values, unseen)] = final
    return following * ~_as(values, rollout.terminated)  # a time limit still has a future


def _as(there: Tensor, array: np.ndarray) -> Tensor:
    """An array, on the device of another one."""
    return torch.from_numpy(array).to(there.device)


def _scale(discount: float) -> float:
    """Returns of white noise of std 1 have a std of 1 / sqrt(1 - discount^2): this undoes it."""
    return math.sqrt(1.0 - discount**2) or 1.0  # undiscounted returns have no such limit: left as they are
