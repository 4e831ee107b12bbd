"""A small policy and its critic: two MLPs behind one observation normaliser, a Gaussian or a categorical head."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any, Literal, NamedTuple

import numpy as np
import numpy.typing as npt
import torch
from pydantic import Field
from torch import Tensor

from prefrl.policies.acting import Decide, Decisions, Memory, Reading, copy_into
from prefrl.policies.heads import (
    ActionSpace,
    Categorical,
    Gaussian,
    HeadSettings,
    Noise,
    choose,
    density,
    mode_density,
    starting_std,
)
from prefrl.policies.normaliser import Normaliser, Scaling
from prefrl.policies.perceptron import Activation, Layers, activated, backward, forward
from prefrl.policies.rollout import Rollout
from prefrl.protocols import ControlTask, Mapped, PassByHand
from prefrl.seeding import generator, to_numpy
from prefrl.types import Bools, Floats, Segment, State


class MLPPolicySettings(HeadSettings):
    """Two perceptrons, an actor and a critic: for observations that say all there is to know."""

    kind: Literal["mlp"] = "mlp"
    hidden: tuple[Annotated[int, Field(ge=1)], ...] = (64, 64)
    """Widths of the hidden layers of the actor, and of the critic unless it has its own."""
    critic_hidden: tuple[Annotated[int, Field(ge=1)], ...] | None = None
    """Widths of the critic's hidden layers; null for those of the actor."""
    activation: Activation = "tanh"
    """What follows each hidden layer."""

    def build(self, task: ControlTask, rng: np.random.Generator) -> MLPPolicy:
        return MLPPolicy(self, task, rng)


@dataclass(frozen=True, eq=False)
class NumpyActor:
    """Acts as a policy did when this was made."""

    space: ActionSpace
    layers: Layers
    activation: Activation
    noise: Noise | None
    """None where actions are discrete."""
    scaling: Scaling
    legal: Callable[[Floats], Bools] | None = None
    """(n, O) -> (n, A): which actions there are, where observations say so and nobody else does."""

    def __call__(
        self, observations: Floats, rng: np.random.Generator | None, legal: Bools | None = None
    ) -> tuple[Floats, Floats]:
        """(n, O) -> choices (n, A) and actions to execute (n, A), as `choose` does."""
        outputs, trace = forward(self.scaling(observations), self.layers, self.activation)
        if legal is None and self.legal is not None:
            legal = self.legal(observations)
        return choose(self.space, outputs, trace.inputs[-1], self.noise, rng, legal)


class Views(NamedTuple):
    """Weights, or their gradients, as NumPy's views into one tensor."""

    actor: Layers
    critic: Layers
    log_std: Floats | None
    """(A,), or (F, A) of F features."""


class MLPPolicy:
    """A `prefrl.protocols.Policy` of `Decisions`: an actor and a critic, each an MLP.

    For boxes the log standard deviation is a parameter of its own, the same in every state, or one for each feature.

    Weights are orthogonal with gains sqrt(2), 0.01 for the actor's last layer and 1 for the critic's. All of them lie
    in one tensor: an optimiser's step and a gradient's norm are then one call each. Acting is NumPy, and on the CPU so
    is the gradient (`by_hand`): for networks this small torch's overhead would be most of the time.
    """

    chunk, exact = 1, True

    def __init__(
        self, settings: MLPPolicySettings, task: ControlTask, rng: np.random.Generator, learns_std: bool = True
    ) -> None:
        """`learns_std`: false where the standard deviation stays what it is at first."""
        self._learns_std = learns_std
        self._legal = task.legal if isinstance(task, Mapped) else None
        self.settings, self.space = settings, ActionSpace.of(task, settings)
        size, order = task.observation_size, generator(rng)
        of_critic = settings.hidden if settings.critic_hidden is None else settings.critic_hidden
        self.widths = {"actor": settings.hidden, "critic": of_critic}
        nets = {"actor": _mlp((size, *self.widths["actor"], task.action_size), 0.01, order)}
        nets["critic"] = _mlp((size, *self.widths["critic"], 1), 1.0, order)
        named = {f"{net}_{i}": p for net, parameters in nets.items() for i, p in enumerate(parameters)}
        named |= starting_std(self.space, settings, (size, *settings.hidden)[-1])
        self._shapes = {name: p.shape for name, p in named.items()}
        self._flat = torch.nn.Parameter(torch.cat([p.flatten() for p in named.values()]))
        self.to(self.device)
        self.normaliser = Normaliser(size)

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
        return self.normaliser.now()(observations)

    def freeze(self) -> None:
        """See observations from now on as they are seen now."""
        self.normaliser.frozen = True

    def with_std_kept(self) -> MLPPolicy:
        """A view of the same weights that does not learn the standard deviation."""
        view = copy(self)
        view._learns_std = False
        return view

    def observe(self, observations: Floats) -> None:
        """Add observations (..., O) to the normaliser's statistics, and let the first layers follow."""
        move = self.normaliser.observe(observations)
        if move is not None:
            parts = self._parts(self._flat.data)
            for net in ("actor", "critic"):
                move.fold(parts[f"{net}_0"], parts[f"{net}_1"])

    def numpy_actor(self) -> NumpyActor:
        """What acts as the policy does now; it is not to be kept while the policy learns."""
        weights = self._views(self._flat)
        noise = None if weights.log_std is None else Noise(weights.log_std, self.settings.sde_steps)
        parts = self.space, weights.actor, self.settings.activation, noise, self.normaliser.now()
        return NumpyActor(*parts, self._legal)

    def decide(self) -> Decide:
        actor = self.numpy_actor()

        def decide(
            observations: Floats, rng: np.random.Generator | None, legal: Bools | None, memory: Memory, /
        ) -> tuple[Floats, Floats, Memory]:
            return *actor(observations, rng, legal), memory

        return decide

    @torch.no_grad()
    def read(self, rollout: Rollout, memory: Memory, asked: Bools) -> Reading[Decisions]:
        normalise = self.normaliser.now()
        observations = torch.from_numpy(normalise(rollout.observations)).to(self.device)
        final = torch.from_numpy(normalise(rollout.final_observations[asked])).to(self.device)
        values = self.values_of(observations), self.values_of(final)
        return Reading(Decisions.of(rollout, observations), *values)

    def log_prob(self, inputs: Decisions) -> tuple[Tensor, Tensor]:
        """Log-probabilities (B, 1) and entropies (B, 1), in nats."""
        features, outputs = self._outputs("actor", inputs.observations)
        log_std = self.named().get("log_std")
        if log_std is not None and not self._learns_std:
            log_std = log_std.detach()
        return density(outputs, inputs.choices, log_std, inputs.legal, features)

    @property
    def peak(self) -> float:
        """The log-density of the mode, the same in every state without `sde`; 0 of discrete actions, that have none."""
        return mode_density(self.named().get("log_std"))

    @property
    def ceiling(self) -> float:
        return 0.0 if self._learns_std else self.peak

    def examples(self, segments: Sequence[Segment]) -> Decisions:
        seen = np.concatenate([one.observations for one in segments])
        choices = self.space.choices(np.concatenate([one.actions for one in segments]))
        arrays = [self.normalise(seen), choices, *([] if self._legal is None else [self._legal(seen)])]
        return Decisions(*(torch.from_numpy(x).to(self.device) for x in arrays))

    def redrawn(self, examples: Decisions, rng: np.random.Generator) -> Decisions:
        """Nothing was drawn for them."""
        return examples

    def traced(self, observations: Tensor, noise: Tensor | None = None) -> Tensor:
        """(..., O) raw observations -> (..., A) continuous actions to execute, with gradients to weights and
        observations; the mode, or what standard normal `noise` (..., A) makes of it. How noisy it is takes none."""
        space = self.space
        assert space.middle is not None
        assert space.half is not None
        assert space.clip is not None
        middle, half, clip = (torch.from_numpy(x).to(self.device) for x in (space.middle, space.half, space.clip))
        drawn = self._outputs("actor", self._normalised(observations))[1]
        if noise is not None:
            drawn = drawn + self.named()["log_std"].detach().exp() * noise
        within = torch.where(clip.isfinite(), drawn.tanh(), drawn) if space.squash else drawn.clamp(-clip, clip)
        return middle + half * within

    def worth(self, observations: Tensor, learns: bool = False) -> Tensor:
        """(..., O) raw observations -> (...) what the critic expects; `learns`: with gradients to its weights."""
        named = self.named() if learns else {name: one.detach() for name, one in self.named().items()}
        return self._outputs("critic", self._normalised(observations), named)[1].squeeze(-1)

    def values(self, inputs: Decisions) -> Tensor:
        """(B, 1)."""
        return self._outputs("critic", inputs.observations)[1]

    def log_prob_and_values(self, inputs: Decisions) -> tuple[Tensor, Tensor, Tensor]:
        return *self.log_prob(inputs), self.values(inputs)

    def values_of(self, observations: Tensor) -> Tensor:
        """Normalised observations (..., O) -> (...)."""
        return self._outputs("critic", observations)[1].squeeze(-1)

    @property
    def works_by_hand(self) -> bool:
        return self._flat.is_cpu and not self.settings.sde

    def by_hand(self, inputs: Mapping[str, npt.NDArray[Any]], actor: bool, critic: bool) -> PassByHand:
        observations, traces = inputs["observations"], []
        weights, head, values = self._weights, None, None
        if actor:
            outputs, trace = forward(observations, weights.actor, self.settings.activation)
            head = self._head(outputs, inputs)
            traces.append(trace)
        if critic:
            values, trace = forward(observations, weights.critic, self.settings.activation)
            traces.append(trace)

        def pull_back(of_logp: Floats | None, of_entropy: float, of_values: Floats | None) -> None:
            self._flat.grad, slopes = self._gradient, self._slopes
            if not (actor and critic):
                self._gradient.zero_()
            if head is not None and of_logp is not None:
                of_outputs, of_std = head.slopes(of_logp, of_entropy)
                backward(of_outputs, weights.actor, traces[0], self.settings.activation, slopes.actor)
                if slopes.log_std is not None:
                    slopes.log_std[:] = of_std if self._learns_std else 0.0
            if of_values is not None:
                backward(of_values, weights.critic, traces[-1], self.settings.activation, slopes.critic)

        logp, entropies = head.log_prob() if head else (None, None)
        return PassByHand(logp, entropies, values, pull_back)

    def state(self) -> State:
        return {"parameters": {name: p.detach().clone() for name, p in self.named().items()}} | self.normaliser.state()

    def load(self, state: State) -> None:
        """Raises ValueError where shapes differ."""
        copy_into(self.named(), state["parameters"])
        self.normaliser.load(state)

    def named(self) -> dict[str, Tensor]:
        """Every weight by its name, as torch lays layers out, (out, in) and (out,): views of what learns."""
        parts = self._parts(self._flat).items()
        return {name: part.T if part.dim() == 2 and name != "log_std" else part for name, part in parts}

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

    def _normalised(self, observations: Tensor) -> Tensor:
        """As `normalise`, with gradients."""
        now = self.normaliser.now()
        mean, scale = (torch.from_numpy(x).to(self.device) for x in (now.mean, now.scale))
        return ((observations - mean) * scale).clamp(-now.clip, now.clip)

    def _outputs(self, net: str, x: Tensor, named: dict[str, Tensor] | None = None) -> tuple[Tensor, Tensor]:
        """(..., O) -> the last hidden layer (..., F) of the actor or the critic, and what it says (..., out)."""
        parameters = self.named() if named is None else named
        *hidden, last_weight, last_bias = (parameters[name] for name in self._names(net))
        for weight, bias in zip(hidden[::2], hidden[1::2], strict=True):
            x = activated(torch.nn.functional.linear(x, weight, bias), self.settings.activation)
        return x, torch.nn.functional.linear(x, last_weight, last_bias)


def _mlp(sizes: tuple[int, ...], last_gain: float, order: torch.Generator) -> list[Tensor]:
    """Weight (in, out) and bias (out,) of each layer."""
    net = []
    for i, (fan_in, fan_out) in enumerate(pairwise(sizes)):
        # 0.01 for the actor: it starts with about the same distribution in every state.
        gain = last_gain if i == len(sizes) - 2 else math.sqrt(2)
        weight = torch.nn.init.orthogonal_(torch.empty(fan_out, fan_in), gain, order)
        net += [weight.T, torch.zeros(fan_out)]
    return net
