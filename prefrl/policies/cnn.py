"""A policy for pictures: convolutions that its actor and its critic share.

Variant: the network of Mnih et al. 2015 as stable-baselines3's NatureCNN has it, pixels divided by 255 and nothing else
normalised; frames are stacked by the environment (`task.stack`), if at all. Where the critic learns alone, after a new
reward, the shared part stands still: the policy would move with it.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Annotated, Literal, TypeAlias

import numpy as np
import torch
from pydantic import ConfigDict, Field
from torch import Tensor
from torch.nn.functional import conv2d, linear

from prefrl.components import ConfigError
from prefrl.policies.acting import Decide, Decisions, Memory, Reading, copy_into
from prefrl.policies.heads import ActionSpace, HeadSettings, Noise, choose, density, starting_std
from prefrl.policies.rollout import Rollout
from prefrl.protocols import ControlTask
from prefrl.seeding import generator, to_numpy
from prefrl.types import Bools, Floats, State

AT_ONCE = 512
"""Pictures that go through the network together where nothing is learned from them."""
Count: TypeAlias = Annotated[int, Field(ge=1)]


class CNNPolicySettings(HeadSettings):
    """A convolutional network, with an actor and a critic on it: for pictures."""

    model_config = ConfigDict(json_schema_extra={"required": ["image", "kind"]})
    kind: Literal["cnn"] = "cnn"
    image: tuple[Count, Count, Count]
    """Height, width and channels of the pictures that observations are, channels last; several in a row are stacked
    frames."""
    filters: tuple[tuple[Count, Count, Count], ...] = Field(((32, 8, 4), (64, 4, 2), (64, 3, 1)), min_length=1)
    """Of each convolution: how many, their height and width, and at every which pixel. The default needs pictures of
    36 x 36 or more; [[16, 3, 2], [32, 3, 2]] is for 7 x 7 or more."""
    width: int = Field(512, ge=1)
    """Units of the layer behind the convolutions."""
    brightest: float = Field(255.0, gt=0)
    """Pictures are divided by this."""

    def build(self, task: ControlTask, rng: np.random.Generator) -> CNNPolicy:
        """Raises `ConfigError` where the task's observations cannot be such pictures."""
        return CNNPolicy(self, task, rng)

    def seen(self) -> tuple[int, int]:
        """Height and width of what the convolutions leave. Raises `ConfigError` where they leave nothing."""
        sizes = list(self.image[:2])
        for _, side, stride in self.filters:
            sizes = [(size - side) // stride + 1 if size >= side else 0 for size in sizes]
        if min(sizes) < 1:
            raise ConfigError(
                f"learner.policy.filters: pictures of {self.image[0]} x {self.image[1]} are too small for "
                f"{[list(one) for one in self.filters]}; [[16, 3, 2], [32, 3, 2]] needs 7 x 7, the default 36 x 36"
            )
        return sizes[0], sizes[1]


class CNNPolicy:
    """A `prefrl.policies.acting.ControlPolicy` of `Decisions`, whose observations are rows of pixels."""

    chunk, exact = 1, True

    def __init__(self, settings: CNNPolicySettings, task: ControlTask, rng: np.random.Generator) -> None:
        self.settings, self.space = settings, ActionSpace.of(task, settings)
        self._frames, rest = divmod(task.observation_size, math.prod(settings.image))
        if rest or not self._frames:
            raise ConfigError(
                f"learner.policy.image: pictures of {' x '.join(map(str, settings.image))} (height, width, channels) "
                f"have {math.prod(settings.image)} numbers, but the observations of {task.name} have "
                f"{task.observation_size}, which is no multiple; give the shape of the environment's own pictures"
            )
        named = _weights(settings, self._frames, task.action_size, generator(rng))
        named |= starting_std(self.space, settings, settings.width)
        self._p = torch.nn.ParameterDict(named.items())  # pairs: of a mapping it would not keep the order

    @property
    def device(self) -> torch.device:
        return next(iter(self.parameters())).device

    def to(self, device: torch.device) -> None:
        self._p.to(device)

    def parameters(self) -> Iterable[torch.nn.Parameter]:
        return self._p.values()

    def observe(self, observations: Floats) -> None:
        """Pictures are not normalised."""

    def decide(self) -> Decide:
        noise = Noise(to_numpy(self._p["log_std"]), self.settings.sde_steps) if "log_std" in self._p else None

        def decide(
            observations: Floats, rng: np.random.Generator | None, legal: Bools | None, memory: Memory, /
        ) -> tuple[Floats, Floats, Memory]:
            with torch.no_grad():
                features = self._features(torch.from_numpy(observations).to(self.device))
                outputs = to_numpy(self._actor(features))
            return *choose(self.space, outputs, to_numpy(features), noise, rng, legal), memory

        return decide

    @torch.no_grad()
    def read(self, rollout: Rollout, memory: Memory, asked: Bools) -> Reading[Decisions]:
        decisions = Decisions.of(rollout, torch.from_numpy(rollout.observations).to(self.device))
        final = torch.from_numpy(rollout.final_observations[asked]).to(self.device)
        values, later = self._valued(decisions.observations), self._valued(final)
        return Reading(decisions, values.view(rollout.ends.shape), later)

    def log_prob(self, inputs: Decisions) -> tuple[Tensor, Tensor]:
        return self._density(self._features(inputs.observations), inputs)

    def values(self, inputs: Decisions) -> Tensor:
        """(B, 1), with a gradient for the critic's own layer alone."""
        return self._critic(self._features(inputs.observations).detach())

    def log_prob_and_values(self, inputs: Decisions) -> tuple[Tensor, Tensor, Tensor]:
        features = self._features(inputs.observations)
        return *self._density(features, inputs), self._critic(features)

    def state(self) -> State:
        return {"parameters": {name: p.detach().clone() for name, p in self._p.items()}}

    def load(self, state: State) -> None:
        copy_into(self.named(), state["parameters"])

    def named(self) -> dict[str, Tensor]:
        """Every weight by its name."""
        return dict(self._p.items())

    def _features(self, pixels: Tensor) -> Tensor:
        """(B, frames x height x width x channels) -> (B, width)."""
        height, width, channels = self.settings.image
        pictures = pixels.view(len(pixels), self._frames, height, width, channels) / self.settings.brightest
        # Frames are channels too, as convolutions have it: (B, frames, channels, height, width).
        x = pictures.permute(0, 1, 4, 2, 3).flatten(1, 2)
        for i, (_, _, stride) in enumerate(self.settings.filters):
            x = torch.relu_(conv2d(x, self._p[f"filter_{i}"], self._p[f"filter_bias_{i}"], stride=stride))
        return torch.relu(linear(x.flatten(1), self._p["width_weight"], self._p["width_bias"]))

    def _actor(self, features: Tensor) -> Tensor:
        return linear(features, self._p["actor_weight"], self._p["actor_bias"])

    def _critic(self, features: Tensor) -> Tensor:
        return linear(features, self._p["critic_weight"], self._p["critic_bias"])

    def _valued(self, pixels: Tensor) -> Tensor:
        """(B,) values of B pictures, a few of them at a time."""
        parts = pixels.tensor_split(-(-len(pixels) // AT_ONCE))
        return torch.cat([self._critic(self._features(some)) for some in parts]).squeeze(-1)

    def _density(self, features: Tensor, inputs: Decisions) -> tuple[Tensor, Tensor]:
        return density(self._actor(features), inputs.choices, self._p.get("log_std"), inputs.legal, features)


def _weights(settings: CNNPolicySettings, frames: int, actions: int, order: torch.Generator) -> dict[str, Tensor]:
    """Orthogonal, gains of sqrt(2), 0.01 for the actor and 1 for the critic."""
    named: dict[str, Tensor] = {}

    def layer(name: str, bias: str, shape: tuple[int, ...], gain: float) -> None:
        named[name] = torch.nn.init.orthogonal_(torch.empty(shape), gain, order)
        named[bias] = torch.zeros(shape[0])

    channels = frames * settings.image[2]
    for i, (count, side, _) in enumerate(settings.filters):
        layer(f"filter_{i}", f"filter_bias_{i}", (count, channels, side, side), 2**0.5)
        channels = count
    layer("width_weight", "width_bias", (settings.width, channels * math.prod(settings.seen())), 2**0.5)
    layer("actor_weight", "actor_bias", (actions, settings.width), 0.01)
    layer("critic_weight", "critic_bias", (1, settings.width), 1.0)
    return named


__all__ = ["CNNPolicy", "CNNPolicySettings"]
