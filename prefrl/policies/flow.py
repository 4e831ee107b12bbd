"""A policy that flows from noise to a plan of several actions: for behaviour that goes one way or another.

Variant: conditional flow matching along straight paths (Lipman et al. 2023, section 4.1, with sigma_min = 0), plans of
a few actions of which the first ones are executed (Chi et al. 2023), and FPO's ratio (McAllister et al. 2025): minus
the mean of the flow-matching loss over stored (noise, time) stands in for the log-probability. What differs:
perceptrons in place of U-nets, one observation and no history of them, times drawn by strata, and of a plan only the
actions that were executed count. Left out: a ratio for each draw, and other integrators than Euler's.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated, Literal, Self

import numpy as np
import torch
from pydantic import ConfigDict, Field, model_validator
from torch import Tensor

from prefrl.components import ConfigError, Settings
from prefrl.policies.acting import Decide, Memory, Reading, copy_into
from prefrl.policies.heads import ActionSpace
from prefrl.policies.normaliser import Normaliser
from prefrl.policies.perceptron import Activation, Layers, activated, forward
from prefrl.policies.remembering import orthogonal
from prefrl.policies.rollout import Rollout
from prefrl.protocols import ControlTask
from prefrl.seeding import generator, to_numpy
from prefrl.types import Bools, Floats, Segment, State

NEITHER: dict[str, float | None] = {"entropy": 0.0, "target_kl": None}
"""What a flow gives neither: settings of a learner that may not be others there, and need not be named."""
WAVES = math.pi * np.arange(1, 5, dtype=np.float32)
"""Of the cosines by which the network is told the time, from 0 (noise) to 1 (a plan)."""
SEEDS = 2**24
"""Whole numbers up to here are exact in float32, the type of all that a rollout keeps."""


class FlowPolicySettings(Settings):
    """A flow from noise to a plan of actions, and a critic: where there are several good ways, whose mean is none."""

    model_config = ConfigDict(json_schema_extra={"required": ["kind"]})  # without one, settings are of an mlp
    kind: Literal["flow"] = "flow"
    hidden: tuple[Annotated[int, Field(ge=1)], ...] = (64, 64)
    """Widths of the hidden layers of the velocity field."""
    critic_hidden: tuple[Annotated[int, Field(ge=1)], ...] = (64, 64)
    """Widths of the critic's hidden layers."""
    activation: Activation = "silu"
    """What follows each hidden layer."""
    chunk: int = Field(4, ge=1)
    """Actions of a plan."""
    execute: int = Field(4, ge=1)
    """How many of them are executed before it plans again; at most `chunk`."""
    steps: int = Field(8, ge=1)
    """Euler's steps from noise to a plan."""
    draws: int = Field(8, ge=1)
    """Noise and times of each plan on which the flow-matching loss is measured."""

    @model_validator(mode="after")
    def _planned(self) -> Self:
        if self.execute > self.chunk:
            raise ValueError(f"execute must be at most chunk, got {self.execute} of {self.chunk} planned actions")
        return self

    def check(self, entropy: float, target_kl: float | None, shortest: int) -> None:
        """Raise `ValueError` where a learner wants what a flow has not, or its rollouts are shorter than a plan."""
        for name, came, only in (("entropy", entropy, "0"), ("target_kl", target_kl, "null")):
            if came != NEITHER[name]:
                raise ValueError(
                    f".{name}: expected {only} with policy.kind=flow, got {came}: a flow has no density that is known, "
                    "and so neither an entropy nor a KL: set it so"
                )
        if shortest < self.execute:
            raise ValueError(
                f".rollout_steps: a rollout has {shortest} steps, and a plan of {self.execute} does not end in it: "
                "raise it, or steps_per_round"
            )

    def build(self, task: ControlTask, rng: np.random.Generator) -> FlowPolicy:
        """Raises `ConfigError` where actions are discrete."""
        return FlowPolicy(self, task, rng)


@dataclass(frozen=True, eq=False)
class Plans:
    """B plans of C actions, each a sequence of one step to the update."""

    observations: Tensor
    """(B, O) normalised."""
    plans: Tensor
    """(B, C, A)."""
    counted: Tensor
    """(B, C) bool: which of its actions were executed."""
    noise: Tensor
    """(B, N, C, A): on which the loss is measured."""
    times: Tensor
    """(B, N) in [0, 1]: how far on the way from noise to plan."""

    @property
    def mask(self) -> Tensor:
        """(B, 1): all real."""
        return self.plans.new_ones(len(self.plans), 1, dtype=torch.bool)

    def rows(self, at: Tensor) -> Plans:
        found = (self.observations[at], self.plans[at], self.counted[at], self.noise[at], self.times[at])
        return Plans(*found)

    def order(self) -> Tensor:
        return torch.arange(len(self.plans), device=self.plans.device)


class FlowPolicy:
    """A `prefrl.policies.acting.ControlPolicy` of `Plans`.

    A plan is what has to be remembered: (n, 2 + C A) of n episodes are how many actions of it are left, the number that
    its draws come from, and the plan. The same are a rollout's choices. Acting is NumPy, learning automatic
    differentiation.
    """

    chunk, exact, ceiling = 1, False, 0.0

    def __init__(self, settings: FlowPolicySettings, task: ControlTask, rng: np.random.Generator) -> None:
        self.settings, self.space = settings, ActionSpace.of(task)
        if self.space.discrete:
            raise ConfigError(
                f"learner.policy.kind=flow is for continuous actions, and those of {task.name} are discrete: choose mlp"
            )
        size, plan, order = task.observation_size, settings.chunk * task.action_size, generator(rng)
        widths = {"velocity": (size + plan + len(WAVES), *settings.hidden, plan)}
        widths["critic"] = size, *settings.critic_hidden, 1
        self._p = torch.nn.ParameterDict([pair for net in widths.items() for pair in _weights(*net, order)])
        self.normaliser = Normaliser(size)

    @property
    def device(self) -> torch.device:
        return next(iter(self.parameters())).device

    def to(self, device: torch.device) -> None:
        self._p.to(device)

    def parameters(self) -> Iterable[torch.nn.Parameter]:
        return self._p.values()

    def freeze(self) -> None:
        """See observations from now on as they are seen now."""
        self.normaliser.frozen = True

    def observe(self, observations: Floats) -> None:
        move = self.normaliser.observe(observations)
        if move is not None:
            for net in ("velocity", "critic"):
                # Observations are the first inputs of both.
                move.fold(self._p[f"{net}_0"].data[: len(move.ratio)], self._p[f"{net}_1"].data)

    def decide(self) -> Decide:
        """Plans from fresh noise; in place of a mode, from noise that the observation's own bytes are the seed of.

        No noise at all would lead between the ways that there are (measured: docs/flow.md). This is as certain: one
        observation leads to one plan, and many of them go all ways, as they do where they are drawn.
        """
        normalise, layers = self.normaliser.now(), self._layers()
        size, execute = self._plan_size, self.settings.execute

        def decide(
            observations: Floats, rng: np.random.Generator | None, legal: Bools | None, memory: Memory, /
        ) -> tuple[Floats, Floats, Memory]:
            count = len(observations)
            known = np.zeros((count, 2 + size), np.float32) if memory is None else memory.copy()
            if (over := known[:, 0] == 0).any():
                seen = observations[over]
                noise = _own(seen, size) if rng is None else _normal(rng, len(seen), size)
                known[over, 0] = execute
                known[over, 1] = 0 if rng is None else rng.integers(SEEDS, size=len(seen))
                known[over, 2:] = self._flow(normalise(seen), noise, layers)
            at = (execute - known[:, 0]).astype(int)
            choices = known[:, 2:].reshape(count, -1, self.space.size)[np.arange(count), at]
            following = known.copy()
            following[:, 0] -= 1
            return known, self.space.execute(choices), following

        return decide

    @torch.no_grad()
    def read(self, rollout: Rollout, memory: Memory, asked: Bools) -> Reading[Plans]:
        """Its plans are those that were made in this rollout; of one that was made before nothing is learned."""
        left, execute = rollout.choices[..., 0], self.settings.execute
        decides = left == execute  # (n, T)
        observations = torch.from_numpy(self.normaliser.now()(rollout.observations)).to(self.device)
        final = torch.from_numpy(self.normaliser.now()(rollout.final_observations[asked])).to(self.device)
        chosen = rollout.choices[decides]
        seeds = chosen[:, 1].astype(np.int64)
        seen = observations[torch.from_numpy(decides).to(self.device)]
        counted = _executed(left, execute, self.settings.chunk)[decides]
        # Again the same draws whenever this rollout is read.
        drawn = self._drawn(self._plans(seen, chosen[:, 2:], counted), np.random.default_rng(seeds.tolist()))
        return Reading(drawn, self._valued(observations), self._valued(final), decides)

    def examples(self, segments: Sequence[Segment]) -> Plans:
        """What was done from each step of some segments on, as plans; of those that a segment's end cuts short, only
        what was done counts. Nothing is drawn yet."""
        starts = [np.arange(len(one))[:, None] + np.arange(self.settings.chunk) for one in segments]  # (T, C) each
        observations = np.concatenate([one.observations for one in segments])
        # What is missing is the last action again: the network is given it, though nothing is asked about it.
        plans = np.concatenate(
            [one.actions[at.clip(max=len(one) - 1)] for one, at in zip(segments, starts, strict=True)]
        )
        counted = np.concatenate([at < len(one) for one, at in zip(segments, starts, strict=True)])
        seen = torch.from_numpy(self.normaliser.now()(observations)).to(self.device)
        return self._plans(seen, self.space.choices(plans), counted)

    def redrawn(self, examples: Plans, rng: np.random.Generator) -> Plans:
        """With other noise and times."""
        return self._drawn(examples, rng)

    def log_prob(self, inputs: Plans) -> tuple[Tensor, None]:
        """(B, 1) minus the flow-matching loss: a sum over a plan's numbers, a mean over draws. No entropy is known."""
        times = inputs.times[..., None, None]
        plans = inputs.plans[:, None]  # (B, 1, C, A)
        noisy = (1 - times) * inputs.noise + times * plans
        seen = inputs.observations[:, None].expand(-1, inputs.times.shape[1], -1)
        found = self._net("velocity", torch.cat([seen, noisy.flatten(2), _waves(inputs.times)], 2))
        # On a straight path the velocity is the same all along.
        squares = (found.view_as(noisy) - (plans - inputs.noise)) ** 2
        return -(squares.sum(-1) * inputs.counted[:, None]).sum(-1).mean(1, keepdim=True), None

    def values(self, inputs: Plans) -> Tensor:
        """(B, 1)."""
        return self._net("critic", inputs.observations)

    def log_prob_and_values(self, inputs: Plans) -> tuple[Tensor, None, Tensor]:
        return *self.log_prob(inputs), self.values(inputs)

    def state(self) -> State:
        return {"parameters": {name: p.detach().clone() for name, p in self._p.items()}} | self.normaliser.state()

    def load(self, state: State) -> None:
        copy_into(self.named(), state["parameters"])
        self.normaliser.load(state)

    def named(self) -> dict[str, Tensor]:
        """Every weight by its name."""
        return dict(self._p.items())

    @property
    def _plan_size(self) -> int:
        return self.settings.chunk * self.space.size

    def _flow(self, seen: Floats, noise: Floats, layers: Layers) -> Floats:
        """Normalised observations (n, O) and noise (n, C A) -> plans (n, C A)."""
        plans, steps = noise, self.settings.steps
        for step in range(steps):
            times = np.cos(np.broadcast_to(WAVES * np.float32(step / steps), (len(seen), len(WAVES))))
            velocity, _ = forward(np.concatenate([seen, plans, times], 1), layers, self.settings.activation)
            plans = plans + velocity / np.float32(steps)
        return plans

    def _plans(self, seen: Tensor, plans: Floats, counted: Bools) -> Plans:
        """Without draws."""
        shaped = (
            torch.from_numpy(plans.astype(np.float32)).to(self.device).view(-1, self.settings.chunk, self.space.size)
        )
        none = shaped.new_zeros(len(shaped), 0)
        return Plans(seen, shaped, torch.from_numpy(counted).to(self.device), none[..., None, None], none)

    def _drawn(self, plans: Plans, rng: np.random.Generator) -> Plans:
        count, draws = len(plans.plans), self.settings.draws
        noise = _normal(rng, count, draws, *plans.plans.shape[1:])
        times = (np.arange(draws) + rng.random((count, draws))) / draws
        arrays = (torch.from_numpy(x.astype(np.float32)).to(self.device) for x in (noise, times))
        return replace(plans, **dict(zip(("noise", "times"), arrays, strict=True)))

    def _valued(self, observations: Tensor) -> Tensor:
        """Normalised (..., O) -> (...)."""
        return self._net("critic", observations).squeeze(-1)

    def _net(self, net: str, x: Tensor) -> Tensor:
        """(..., in) -> (..., out)."""
        *hidden, (last_weight, last_bias) = _pairs(self._p, net)
        for weight, bias in hidden:
            x = activated(x @ weight + bias, self.settings.activation)
        return x @ last_weight + last_bias

    def _layers(self) -> Layers:
        return [(to_numpy(weight), to_numpy(bias)[None]) for weight, bias in _pairs(self._p, "velocity")]


def _weights(net: str, widths: Sequence[int], order: torch.Generator) -> list[tuple[str, Tensor]]:
    """Weights (in, out) and biases (out,): orthogonal, gains of sqrt(2), 0.01 for the last velocities and 1 for the
    critic's."""
    found: list[Tensor] = []
    for number, (given, out) in enumerate(pairwise(widths)):
        last = number == len(widths) - 2
        gain = (0.01 if net == "velocity" else 1.0) if last else math.sqrt(2)
        found += [orthogonal(order, given, out, gain=gain), torch.zeros(out)]
    return [(f"{net}_{i}", x) for i, x in enumerate(found)]


def _pairs(p: torch.nn.ParameterDict, net: str) -> list[tuple[Tensor, Tensor]]:
    own = [x for name, x in p.items() if name.startswith(net)]
    return list(zip(own[::2], own[1::2], strict=True))


def _executed(left: Floats, execute: int, chunk: int) -> Bools:
    """(n, T) how many actions were left -> (n, T, C): which of a plan that began there were executed in these T steps.

    A plan ends where its episode does: then another one begins, and counts from its own start. Beyond the last step
    stands that step again, of which as many are left as of it, and not fewer.
    """
    steps = left.shape[1]
    ahead = np.arange(steps)[:, None] + np.arange(chunk)  # (T, C)
    found: Bools = left[:, ahead.clip(max=steps - 1)] == execute - np.arange(chunk)
    return found


def _waves(times: Tensor) -> Tensor:
    """(...) -> (..., W)."""
    return (times[..., None] * torch.from_numpy(WAVES).to(times.device)).cos()


def _own(observations: Floats, size: int) -> Floats:
    """(n, O) float32 -> noise (n, size) that hangs on each row alone."""
    return np.stack([_normal(np.random.default_rng(row.view(np.uint32)), size) for row in observations])


def _normal(rng: np.random.Generator, *shape: int) -> Floats:
    return rng.standard_normal(shape, np.float32)


__all__ = ["FlowPolicy", "FlowPolicySettings", "Plans"]
