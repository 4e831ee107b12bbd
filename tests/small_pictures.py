"""A small task of pictures: its denoiser is made within a second, and kept for all tests."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from prefrl.envs.digits import Digits, DigitsSettings
from prefrl.policies.denoiser import DenoiserPolicy, DenoisingSettings
from prefrl.protocols import RewardModel, Store
from prefrl.types import Floats, Picture

NO_STORE = cast("Store[Picture]", None)


def small_digits(*captions: str, **denoiser: Any) -> Digits:
    settings = DigitsSettings(captions=captions or ("a three",)).shrunk()
    return settings.model_copy(update={"denoiser": settings.denoiser.model_copy(update=denoiser)}).build()


def policy_of(task: Digits, chunk: int = 64) -> DenoiserPolicy:
    return DenoiserPolicy(task, DenoisingSettings(chunk=chunk))


@dataclass
class Dark:
    """A reward that likes ink, or any constant."""

    constant: float | None = None
    seen: tuple[Picture, ...] = ()

    def score(self, candidates: Sequence[Picture]) -> Floats:
        self.seen = tuple(candidates)
        if self.constant is not None:
            return np.full(len(candidates), self.constant, np.float32)
        return np.array([one.pixels.mean() / 25 for one in candidates], np.float32)


def likes_ink() -> RewardModel[Picture]:
    return cast("RewardModel[Picture]", Dark())
