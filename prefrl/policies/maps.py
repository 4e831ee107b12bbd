"""A policy for many actions of which something is known beforehand, such as the cells of a map.

The actor's network says what each of the F numbers that a task tells of an action counts for now, and adds a logit of
its own for each action: logit_a = gain w(o) . m_a + g_a(o). The weights are shared by all actions, so what is learned
of one cell holds for its neighbours; g learns what the maps do not tell.

Variant: MaskPlace (Lai et al. 2022) reads its wire and position masks by convolutions, and adds a global view; here
they enter the logits as they are, weighed by the state. Where a task tells nothing, `mlp` is what this would be.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Literal

import numpy as np
import torch
from pydantic import ConfigDict, Field
from torch import Tensor

from prefrl.components import ConfigError
from prefrl.policies.acting import Decide, Decisions, Memory, Reading, copy_into
from prefrl.policies.heads import ActionSpace, HeadSettings, choose, density
from prefrl.policies.normaliser import Normaliser
from prefrl.policies.perceptron import Activation, Layers, activated, forward
from prefrl.policies.rollout import Rollout
from prefrl.protocols import ControlTask, Mapped
from prefrl.seeding import generator, to_numpy
from prefrl.types import Bools, Floats, State


class MapsPolicySettings(HeadSettings):
    """A perceptron that weighs what a task tells of each action: for many actions, such as the cells of a floorplan."""

    model_config = ConfigDict(json_schema_extra={"required": ["kind"]})  # without one, settings are of an mlp
    kind: Literal["maps"] = "maps"
    hidden: tuple[Annotated[int, Field(ge=1)], ...] = (64,)
    """Widths of the hidden layers of the actor, and of the critic."""
    activation: Activation = "tanh"
    """What follows each hidden layer."""
    gain: float = Field(5.0, gt=0)
    """What the weights of the maps are multiplied by: how fast they are learned beside the rest."""

    def build(self, task: ControlTask, rng: np.random.Generator) -> MapsPolicy:
        """Raises `ConfigError` where the task tells nothing of its actions."""
        if not isinstance(task, Mapped):
            raise ConfigError(
                f"learner.policy.kind=maps is for tasks that tell what each action does, such as task.kind=floorplan, "
                f"and {task.name} does not: choose mlp"
            )
        return MapsPolicy(self, task, rng)


@dataclass(frozen=True, eq=False)
class MappedDecisions:
    """B decisions, as `Decisions`, with what was told of each action."""

    seen: Decisions
    maps: Tensor
    """(B, A, F)."""

    @property
    def mask(self) -> Tensor:
        return self.seen.mask

    def rows(self, at: Tensor) -> MappedDecisions:
        return MappedDecisions(self.seen.rows(at), self.maps[at])

    def order(self) -> Tensor:
        return self.seen.order()


class MapsPolicy:
    """A `prefrl.policies.acting.ControlPolicy` of `MappedDecisions`. Acting is NumPy, learning torch.

    Weights are orthogonal with gains sqrt(2), 0 for the actor's last layer, so that at first every legal action is as
    probable, and 1 for the critic's.
    """

    chunk, exact = 1, True

    def __init__(self, settings: MapsPolicySettings, task: Mapped, rng: np.random.Generator) -> None:
        self.settings, self.space, self._task = settings, ActionSpace.of(task, settings), task
        self._told = len(task.maps)
        sizes, order = (task.observation_size, *settings.hidden), generator(rng)
        named: dict[str, Tensor] = {}
        for net, out in (("actor", self._told + task.action_size), ("critic", 1)):
            layers = [*pairwise((*sizes, out))]
            for i, (fan_in, fan_out) in enumerate(layers):
                gain = 2**0.5 if i < len(layers) - 1 else float(net == "critic")
                named[f"{net}_{i}"] = torch.nn.init.orthogonal_(torch.empty(fan_in, fan_out), gain, order)
                named[f"{net}_bias_{i}"] = torch.zeros(1, fan_out)
        self._p = torch.nn.ParameterDict(named.items())  # pairs: of a mapping it would not keep the order
        # Much of an observation does not change before something else has.
        self.normaliser = Normaliser(task.observation_size, calm=True)

    @property
    def device(self) -> torch.device:
        return next(iter(self.parameters())).device

    def to(self, device: torch.device) -> None:
        self._p.to(device)

    def parameters(self) -> Iterable[torch.nn.Parameter]:
        return self._p.values()

    def observe(self, observations: Floats) -> None:
        move = self.normaliser.observe(observations)
        if move is not None:
            for net in ("actor", "critic"):
                move.fold(self._p[f"{net}_0"].data, self._p[f"{net}_bias_0"].data[0])

    def decide(self) -> Decide:
        layers = [(to_numpy(weight), to_numpy(bias)) for weight, bias in self._layers("actor")]
        scaling = self.normaliser.now()

        def decide(
            observations: Floats, rng: np.random.Generator | None, legal: Bools | None, memory: Memory, /
        ) -> tuple[Floats, Floats, Memory]:
            logits = self._act(scaling(observations), self._task.told(observations), layers)
            return *choose(self.space, logits, observations, None, rng, legal), memory

        return decide

    @torch.no_grad()
    def read(self, rollout: Rollout, memory: Memory, asked: Bools) -> Reading[MappedDecisions]:
        normalise = self.normaliser.now()
        observations = torch.from_numpy(normalise(rollout.observations)).to(self.device)
        final = torch.from_numpy(normalise(rollout.final_observations[asked])).to(self.device)
        flat = rollout.observations.reshape(-1, rollout.observations.shape[-1])
        maps = torch.from_numpy(self._task.told(flat)).to(self.device)
        decisions = MappedDecisions(Decisions.of(rollout, observations), maps)
        return Reading(decisions, self._value(observations), self._value(final))

    def log_prob(self, inputs: MappedDecisions) -> tuple[Tensor, Tensor]:
        return density(self._logits(inputs), inputs.seen.choices, None, inputs.seen.legal)

    def values(self, inputs: MappedDecisions) -> Tensor:
        """(B, 1)."""
        return self._value(inputs.seen.observations)[:, None]

    def log_prob_and_values(self, inputs: MappedDecisions) -> tuple[Tensor, Tensor, Tensor]:
        return *self.log_prob(inputs), self.values(inputs)

    def state(self) -> State:
        return {"parameters": {name: p.detach().clone() for name, p in self._p.items()}} | self.normaliser.state()

    def load(self, state: State) -> None:
        copy_into(self.named(), state["parameters"])
        self.normaliser.load(state)

    def named(self) -> dict[str, Tensor]:
        """Every weight by its name."""
        return dict(self._p.items())

    def _act(self, observations: Floats, maps: Floats, layers: Layers) -> Floats:
        outputs, _ = forward(observations, layers, self.settings.activation)
        weights = self.settings.gain * outputs[:, : self._told]
        found: Floats = outputs[:, self._told :] + (maps @ weights[:, :, None])[..., 0]
        return found

    def _logits(self, inputs: MappedDecisions) -> Tensor:
        """(B, A)."""
        outputs = self._through("actor", inputs.seen.observations)
        weights, own = outputs.split([self._told, self.space.size], -1)  # type: ignore[no-untyped-call]
        found: Tensor = own + (inputs.maps @ (self.settings.gain * weights)[:, :, None]).squeeze(-1)
        return found

    def _value(self, observations: Tensor) -> Tensor:
        return self._through("critic", observations).squeeze(-1)

    def _through(self, net: str, x: Tensor) -> Tensor:
        *hidden, (last_weight, last_bias) = self._layers(net)
        for weight, bias in hidden:
            x = activated(x @ weight + bias, self.settings.activation)
        return x @ last_weight + last_bias

    def _layers(self, net: str) -> list[tuple[Tensor, Tensor]]:
        count = len(self.settings.hidden) + 1
        return [(self._p[f"{net}_{i}"], self._p[f"{net}_bias_{i}"]) for i in range(count)]


__all__ = ["MappedDecisions", "MapsPolicy", "MapsPolicySettings"]
