"""What a small network's outputs say of choices: drawn from, their log-probabilities, and the gradient by hand.

`density` is in torch, `Gaussian` and `Categorical` say the same in NumPy; tests hold one against the other.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from prefrl.components import ConfigError, Settings
from prefrl.protocols import ControlTask
from prefrl.types import Bools, Floats

ILLEGAL = -1e9
"""The logit of an action that is not legal (Huang and Ontanon 2022, section 3): its probability is 0, and 0 times its
logarithm is 0 as well, where minus infinity would make NaN of it."""

NEAR = 1 - 1e-6
"""As near to its bounds as an action may be of which it is asked what was drawn for it."""
LEAST = 1e-6
"""Variance beside that of features, which may all be zero."""
Slopes: TypeAlias = tuple[Floats, Floats | None]
"""The gradients of the outputs (B, A), and of the log standard deviations (A,) where there are any."""


class HeadSettings(Settings):
    """What every kind of policy says of its actions."""

    kind: str = ""
    initial_std: float = Field(1.0, gt=0)
    """Of the actions' noise at the start, in units of half the action bounds; with `sde` where all units of the last
    hidden layer are at 1."""
    squash: bool = False
    """Whether bounded actions are the tanh of what was drawn, and not what was drawn clipped at the bounds. Learning
    goes by the probability of what was drawn: tanh's own part is the same in both policies of a ratio. So does the
    entropy bonus, which then drives actions to their bounds."""
    sde: bool = False
    """Whether noise is a random function of the actor's last hidden layer (gSDE, Raffin et al. 2021), so that it is
    smooth in time, where it is drawn anew in each step otherwise."""
    sde_steps: int | None = Field(4, ge=1)
    """After how many steps that function is drawn anew; null for once a rollout."""


@dataclass(frozen=True)
class ActionSpace:
    """How a policy's choices become actions: one-hot, or the bounds' box scaled to [-1, 1], clipped or squashed."""

    size: int
    middle: Floats | None = None
    """(A,), None where actions are discrete."""
    half: Floats | None = None
    clip: Floats | None = None
    """(A,): 1 where there are bounds, infinity elsewhere."""
    squash: bool = False
    """Whether tanh, and not a clip, brings choices within the bounds."""

    @classmethod
    def of(cls, task: ControlTask, settings: HeadSettings | None = None) -> ActionSpace:
        """Raises `ConfigError` for settings of continuous actions where they are discrete."""
        settings = settings or HeadSettings()
        if task.action_bounds is None:
            for name in ("squash", "sde"):
                if getattr(settings, name):
                    raise ConfigError(
                        f"learner.policy.{name} is for continuous actions, and those of {task.name} are discrete: "
                        "leave it out"
                    )
        return cls.within(task.action_size, task.action_bounds, settings.squash)

    @classmethod
    def within(cls, size: int, bounds: tuple[Floats, Floats] | None, squash: bool = False) -> ActionSpace:
        """Of actions of that size within low (A,) and high (A,), or discrete ones where there are no bounds."""
        if bounds is None:
            return cls(size)
        low, high = (np.asarray(b, np.float32) for b in bounds)
        bounded = np.isfinite(low) & np.isfinite(high)
        # What has no bounds has no scale either: there the choice is the action.
        low, high = np.where(bounded, low, -1), np.where(bounded, high, 1)  # the sum of infinities is none
        middle, half = ((low + high) / 2).astype(np.float32), ((high - low) / 2).astype(np.float32)
        return cls(size, middle, half, np.where(bounded, 1.0, np.inf).astype(np.float32), squash)

    @property
    def discrete(self) -> bool:
        return self.middle is None

    def execute(self, choices: Floats) -> Floats:
        """(..., A) -> (..., A): what the environment is given."""
        if self.middle is None or self.half is None or self.clip is None:
            return choices
        # The log-probability is that of the choice before that, which is part of the world like the simulator.
        if self.squash:
            within = np.where(np.isfinite(self.clip), np.tanh(choices), choices)
        else:
            within = choices.clip(-self.clip, self.clip)
        found: Floats = self.middle + self.half * within
        return found

    def choices(self, actions: Floats) -> Floats:
        """(..., A) actions that were executed -> (..., A) float32 choices that lead to them."""
        if self.middle is None or self.half is None or self.clip is None:
            return actions
        found: Floats = ((actions - self.middle) / self.half).astype(np.float32)
        if self.squash:
            found = np.where(np.isfinite(self.clip), np.arctanh(np.clip(found, -NEAR, NEAR)), found).astype(np.float32)
        return found


class Noise:
    """What is added to a policy's means while it explores: for one rollout."""

    def __init__(self, log_std: Floats, steps: int | None = None) -> None:
        """`log_std` (A,): drawn anew in each step. (F, A): a function of F features, drawn anew after `steps`."""
        self._std, self._steps = np.exp(log_std), steps
        self._function: Floats | None = None
        self._age = 0

    def __call__(self, features: Floats, rng: np.random.Generator) -> Floats:
        """(n, F) -> (n, A)."""
        count = len(features)
        if self._std.ndim == 1:
            drawn: Floats = self._std * rng.standard_normal((count, len(self._std)), np.float32)
            return drawn
        if self._function is None or len(self._function) != count or self._age == self._steps:
            self._function, self._age = self._std * rng.standard_normal((count, *self._std.shape), np.float32), 0
        self._age += 1
        found: Floats = np.einsum("nf,nfa->na", features, self._function)
        return found


def choose(
    space: ActionSpace,
    outputs: Floats,
    features: Floats,
    noise: Noise | None,
    rng: np.random.Generator | None,
    legal: Bools | None,
) -> tuple[Floats, Floats]:
    """Outputs (n, A) of features (n, F) -> choices (n, A) and actions to execute (n, A); the mode where `rng` is None.

    `noise`: None where actions are discrete. `legal` (n, A): which of these there are; the others are not chosen.
    """
    if noise is None:
        outputs = outputs if legal is None else np.where(legal, outputs, -np.inf)
        # The largest of logits plus Gumbel noise is a draw from their softmax.
        gumbel = 0.0 if rng is None else rng.gumbel(size=outputs.shape)
        choices = np.eye(space.size, dtype=np.float32)[(outputs + gumbel).argmax(1)]
        return choices, choices
    if rng is not None:
        outputs += noise(features, rng)
    return outputs, space.execute(outputs)


def density(
    outputs: Tensor, choices: Tensor, log_std: Tensor | None, legal: Tensor | None, features: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Log-probabilities (..., 1) and entropies (..., 1), in nats, of choices (..., A).

    `log_std` (A,), or (F, A) of a function of `features` (..., F), None where actions are discrete; `legal` (..., A)
    which of these there were, None where all.
    """
    if log_std is None:
        outputs = outputs if legal is None else outputs.masked_fill(~legal, ILLEGAL)
        every = outputs.log_softmax(-1)
        logp = (every * choices).sum(-1, keepdim=True)  # one-hot: picks the chosen one
        return logp, -(every.exp() * every).sum(-1, keepdim=True)
    if features is not None and log_std.dim() == 2:
        # Of a sum over features. These are not to learn how noisy they make actions (Raffin et al. 2021, section 3).
        log_std = 0.5 * (features.detach() ** 2 @ (2 * log_std).exp() + LEAST).log()
    size = log_std.shape[-1]
    scaled = (choices - outputs) * (-log_std).exp()
    constant = log_std.sum(-1, keepdim=True) + 0.5 * size * math.log(2 * math.pi)
    entropy = constant + 0.5 * size
    # A Gaussian's entropy hangs on its std alone.
    return -0.5 * (scaled**2).sum(-1, keepdim=True) - constant, entropy.expand(*outputs.shape[:-1], 1)


def mode_density(log_std: Tensor | None) -> float:
    """The log-density of the mode, which is the same in every state; 0 of discrete actions (None), that have none."""
    if log_std is None:
        return 0.0
    assert log_std.dim() == 1  # not that of `sde`, which hangs on the state
    return -float(log_std.detach().sum()) - 0.5 * len(log_std) * math.log(2 * math.pi)


def starting_std(space: ActionSpace, settings: HeadSettings, features: int) -> dict[str, Tensor]:
    """The log standard deviations that a policy learns, in half the action bounds; none where actions are discrete.

    With `sde` they are those of a function of so many features, each of which is at most one where it is a tanh.
    """
    if space.discrete:
        return {}
    if not settings.sde:
        return {"log_std": torch.full((space.size,), math.log(settings.initial_std))}
    return {"log_std": torch.full((features, space.size), math.log(settings.initial_std) - 0.5 * math.log(features))}


@dataclass(frozen=True, eq=False)
class Gaussian:
    """B choices of a normal distribution whose log standard deviations are the same in every state."""

    outputs: Floats
    """(B, A) the means."""
    choices: Floats
    """(B, A)."""
    log_std: Floats
    """(A,)."""

    @cached_property
    def _precision(self) -> Floats:
        found: Floats = np.exp(-self.log_std)
        return found

    @cached_property
    def _scaled(self) -> Floats:
        return (self.choices - self.outputs) * self._precision

    def log_prob(self) -> tuple[Floats, Floats]:
        """Log-probabilities (B, 1) and entropies (B, 1), in nats."""
        size = self.outputs.shape[1]
        # A Python number, which leaves float32 what it is.
        constant = float(self.log_std.sum()) + 0.5 * size * math.log(2 * math.pi)
        logp = -0.5 * np.einsum("ba,ba->b", self._scaled, self._scaled)[:, None] - constant
        # A Gaussian's entropy hangs on its std alone.
        return logp, np.full_like(logp, constant + 0.5 * size)

    def slopes(self, of_logp: Floats, of_entropy: float) -> Slopes:
        """From a loss's gradients of the log-probabilities (B, 1) and of each entropy."""
        weighted = of_logp * self._scaled
        # d logp / d log_std is scaled^2 - 1, and d entropy / d log_std is 1.
        of_std = np.einsum("ba,ba->a", weighted, self._scaled) - of_logp.sum() + of_entropy * len(of_logp)
        return weighted * self._precision, of_std


@dataclass(frozen=True, eq=False)
class Categorical:
    """B choices, one-hot."""

    outputs: Floats
    """(B, A) logits."""
    choices: Floats
    """(B, A)."""
    legal: Bools | None
    """(B, A); None where all actions were."""

    @cached_property
    def _logp(self) -> Floats:
        logits = self.outputs if self.legal is None else np.where(self.legal, self.outputs, np.float32(ILLEGAL))
        # Off the largest, so that nothing overflows.
        apart = logits - logits.max(1, keepdims=True)
        found: Floats = apart - np.log(np.exp(apart).sum(1, keepdims=True))
        return found

    @cached_property
    def _p(self) -> Floats:
        found: Floats = np.exp(self._logp)
        return found

    @cached_property
    def _entropy(self) -> Floats:
        found: Floats = -np.einsum("ba,ba->b", self._p, self._logp)[:, None]
        return found

    def log_prob(self) -> tuple[Floats, Floats]:
        """Log-probabilities (B, 1) and entropies (B, 1), in nats."""
        return np.einsum("ba,ba->b", self._logp, self.choices)[:, None], self._entropy  # one-hot: picks the chosen one

    def slopes(self, of_logp: Floats, of_entropy: float) -> Slopes:
        """From a loss's gradients of the log-probabilities (B, 1) and of each entropy.

        What is not legal has the probability 0, and so no slope.
        """
        found = of_logp * (self.choices - self._p)
        if of_entropy:
            found -= of_entropy * self._p * (self._logp + self._entropy)  # d entropy / d logit is -p (log p + entropy)
        return found, None


__all__ = [
    "ILLEGAL",
    "ActionSpace",
    "Categorical",
    "Gaussian",
    "HeadSettings",
    "Noise",
    "Slopes",
    "choose",
    "density",
    "mode_density",
    "starting_std",
]
