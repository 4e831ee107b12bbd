"""The starting policy of pictures: a denoiser that learns from real ones at first use, and is kept.

Variant: the loss of Ho et al. 2020 on v (Salimans and Ho 2022), and a moving average of the weights. Left out:
captions, which only learning from preferences gives a meaning.
"""

from __future__ import annotations

import hashlib
import json
import math
import shutil
from pathlib import Path

import numpy as np
import torch
from platformdirs import user_cache_path
from pydantic import Field
from rich.console import Console
from torch import Tensor

from prefrl.components import Settings
from prefrl.policies.denoiser import Denoiser
from prefrl.seeding import draw_seed, generator, threads
from prefrl.storage.checkpoints import load_state, save_state
from prefrl.storage.files import DamagedError, verify, whole_folder
from prefrl.types import Floats, State

RECIPE = 1
"""Raise this when the same settings lead to other weights: what older versions kept is then left alone."""
NAME = "denoiser"


class DenoiserSettings(Settings):
    """The starting policy: its size, and how it learns to draw like the pictures it is shown."""

    steps: int = Field(12, ge=3)
    """T: from pure noise to a picture; a chain has T - 1 choices."""
    width: int = Field(256, ge=8)
    """Of the hidden layers."""
    layers: int = Field(3, ge=1)
    """Residual ones."""
    batches: int = Field(6000, ge=1)
    """Gradient steps."""
    batch_size: int = Field(128, ge=1)
    """Pictures in a gradient step, each with a noise of its own."""
    learning_rate: float = Field(1e-3, gt=0)
    """Adam's at first; it falls to 0 along a cosine."""
    average: float = Field(0.998, ge=0, lt=1)
    """How much of the moving average stays at each step."""
    seed: int = Field(0, ge=0)
    """Of the weights, the noise and the order; a run's own seed does not change its starting policy."""
    cache: Path | None = None
    """The folder that keeps finished denoisers; the user's cache folder when not given."""

    def build(self, pixels: Floats, captions: int) -> Denoiser:
        """A denoiser of pictures (N, D) in [-1, 1]: from the cache if it is there and whole, else trained now."""
        model = self._empty(pixels.shape[1], captions)
        folder = (self.cache or user_cache_path("prefrl") / "models") / self._digest(pixels)
        try:
            state = _load(folder)
        except DamagedError as error:
            if folder.exists():
                Console(stderr=True).print(f"the kept denoiser is damaged ({error}); making it anew", soft_wrap=True)
                shutil.rmtree(folder)
            with whole_folder(folder) as work:
                save_state(work, NAME, self._trained(pixels))
            state = _load(folder)
        model.load_state_dict(model.state_dict() | state)
        return model

    def _empty(self, pixels: int, captions: int) -> Denoiser:
        # torch initialises from its global generator, which is put back for whoever else draws from it.
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(draw_seed(np.random.default_rng(self.seed)))
            return Denoiser(pixels, captions, self.steps, self.width, self.layers)

    def _digest(self, pixels: Floats) -> str:
        """Of the settings, the pictures, and the versions that decide the weights."""
        lasting = self.model_dump(mode="json", exclude={"cache"})  # where it is kept does not change it
        said = json.dumps([lasting, RECIPE, torch.__version__], sort_keys=True)
        return hashlib.sha256(said.encode() + np.ascontiguousarray(pixels).tobytes()).hexdigest()[:24]

    def _trained(self, pixels: Floats) -> State:
        """The averaged weights, those of captions left out."""
        model, order = self._empty(pixels.shape[1], 1), generator(np.random.default_rng(self.seed))
        shown = torch.from_numpy(np.ascontiguousarray(pixels, np.float32))
        optimizer = torch.optim.Adam(model.parameters(), self.learning_rate, fused=True)
        kept = {name: value.detach().clone() for name, value in model.named_parameters()}
        Console(stderr=True).print(f"training a denoiser on {len(shown)} pictures (once; it is kept)", soft_wrap=True)
        with threads(1):
            for number in range(self.batches):
                optimizer.param_groups[0]["lr"] = self._rate(number)
                optimizer.zero_grad()
                _loss(model, shown, self.batch_size, order).backward()  # type: ignore[no-untyped-call]
                optimizer.step()
                for name, value in model.named_parameters():
                    # The average of a short run must not depend on where it started.
                    kept[name].lerp_(value.detach(), max(1 - self.average, 1 / (number + 1)))
        return {name: value for name, value in kept.items() if not name.startswith("captions.")}

    def _rate(self, number: int) -> float:
        return self.learning_rate * (0.5 + 0.5 * math.cos(math.pi * number / self.batches))


def _load(folder: Path) -> State:
    verify(folder)  # the name says what went in, not whether all of it is still there
    return load_state(folder, NAME)


def _loss(model: Denoiser, shown: Tensor, size: int, order: torch.Generator) -> Tensor:
    """The mean squared error of v at random levels of noise."""
    at = torch.randint(len(shown), (size,), generator=order)
    level = torch.randint(1, model.steps + 1, (size,), generator=order)
    clean, noise = shown[at], torch.randn(size, shown.shape[1], generator=order)
    kept, lost = model.mixture(level)
    found = model(kept * clean + lost * noise, level, torch.zeros_like(level))
    loss: Tensor = (found - (kept * noise - lost * clean)).square().mean()
    return loss
