"""A denoiser of small pictures as a policy: noise becomes a picture step by step, and each step is a choice.

Variant: the ancestral sampler of DDPM (Ho et al. 2020, algorithm 2) over few steps, with the cosine schedule (Nichol
and Dhariwal 2021) and a network that predicts v (Salimans and Ho 2022); read as a policy as DDPO does (Black et al.
2024): a chain is a sequence, and a step a token that is drawn from a Gaussian over all pixels, whose mean the network
says and whose variance is fixed. So log-probabilities are exact, and so is the KL of a step. What differs: the last
step has no noise and stays the starting policy's, so that the KL between pictures is at most that between chains.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from typing import cast

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from prefrl.components import Settings
from prefrl.protocols import PictureTask, caption_numbers
from prefrl.seeding import generator, to_numpy
from prefrl.types import Picture, State

FEWEST = 16
"""Rows that a product of matrices takes at least: with fewer, other kernels round otherwise, and a probability ratio
would not be exactly 1."""


class Denoiser(torch.nn.Module):
    """What noisy pixels were before the noise, at each of `steps` levels of it; a perceptron with skips.

    Of pixels in [-1, 1] with noise, x = a x0 + b e, it says v = a e - b x0 (R, D). A caption adds a vector to every
    layer, which is 0 at first: the starting policy draws the same for all captions.
    """

    def __init__(self, pixels: int, captions: int, steps: int, width: int, layers: int) -> None:
        super().__init__()
        self.signal: Tensor
        """(T + 1,): the share of a picture's variance that is left at each level (alpha-bar)."""
        self.enter, self.leave = torch.nn.Linear(pixels, width), torch.nn.Linear(width, pixels)
        self.levels, self.captions = torch.nn.Embedding(steps + 1, width), torch.nn.Embedding(captions, width)
        self.layers = torch.nn.ModuleList(_Layer(width) for _ in range(layers))
        torch.nn.init.zeros_(self.captions.weight)
        share = torch.arange(steps + 1, dtype=torch.float64) / steps
        signal = torch.cos((share + 0.008) / 1.008 * math.pi / 2).square()  # alpha-bar, (T + 1,)
        self.register_buffer("signal", (signal / signal[0]).clamp(min=1e-4).float())

    @property
    def steps(self) -> int:
        """T: how many there are from noise to a picture."""
        return self.levels.num_embeddings - 1

    def forward(self, x: Tensor, level: Tensor, caption: Tensor) -> Tensor:
        """Pixels (R, D), levels (R,) from 1 to T, captions (R,) -> v (R, D)."""
        told = self.levels(level) + self.captions(caption)
        h = self.enter(x)
        for layer in self.layers:
            h = layer(h, told)
        found: Tensor = self.leave(torch.nn.functional.silu(h))
        return found

    def clean(self, x: Tensor, level: Tensor, caption: Tensor) -> Tensor:
        """(R, D): the picture that is expected behind the noise."""
        kept, lost = self.mixture(level)
        found: Tensor = kept * x - lost * self(x, level, caption)
        return found

    def mixture(self, level: Tensor) -> tuple[Tensor, Tensor]:
        """a and b (R, 1): how much of the picture and of the noise there is at levels (R,)."""
        signal = self.signal[level, None]
        return signal.sqrt(), (1 - signal).sqrt()


class _Layer(torch.nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.norm = torch.nn.LayerNorm(width)
        self.inner, self.outer = torch.nn.Linear(width, width), torch.nn.Linear(width, width)

    def forward(self, h: Tensor, told: Tensor) -> Tensor:
        found: Tensor = h + self.outer(torch.nn.functional.silu(self.inner(self.norm(h) + told)))
        return found


@dataclass(frozen=True, eq=False)
class Chains:
    """B chains of L choices, from noise to what the last step makes a picture of."""

    captions: Tensor
    """(B,) int64: which of the task's."""
    states: Tensor
    """(B, L + 1, D): pixels in about [-1, 1], from pure noise on."""
    logp: Tensor
    """(B, L) float32: log-probabilities at sampling."""
    pixels: Tensor
    """(B, H, W) uint8, or (B, H, W, 3): what came of it."""

    def __len__(self) -> int:
        return len(self.captions)

    @property
    def mask(self) -> Tensor:
        """(B, L) bool: all steps are real."""
        return torch.ones_like(self.logp, dtype=torch.bool)

    def rows(self, at: Tensor) -> Chains:
        return Chains(self.captions[at], self.states[at], self.logp[at], self.pixels[at])

    def order(self) -> Tensor:
        return torch.arange(len(self), device=self.captions.device)

    def candidates(self, captions: Sequence[str]) -> list[Picture]:
        """As the vocabulary's `Picture`s, without gold."""
        pixels, which = to_numpy(self.pixels), self.captions.tolist()
        return [Picture(captions[at], one) for at, one in zip(which, pixels, strict=True)]


class DenoisingSettings(Settings):
    """How much of a policy of pictures goes through its network at once."""

    chunk: int = Field(512, ge=1)
    """Chains in one pass of the network: changes memory and speed, and results by rounding only."""


@dataclass(frozen=True)
class _Steps:
    """What a step from level t to t - 1 is made of, (T + 1,) each: x' ~ N(of_clean x0 + of_noisy x, variance)."""

    of_clean: Tensor
    of_noisy: Tensor
    variance: Tensor


def _steps_of(signal: Tensor) -> _Steps:
    """Ho et al. 2020, equations 6 and 7, from alpha-bar (T + 1,)."""
    before = torch.cat([signal[:1], signal[:-1]])
    kept = signal / before  # alpha
    noise = (1 - signal).clamp(min=1e-12)
    return _Steps(
        before.sqrt() * (1 - kept) / noise, kept.sqrt() * (1 - before) / noise, (1 - kept) * (1 - before) / noise
    )


class DenoiserPolicy:
    """A `prefrl.protocols.Policy` of `Chains`: a denoiser beside the one that it started from."""

    def __init__(self, task: PictureTask, settings: DenoisingSettings) -> None:
        self.task, self.part = task, settings.chunk
        self.model, self.start = (cast(Denoiser, task.denoiser()) for _ in range(2))
        self.start.requires_grad_(False)
        self._steps = _steps_of(self.model.signal)

    @property
    def device(self) -> torch.device:
        return self.model.enter.weight.device

    def to(self, device: torch.device) -> None:
        """Move everything to a device, for good."""
        for model in (self.model, self.start):
            model.to(device)
        self._steps = _steps_of(self.model.signal)

    def parameters(self) -> list[torch.nn.Parameter]:
        return list(self.model.parameters())

    def log_prob(self, inputs: Chains) -> tuple[Tensor, None]:
        return self._logp(inputs, self._clean(self.model, inputs)), None

    def log_prob_and_kl(self, inputs: Chains) -> tuple[Tensor, Tensor]:
        """(B, L) log-probabilities, and the KL of each step to the starting policy, given the step's beginning."""
        clean = self._clean(self.model, inputs)
        return self._logp(inputs, clean), self._kl(clean, self._clean(self.start, inputs))

    def values(self, inputs: Chains) -> Tensor:
        raise ValueError("a denoiser has no critic: set the weight of its loss to 0")

    def log_prob_and_values(self, inputs: Chains) -> tuple[Tensor, None, Tensor]:
        return *self.log_prob(inputs), self.values(inputs)

    @torch.no_grad()
    def start_logp_and_kl(self, chains: Chains) -> tuple[Tensor, Tensor]:
        """(B, L) log-probabilities under the starting policy, and the KL of each step to it, from one pass of it.

        The KL is exact given the step's beginning.
        """
        logp, kl = [], []
        for some in self._parts(chains):
            start = self._clean(self.start, some)
            logp.append(self._logp(some, start))
            kl.append(self._kl(self._clean(self.model, some), start))
        return torch.cat(logp), torch.cat(kl)

    @torch.no_grad()
    def kl(self, chains: Chains) -> Tensor:
        """(B, L) KL of each step to the starting policy, exact given the step's beginning."""
        parts = self._parts(chains)
        return torch.cat([self._kl(self._clean(self.model, x), self._clean(self.start, x)) for x in parts])

    def gains(self, pixels: Tensor, captions: Tensor, levels: Tensor, noise: Tensor) -> Tensor:
        """(R,) how much more probable pictures (R, D) have become than they were at the start, in nats; differentiable.

        By one step each, from levels (R,) of at least 2 that the noise (R, D) leads to, times how many there are.
        """
        kept, lost = self.model.mixture(levels)
        noisy = kept * pixels + lost * noise
        ours, start = (_of_rows(m, noisy, levels, captions) for m in (self.model, self.start))
        # The step that the picture itself would take is a Gaussian of the same variance: see `_kl`.
        nearer = (start - pixels).square().sum(1) - (ours - pixels).square().sum(1)
        return nearer * self._pull[levels] * (self.model.steps - 1)

    @torch.no_grad()
    def draw(self, captions: Sequence[str], rng: np.random.Generator) -> Chains:
        """A chain for each caption."""
        which, source = self.numbers(captions), generator(rng)
        size = (len(which), self.model.enter.in_features)
        # Of all chains, so that the pictures do not depend on the parts; (B, T, D): first what a chain begins with.
        noise = torch.stack([torch.randn(size, generator=source) for _ in range(self.model.steps)], 1)
        pairs = zip(which.split(self.part), noise.split(self.part), strict=True)  # type: ignore[no-untyped-call]
        parts = [self._draw(some, added.to(self.device)) for some, added in pairs]
        return Chains(which, *(torch.cat(column) for column in zip(*parts, strict=True)))

    def numbers(self, captions: Iterable[str]) -> Tensor:
        """(N,) int64: which of the task's captions each is."""
        return torch.tensor(caption_numbers(self.task, captions), device=self.device)

    def with_gold(self, chains: Chains) -> list[Picture]:
        """As candidates, gold attached: for what is asked about, and for evaluation."""
        found = chains.candidates(self.task.captions)
        gold = self.task.gold(found)
        return [replace(one, gold=gold[i : i + 1]) for i, one in enumerate(found)]

    def start_digest(self) -> str:
        """sha256 over the starting policy's weights."""
        found = hashlib.sha256()
        for name, value in self.start.named_parameters():
            found.update(name.encode() + to_numpy(value).tobytes())
        return found.hexdigest()

    def state(self) -> State:
        """What learning changes."""
        return {name: p.detach().clone() for name, p in self.model.named_parameters()}

    @torch.no_grad()
    def load(self, state: State) -> None:
        """Raises ValueError where names or shapes differ."""
        for name, parameter in self.model.named_parameters():
            found = state.get(name)
            if found is None or found.shape != parameter.shape:
                raise ValueError(f"policy: {name} is missing or has another shape: it was made by other settings")
            parameter.copy_(found)  # in place: the optimiser holds these very tensors

    def _draw(self, captions: Tensor, noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """States (b, L + 1, D), log-probabilities (b, L) and pixels (b, H, W) of some chains, from noise (b, T, D)."""
        states, logp = [noise[:, 0]], []
        for level in range(self.model.steps, 1, -1):
            clean = _of_rows(self.model, states[-1], torch.full_like(captions, level), captions)
            mean, variance = self._mean(clean, states[-1], level), self._steps.variance[level]
            states.append(mean + variance.sqrt() * noise[:, len(states)])
            logp.append(_gaussian(states[-1], mean, variance))
        last = _of_rows(self.start, states[-1], torch.ones_like(captions), captions)
        pixels = ((last + 1) * 127.5).round().clamp(0, 255).to(torch.uint8)
        return torch.stack(states, 1), torch.stack(logp, 1), pixels.view(-1, *self.task.shape)

    def _mean(self, clean: Tensor, noisy: Tensor, level: int) -> Tensor:
        return self._steps.of_clean[level] * clean + self._steps.of_noisy[level] * noisy

    def _clean(self, model: Denoiser, chains: Chains) -> Tensor:
        """(B, L, D): what is expected behind the noise that each step begins with."""
        before = chains.states[:, :-1]
        levels = self._levels.expand(before.shape[:2])
        captions = chains.captions[:, None].expand(before.shape[:2])
        return _of_rows(model, before.flatten(0, 1), levels.flatten(), captions.flatten()).view_as(before)

    @property
    def _levels(self) -> Tensor:
        """(L,): T down to 2."""
        return torch.arange(self.model.steps, 1, -1, device=self.device)

    def _logp(self, chains: Chains, clean: Tensor) -> Tensor:
        of_clean, of_noisy, variance = (x[self._levels, None] for x in _columns(self._steps))
        mean = of_clean * clean + of_noisy * chains.states[:, :-1]
        return _gaussian(chains.states[:, 1:], mean, variance)

    def _kl(self, clean: Tensor, other: Tensor) -> Tensor:
        """(B, L): Gaussians of one variance are as far apart as half the square of their means' distance in std."""
        apart = (clean - other).square().sum(2)
        return apart * self._pull[self._levels]

    @property
    def _pull(self) -> Tensor:
        """(T + 1,): nats of a step for each square of what is expected behind the noise."""
        return self._steps.of_clean.square() / (2 * self._steps.variance)

    def _parts(self, chains: Chains) -> list[Chains]:
        return [chains.rows(at) for at in chains.order().split(self.part)]  # type: ignore[no-untyped-call]


def _columns(steps: _Steps) -> tuple[Tensor, Tensor, Tensor]:
    return steps.of_clean, steps.of_noisy, steps.variance


def _of_rows(model: Denoiser, x: Tensor, level: Tensor, caption: Tensor) -> Tensor:
    """`Denoiser.clean` of as many rows as there are, in a pass of no fewer than `FEWEST`."""
    missing = max(0, FEWEST - len(x))
    if not missing:
        return model.clean(x, level, caption)
    padded = (torch.cat([one, one[:1].expand(missing, *one.shape[1:])]) for one in (x, level, caption))
    return model.clean(*padded)[: len(x)]


def _gaussian(x: Tensor, mean: Tensor, variance: Tensor) -> Tensor:
    """log N(x; mean, variance) over all pixels: (..., D) -> (...)."""
    return (-(x - mean).square() / (2 * variance) - 0.5 * (2 * math.pi * variance).log()).sum(-1)
