"""A small policy and its critic: two MLPs behind one observation normaliser, a Gaussian or a categorical head."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from prefrl.protocols import ControlTask
from prefrl.seeding import generator, to_numpy
from prefrl.types import Bools, Floats, State

CLIP = 10.0
"""Normalised observations are clipped to this many standard deviations."""
ILLEGAL = -1e9
"""The logit of an action that is not legal (Huang and Ontanon 2022, section 3): its probability is 0, and 0 times its
logarithm is 0 as well, where minus infinity would make NaN of it."""


@dataclass(frozen=True)
class ActionSpace:
    """How a policy's choices become actions: one-hot, or the bounds' box scaled to [-1, 1] and clipped."""

    size: int
    middle: Floats | None = None
    """(A,), None where actions are discrete."""
    half: Floats | None = None
    clip: Floats | None = None
    """(A,): 1 where there are bounds, infinity elsewhere."""

    @classmethod
    def of(cls, task: ControlTask) -> ActionSpace:
        if task.action_bounds is None:
            return cls(task.action_size)
        low, high = (np.asarray(b, np.float32) for b in task.action_bounds)
        bounded = np.isfinite(low) & np.isfinite(high)
        middle = np.where(bounded, (low + high) / 2, 0).astype(np.float32)
        # What has no bounds has no scale either: there the choice is the action.
        half = np.where(bounded, (high - low) / 2, 1).astype(np.float32)
        return cls(task.action_size, middle, half, np.where(bounded, 1.0, np.inf).astype(np.float32))

    @property
    def discrete(self) -> bool:
        return self.middle is None

    def execute(self, choices: Floats) -> Floats:
        """(..., A) -> (..., A): what the environment is given."""
        if self.middle is None or self.half is None or self.clip is None:
            return choices
        # The log-probability is that of the choice before the clip, which is part of the world like the simulator.
        return self.middle + self.half * np.clip(choices, -self.clip, self.clip)


@dataclass(frozen=True, eq=False)
class Decisions:
    """B decisions, each a sequence of one step to the update."""

    observations: Tensor
    """(B, O) normalised."""
    choices: Tensor
    """(B, A)."""
    legal: Tensor | None = None
    """(B, A) bool: which discrete actions there were; None where there were all."""

    @property
    def mask(self) -> Tensor:
        """(B, 1): all real."""
        return self.choices.new_ones(len(self.choices), 1, dtype=torch.bool)

    def rows(self, at: Tensor) -> Decisions:
        return Decisions(self.observations[at], self.choices[at], None if self.legal is None else self.legal[at])

    def order(self) -> Tensor:
        return torch.arange(len(self.choices), device=self.choices.device)


class MLPPolicy:
    """A `prefrl.protocols.Policy` of `Decisions`: an actor and a critic, each an MLP with tanh.

    For boxes the log standard deviation is a parameter of its own, the same in every state.

    Weights are orthogonal with gains sqrt(2), 0.01 for the actor's last layer and 1 for the critic's. Acting is
    NumPy on the same weights: for networks this small torch's overhead would be most of the time.
    """

    def __init__(self, task: ControlTask, hidden: tuple[int, ...], initial_std: float, rng: np.random.Generator):
        self.space = ActionSpace.of(task)
        size, order = task.observation_size, generator(rng)
        self.actor = _mlp((size, *hidden, task.action_size), 0.01, order)
        self.critic = _mlp((size, *hidden, 1), 1.0, order)
        self.log_std = torch.nn.Parameter(torch.full((task.action_size,), math.log(initial_std)))
        self.mean, self.variance, self.count = np.zeros(size), np.ones(size), 0.0

    @property
    def device(self) -> torch.device:
        return self.log_std.device

    def to(self, device: torch.device) -> None:
        """Move the weights to a device; acting and the normaliser stay NumPy."""
        for _, parameter in self._named():
            parameter.data = parameter.data.to(device)

    def parameters(self) -> list[torch.nn.Parameter]:
        return [*self.actor, *([] if self.space.discrete else [self.log_std]), *self.critic]

    def normalise(self, observations: Floats) -> Floats:
        """(..., O) -> (..., O) float32, by the statistics so far."""
        scaled = (observations - self._mean32) * self._scale32
        # A state far outside of what was seen would otherwise saturate the first layer.
        return np.clip(scaled, -CLIP, CLIP, out=scaled)

    @property
    def _mean32(self) -> Floats:
        return self.mean.astype(np.float32)

    @property
    def _scale32(self) -> Floats:
        return (1.0 / np.sqrt(self.variance + 1e-8)).astype(np.float32)  # eps: some inputs never change

    def observe(self, observations: Floats) -> None:
        """Add observations (..., O) to the normaliser's statistics (Chan et al. 1979).

        Never between acting and learning: the probability ratio would not start at 1.
        """
        # In float64: float32 sums lose small changes over many rounds.
        new = observations.reshape(-1, observations.shape[-1]).astype(np.float64)
        total = self.count + len(new)
        delta = new.mean(0) - self.mean
        squares = self.variance * self.count + new.var(0) * len(new) + delta**2 * self.count * len(new) / total
        self.mean = self.mean + delta * len(new) / total
        self.variance, self.count = squares / total, total

    def act(
        self, observations: Floats, rng: np.random.Generator | None, legal: Bools | None = None
    ) -> tuple[Floats, Floats]:
        """(n, O) -> choices (n, A) and actions to execute (n, A); the mode where `rng` is None.

        `legal` (n, A): which discrete actions there are; the others are not chosen.
        """
        outputs = self._actor_numpy(self.normalise(observations))
        if self.space.discrete:
            outputs = outputs if legal is None else np.where(legal, outputs, -np.inf)
            # The largest of logits plus Gumbel noise is a draw from their softmax.
            noise = 0.0 if rng is None else rng.gumbel(size=outputs.shape)
            choices = np.eye(self.space.size, dtype=np.float32)[(outputs + noise).argmax(1)]
            return choices, choices
        if rng is not None:
            std = np.exp(to_numpy(self.log_std))
            outputs = outputs + std * rng.standard_normal(outputs.shape, np.float32)
        return outputs, self.space.execute(outputs)

    def log_prob(self, inputs: Decisions) -> tuple[Tensor, Tensor]:
        """Log-probabilities (B, 1) and entropies (B, 1), in nats."""
        outputs = forward(self.actor, inputs.observations)
        if self.space.discrete:
            outputs = outputs if inputs.legal is None else outputs.masked_fill(~inputs.legal, ILLEGAL)
            logp = (outputs.log_softmax(-1) * inputs.choices).sum(-1, keepdim=True)  # one-hot: picks the chosen one
            return logp, categorical_entropy(outputs)[:, None]
        scaled = (inputs.choices - outputs) * (-self.log_std).exp()
        constant = self.log_std.sum() + 0.5 * self.space.size * math.log(2 * math.pi)
        entropy = constant + 0.5 * self.space.size
        # A Gaussian's entropy hangs on its std alone, which is the same in every state.
        return -0.5 * (scaled**2).sum(-1, keepdim=True) - constant, entropy.expand(len(outputs), 1)

    def values(self, inputs: Decisions) -> Tensor:
        """(B, 1)."""
        return forward(self.critic, inputs.observations)

    def log_prob_and_values(self, inputs: Decisions) -> tuple[Tensor, Tensor, Tensor]:
        return *self.log_prob(inputs), self.values(inputs)

    def values_of(self, observations: Tensor) -> Tensor:
        """Normalised observations (..., O) -> (...)."""
        return forward(self.critic, observations).squeeze(-1)

    def state(self) -> State:
        named = {name: p.detach().clone() for name, p in self._named()}
        return {"parameters": named, "mean": self.mean, "variance": self.variance, "count": self.count}

    def load(self, state: State) -> None:
        """Raises ValueError where shapes differ."""
        for name, parameter in self._named():
            if state["parameters"][name].shape != parameter.shape:
                found, expected = tuple(state["parameters"][name].shape), tuple(parameter.shape)
                raise ValueError(f"policy: {name} has shape {found}, expected {expected}: other settings or task")
            parameter.data.copy_(state["parameters"][name])  # in place: the optimiser holds these very tensors
        self.mean, self.variance, self.count = state["mean"], state["variance"], state["count"]

    def _named(self) -> list[tuple[str, torch.nn.Parameter]]:
        nets = [(f"actor_{i}", p) for i, p in enumerate(self.actor)]
        return nets + [(f"critic_{i}", p) for i, p in enumerate(self.critic)] + [("log_std", self.log_std)]

    def _actor_numpy(self, x: Floats) -> Floats:
        arrays = [to_numpy(p) for p in self.actor]  # views, which follow the optimiser's steps
        for i in range(0, len(arrays) - 2, 2):
            x = np.tanh(x @ arrays[i].T + arrays[i + 1])
        out: Floats = x @ arrays[-2].T + arrays[-1]
        return out


def categorical_entropy(logits: Tensor) -> Tensor:
    """(..., V) -> (...): entropy in nats."""
    logp = logits.log_softmax(-1)
    return -(logp.exp() * logp).sum(-1)


def forward(net: list[torch.nn.Parameter], x: Tensor) -> Tensor:
    """An MLP given as [weight, bias, weight, bias, ...], tanh between layers."""
    for i in range(0, len(net) - 2, 2):
        x = torch.tanh(torch.nn.functional.linear(x, net[i], net[i + 1]))
    return torch.nn.functional.linear(x, net[-2], net[-1])


def _mlp(sizes: tuple[int, ...], last_gain: float, order: torch.Generator) -> list[torch.nn.Parameter]:
    net = []
    for i, (fan_in, fan_out) in enumerate(pairwise(sizes)):
        # 0.01 for the actor: it starts with about the same distribution in every state.
        gain = last_gain if i == len(sizes) - 2 else math.sqrt(2)
        weight = torch.nn.init.orthogonal_(torch.empty(fan_out, fan_in), gain, order)
        net += [torch.nn.Parameter(weight), torch.nn.Parameter(torch.zeros(fan_out))]
    return net
