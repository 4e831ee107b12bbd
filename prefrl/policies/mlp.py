"""A small policy and its critic: two MLPs behind one observation normaliser, a Gaussian or a categorical head."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from prefrl.policies.heads import ILLEGAL, Categorical, Gaussian
from prefrl.policies.perceptron import Layers, backward, forward
from prefrl.protocols import ControlTask, PassByHand
from prefrl.seeding import generator, to_numpy
from prefrl.types import Bools, Floats, State

STEADY = 2.0
"""By how much the scale of an input may change at once for the first layers to follow it."""
CLIP = 10.0
"""Normalised observations are clipped to this many standard deviations."""


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
        return cls.within(task.action_size, task.action_bounds)

    @classmethod
    def within(cls, size: int, bounds: tuple[Floats, Floats] | None) -> ActionSpace:
        """Of actions of that size within low (A,) and high (A,), or discrete ones where there are no bounds."""
        if bounds is None:
            return cls(size)
        low, high = (np.asarray(b, np.float32) for b in bounds)
        bounded = np.isfinite(low) & np.isfinite(high)
        # What has no bounds has no scale either: there the choice is the action.
        low, high = np.where(bounded, low, -1), np.where(bounded, high, 1)  # the sum of infinities is none
        middle, half = ((low + high) / 2).astype(np.float32), ((high - low) / 2).astype(np.float32)
        return cls(size, middle, half, np.where(bounded, 1.0, np.inf).astype(np.float32))

    @property
    def discrete(self) -> bool:
        return self.middle is None

    def execute(self, choices: Floats) -> Floats:
        """(..., A) -> (..., A): what the environment is given."""
        if self.middle is None or self.half is None or self.clip is None:
            return choices
        # The log-probability is that of the choice before the clip, which is part of the world like the simulator.
        return self.middle + self.half * np.clip(choices, -self.clip, self.clip)

    def choices(self, actions: Floats) -> Floats:
        """(..., A) actions that were executed -> (..., A) float32 choices that lead to them."""
        if self.middle is None or self.half is None:
            return actions
        found: Floats = ((actions - self.middle) / self.half).astype(np.float32)
        return found


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

    def columns(self) -> dict[str, npt.NDArray[Any]]:
        """The same in NumPy."""
        found = {"observations": to_numpy(self.observations), "choices": to_numpy(self.choices)}
        return found if self.legal is None else found | {"legal": to_numpy(self.legal)}


@dataclass(frozen=True, eq=False)
class NumpyActor:
    """Acts as a policy did when this was made."""

    space: ActionSpace
    layers: Layers
    std: Floats | None
    """(A,) of the noise; None where actions are discrete."""
    mean: Floats
    scale: Floats
    """(O,) of the normaliser: what is taken off, and what the rest is multiplied by."""
    clip: float = CLIP
    """Standard deviations."""

    def normalise(self, observations: Floats) -> Floats:
        """(..., O) -> (..., O) float32."""
        scaled = (observations - self.mean) * self.scale
        # A state far outside of what was seen would otherwise saturate the first layer.
        return np.minimum(
            np.maximum(scaled, -self.clip, out=scaled), self.clip, out=scaled
        )  # np.clip, in half its time

    def __call__(
        self, observations: Floats, rng: np.random.Generator | None, legal: Bools | None = None
    ) -> tuple[Floats, Floats]:
        """(n, O) -> choices (n, A) and actions to execute (n, A); the mode where `rng` is None.

        `legal` (n, A): which discrete actions there are; the others are not chosen.
        """
        outputs, _ = forward(self.normalise(observations), self.layers, "tanh")
        if self.std is None:
            outputs = outputs if legal is None else np.where(legal, outputs, -np.inf)
            # The largest of logits plus Gumbel noise is a draw from their softmax.
            noise = 0.0 if rng is None else rng.gumbel(size=outputs.shape)
            choices = np.eye(self.space.size, dtype=np.float32)[(outputs + noise).argmax(1)]
            return choices, choices
        if rng is not None:
            outputs += self.std * rng.standard_normal(outputs.shape, np.float32)
        return outputs, self.space.execute(outputs)


class Views(NamedTuple):
    """Weights, or their gradients, as NumPy's views into one tensor."""

    actor: Layers
    critic: Layers
    log_std: Floats | None
    """(A,)."""


class MLPPolicy:
    """A `prefrl.protocols.Policy` of `Decisions`: an actor and a critic, each an MLP with tanh.

    For boxes the log standard deviation is a parameter of its own, the same in every state.

    Weights are orthogonal with gains sqrt(2), 0.01 for the actor's last layer and 1 for the critic's. All of them lie
    in one tensor: an optimiser's step and a gradient's norm are then one call each. Acting is NumPy, and on the CPU so
    is the gradient (`by_hand`): for networks this small torch's overhead would be most of the time.
    """

    def __init__(
        self,
        task: ControlTask,
        hidden: tuple[int, ...],
        initial_std: float,
        rng: np.random.Generator,
        learns_std: bool = True,
    ):
        """`learns_std`: false where the standard deviation stays what it is at first."""
        self._learns_std = learns_std
        self.space = ActionSpace.of(task)
        size, order = task.observation_size, generator(rng)
        nets = {"actor": _mlp((size, *hidden, task.action_size), 0.01, order)}
        nets["critic"] = _mlp((size, *hidden, 1), 1.0, order)
        named = {f"{net}_{i}": p for net, parameters in nets.items() for i, p in enumerate(parameters)}
        if not self.space.discrete:
            named["log_std"] = torch.full((task.action_size,), math.log(initial_std))
        self._shapes = {name: p.shape for name, p in named.items()}
        self._flat = torch.nn.Parameter(torch.cat([p.flatten() for p in named.values()]))
        self.to(self.device)
        self.mean, self.variance, self.count = np.zeros(size), np.ones(size), 0.0
        self.raw = False
        """Whether observations are seen as they are, for good: by a policy that learned without a normaliser."""

    @property
    def device(self) -> torch.device:
        return self._flat.device

    def to(self, device: torch.device) -> None:
        """Move the weights to a device; acting and the normaliser stay NumPy."""
        self._flat.data = self._flat.data.to(device)
        self._gradient = torch.zeros_like(self._flat.data)
        # Views once and for all: the optimiser's steps change what they show.
        self._weights, self._slopes = self._views(self._flat.data), self._views(self._gradient)

    def parameters(self) -> list[torch.nn.Parameter]:
        return [self._flat]

    def normalise(self, observations: Floats) -> Floats:
        """(..., O) -> (..., O) float32, by the statistics so far."""
        return self.numpy_actor().normalise(observations)

    def observe(self, observations: Floats) -> None:
        """Add observations (..., O) to the normaliser's statistics (Chan et al. 1979).

        The first layers change with it, so that what the policy does stays the same (as Pop-Art does for outputs, van
        Hasselt et al. 2016): a mean that moved by a fifth of a standard deviation has ruined policies. The first time
        they do not, when weights are random and are to see inputs of one size. Never between acting and learning: the
        probability ratio would not start at 1.
        """
        if self.raw:
            return
        mean, scale = self.mean, self._scale
        # In float64: float32 sums lose small changes over many rounds.
        new = observations.reshape(-1, observations.shape[-1]).astype(np.float64)
        total = self.count + len(new)
        delta = new.mean(0) - self.mean
        squares = self.variance * self.count + new.var(0) * len(new) + delta**2 * self.count * len(new) / total
        self.mean = self.mean + delta * len(new) / total
        known, self.variance, self.count = self.count > 0, squares / total, total
        if known:
            self._keep(mean, scale)

    @property
    def _scale(self) -> Floats:
        found: Floats = 1.0 / np.sqrt(self.variance + 1e-8)  # eps: some inputs never change
        return found

    @torch.no_grad()
    def _keep(self, mean: Floats, scale: Floats) -> None:
        """Make the first layers do on inputs by the new statistics what they did by these (O,)."""
        ratio, shift = scale / self._scale, (self.mean - mean) * scale
        # An input that hardly changed before was blown up, and clipped: its weights are not to become as large.
        steady = (ratio > 1 / STEADY) & (ratio < STEADY)
        ratio, shift = (np.where(steady, x, plain) for x, plain in ((ratio, 1.0), (shift, 0.0)))
        parts = self._parts(self._flat.data)
        by, moved = (torch.from_numpy(x).to(self._flat) for x in (ratio, shift))
        for net in ("actor", "critic"):
            weight, bias = parts[f"{net}_0"], parts[f"{net}_1"]
            bias += moved @ weight
            weight *= by[:, None]

    def numpy_actor(self) -> NumpyActor:
        """What acts as the policy does now; it is not to be kept while the policy learns."""
        weights = self._views(self._flat)
        std = None if weights.log_std is None else np.exp(weights.log_std)
        mean, scale = self.mean.astype(np.float32), self._scale.astype(np.float32)
        return NumpyActor(self.space, weights.actor, std, mean, scale, np.inf if self.raw else CLIP)

    def log_prob(self, inputs: Decisions) -> tuple[Tensor, Tensor]:
        """Log-probabilities (B, 1) and entropies (B, 1), in nats."""
        outputs = self._outputs("actor", inputs.observations)
        if self.space.discrete:
            outputs = outputs if inputs.legal is None else outputs.masked_fill(~inputs.legal, ILLEGAL)
            every = outputs.log_softmax(-1)
            logp = (every * inputs.choices).sum(-1, keepdim=True)  # one-hot: picks the chosen one
            return logp, -(every.exp() * every).sum(-1, keepdim=True)
        log_std = self.named()["log_std"] if self._learns_std else self.named()["log_std"].detach()
        scaled = (inputs.choices - outputs) * (-log_std).exp()
        constant = log_std.sum() + 0.5 * self.space.size * math.log(2 * math.pi)
        entropy = constant + 0.5 * self.space.size
        # A Gaussian's entropy hangs on its std alone, which is the same in every state.
        return -0.5 * (scaled**2).sum(-1, keepdim=True) - constant, entropy.expand(len(outputs), 1)

    @property
    def peak(self) -> float:
        """The log-density of the mode, the same in every state; 0 where actions are discrete, which have none."""
        if self.space.discrete:
            return 0.0
        return -float(self.named()["log_std"].detach().sum()) - 0.5 * self.space.size * math.log(2 * math.pi)

    def values(self, inputs: Decisions) -> Tensor:
        """(B, 1)."""
        return self._outputs("critic", inputs.observations)

    def log_prob_and_values(self, inputs: Decisions) -> tuple[Tensor, Tensor, Tensor]:
        return *self.log_prob(inputs), self.values(inputs)

    def values_of(self, observations: Tensor) -> Tensor:
        """Normalised observations (..., O) -> (...)."""
        return self._outputs("critic", observations).squeeze(-1)

    @property
    def works_by_hand(self) -> bool:
        return self._flat.is_cpu

    def by_hand(self, inputs: Mapping[str, npt.NDArray[Any]], actor: bool, critic: bool) -> PassByHand:
        observations, traces = inputs["observations"], []
        weights, head, values = self._weights, None, None
        if actor:
            outputs, trace = forward(observations, weights.actor, "tanh")
            head = self._head(outputs, inputs)
            traces.append(trace)
        if critic:
            values, trace = forward(observations, weights.critic, "tanh")
            traces.append(trace)

        def pull_back(of_logp: Floats | None, of_entropy: float, of_values: Floats | None) -> None:
            self._flat.grad, slopes = self._gradient, self._slopes
            if not (actor and critic):
                self._gradient.zero_()
            if head is not None and of_logp is not None:
                of_outputs, of_std = head.slopes(of_logp, of_entropy)
                backward(of_outputs, weights.actor, traces[0], "tanh", slopes.actor)
                if slopes.log_std is not None:
                    slopes.log_std[:] = of_std if self._learns_std else 0.0
            if of_values is not None:
                backward(of_values, weights.critic, traces[-1], "tanh", slopes.critic)

        logp, entropies = head.log_prob() if head else (None, None)
        return PassByHand(logp, entropies, values, pull_back)

    def state(self) -> State:
        named = {name: p.detach().clone() for name, p in self.named().items()}
        found = {"parameters": named, "mean": self.mean, "variance": self.variance, "count": self.count}
        return found | {"raw": True} if self.raw else found

    @torch.no_grad()
    def load(self, state: State) -> None:
        """Raises ValueError where shapes differ."""
        for name, parameter in self.named().items():
            if state["parameters"][name].shape != parameter.shape:
                found, expected = tuple(state["parameters"][name].shape), tuple(parameter.shape)
                raise ValueError(f"policy: {name} has shape {found}, expected {expected}: other settings or task")
            parameter.copy_(state["parameters"][name])  # in place: the optimiser holds this very memory
        self.mean, self.variance, self.count = state["mean"], state["variance"], state["count"]
        self.raw = state.get("raw", False)

    def named(self) -> dict[str, Tensor]:
        """Every weight by its name, as torch lays layers out, (out, in) and (out,): views of what learns."""
        return {name: part.T if part.dim() == 2 else part for name, part in self._parts(self._flat).items()}

    def _parts(self, flat: Tensor) -> dict[str, Tensor]:
        """(in, out) and (out,) of each layer: for products of rows, weights lie in memory like that."""
        parts = flat.split([shape.numel() for shape in self._shapes.values()])  # type: ignore[no-untyped-call]
        return {name: part.view(shape) for (name, shape), part in zip(self._shapes.items(), parts, strict=True)}

    def _views(self, flat: Tensor) -> Views:
        arrays = {name: to_numpy(part) for name, part in self._parts(flat).items()}
        nets = [[arrays[name] for name in self._names(net)] for net in ("actor", "critic")]
        actor, critic = ([(w, b[None]) for w, b in zip(net[::2], net[1::2], strict=True)] for net in nets)
        return Views(actor, critic, arrays.get("log_std"))

    def _head(self, outputs: Floats, inputs: Mapping[str, Any]) -> Gaussian | Categorical:
        log_std = self._weights.log_std
        if log_std is None:
            return Categorical(outputs, inputs["choices"], inputs.get("legal"))
        return Gaussian(outputs, inputs["choices"], log_std)

    def _names(self, net: str) -> list[str]:
        return [name for name in self._shapes if name.startswith(net)]

    def _outputs(self, net: str, x: Tensor) -> Tensor:
        """(..., O) -> (..., out) of the actor or the critic."""
        parameters = self.named()
        *hidden, last_weight, last_bias = (parameters[name] for name in self._names(net))
        for weight, bias in zip(hidden[::2], hidden[1::2], strict=True):
            x = torch.tanh(torch.nn.functional.linear(x, weight, bias))
        return torch.nn.functional.linear(x, last_weight, last_bias)


def _mlp(sizes: tuple[int, ...], last_gain: float, order: torch.Generator) -> list[Tensor]:
    """Weight (in, out) and bias (out,) of each layer."""
    net = []
    for i, (fan_in, fan_out) in enumerate(pairwise(sizes)):
        # 0.01 for the actor: it starts with about the same distribution in every state.
        gain = last_gain if i == len(sizes) - 2 else math.sqrt(2)
        weight = torch.nn.init.orthogonal_(torch.empty(fan_out, fan_in), gain, order)
        net += [weight.T, torch.zeros(fan_out)]
    return net
