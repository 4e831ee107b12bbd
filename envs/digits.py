"""Handwritten digits to be drawn for a caption: scikit-learn's 8 x 8 pictures, which lie in its package.

The denoiser that learning starts from was shown all of them, and draws any digit whatever the caption. The gold of a
digit's caption is what a classifier finds, fitted on one half of them; the other half is for a judge that is
independent of it (`reader`).
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, Self

import numpy as np
import numpy.typing as npt
from pydantic import Field, field_validator
from sklearn.datasets import load_digits
from sklearn.kernel_approximation import Nystroem
from sklearn.linear_model import LogisticRegression
from sklearn.pipeline import make_pipeline
from sklearn.svm import SVC

from prefrl.components import Settings, suggest
from prefrl.policies.denoiser import Denoiser
from prefrl.policies.denoising import DenoiserSettings
from prefrl.types import Bools, Floats, Integers, Picture

NUMERALS = ("zero", "one", "two", "three", "four", "five", "six", "seven", "eight", "nine")
DIGITS = {f"{'an' if word == 'eight' else 'a'} {word}": digit for digit, word in enumerate(NUMERALS)}
THICKER, MINE = "thicker", "mine"
CAPTIONS = (*DIGITS, THICKER, MINE)
SHOWN = 160
"""Pixels of a side, as people see it."""


class DigitsSettings(Settings):
    """Handwritten digits of 8 x 8 pixels that are drawn for a caption; the gold is what a classifier reads."""

    kind: Literal["digits"] = "digits"
    captions: tuple[str, ...] = Field(("a three",), min_length=1)
    """What is asked for: digits, as `a three`, whose gold is a classifier's probability; `thicker`, whose gold is the
    share of ink; or `mine`, for what you like, which has no gold."""
    denoiser: DenoiserSettings = DenoiserSettings()
    """The starting policy."""

    @field_validator("captions")
    @classmethod
    def _known(cls, captions: tuple[str, ...]) -> tuple[str, ...]:
        for caption in captions:
            if caption not in CAPTIONS:
                raise ValueError(f"unknown caption {caption!r}; {suggest(caption, CAPTIONS)}")
        if len(set(captions)) < len(captions):
            raise ValueError(f"expected captions that differ, got {', '.join(captions)}")
        return captions

    def shrunk(self) -> DigitsSettings:
        small = {"steps": 4, "width": 32, "layers": 1, "batches": 300}
        return self.model_copy(update={"denoiser": self.denoiser.model_copy(update=small)})

    def identity(self) -> Self:
        """Without the starting policy: a reward model depends on the captions alone."""
        return self.model_copy(update={"denoiser": DenoiserSettings()})

    def build(self) -> Digits:
        return Digits(self.captions, *real_digits(), self.denoiser)


def real_digits() -> tuple[npt.NDArray[np.uint8], Integers]:
    """(1797, 8, 8) pictures, and which digit each is."""
    found = load_digits()
    return np.rint(found.images * (255 / 16)).astype(np.uint8), found.target


@dataclass(frozen=True, eq=False)
class Digits:
    """A `prefrl.protocols.PictureTask`."""

    captions: tuple[str, ...]
    pixels: npt.NDArray[np.uint8]
    """Of all real digits."""
    digits: Integers
    start: DenoiserSettings
    """Of the denoiser, which is made when it is first asked for: who only shows pictures needs none."""
    name: str = "digits"
    kind: str = "pictures"
    fps: float = 1.0

    @property
    def shape(self) -> tuple[int, ...]:
        return self.pixels.shape[1:]

    @property
    def ungraded(self) -> str:
        return f"the caption {MINE}" if MINE in self.captions else ""

    def denoiser(self) -> Denoiser:
        return copy.deepcopy(self._start)

    def frames(self, candidate: Picture) -> np.ndarray:
        """(1, H, W, 3) uint8: enlarged without smoothing, dark on light."""
        self._check(candidate)
        large = np.kron(255 - candidate.pixels, np.ones((SHOWN // 8, SHOWN // 8), np.uint8))
        return np.repeat(large[None, :, :, None], 3, axis=3)

    def gold(self, pictures: Sequence[Picture]) -> Floats:
        """(N,) a digit's probability in [0, 1], the share of ink in [0, 1], or NaN for what only you can tell."""
        found = np.full(len(pictures), np.nan)
        for caption in {one.caption for one in pictures}:
            at = [i for i, one in enumerate(pictures) if one.caption == caption]
            found[at] = self._worth(caption, flat([pictures[i] for i in at]))
        return found

    def spread(self, pictures: Sequence[Picture]) -> float:
        """The mean over captions of how much pictures of one differ, over how much real ones of its digit do.

        It is the square root of the summed variance of all pixels. Captions that name no digit are compared with all.
        """
        found = []
        for caption in dict.fromkeys(one.caption for one in pictures):
            drawn = flat([one for one in pictures if one.caption == caption])
            real = self.pixels[self._real(caption)].reshape(-1, drawn.shape[1])
            if len(drawn) > 1:
                found.append(deviation(drawn) / deviation(real / 255))
        return float(np.mean(found)) if found else float("nan")

    def reader(self) -> Any:
        """A classifier that shares neither data nor form with the gold: `predict` maps (N, D) in [0, 1] to digits."""
        return SVC(gamma=0.3, C=10).fit(*self._half(1))

    def _worth(self, caption: str, pixels: Floats) -> Floats:
        if caption in DIGITS:
            found: Floats = self._gold.predict_proba(pixels)[:, DIGITS[caption]]
            return found
        return pixels.mean(1) if caption == THICKER else np.full(len(pixels), np.nan)

    @cached_property
    def _gold(self) -> Any:
        features = Nystroem(gamma=0.2, n_components=400, random_state=0)
        return make_pipeline(features, LogisticRegression(C=30, max_iter=500)).fit(*self._half(0))

    def _half(self, which: int) -> tuple[Floats, Integers]:
        """Every other digit: as they lie in the package, a writer's stand together."""
        return self.pixels[which::2].reshape(-1, 64) / 255, self.digits[which::2]

    def _real(self, caption: str) -> Bools:
        return self.digits == DIGITS[caption] if caption in DIGITS else np.ones(len(self.digits), bool)

    @cached_property
    def _start(self) -> Denoiser:
        inputs = self.pixels.reshape(len(self.pixels), -1).astype(np.float32) / 127.5 - 1
        return self.start.build(inputs, len(self.captions))

    def _check(self, picture: Picture) -> None:
        if picture.pixels.shape != self.shape:
            raise ValueError(
                f"picture {picture.id[:12]} has pixels of shape {picture.pixels.shape}; expected {self.shape}, as all "
                f"of {self.name} have"
            )


def flat(pictures: Sequence[Picture]) -> Floats:
    """(N, D) in [0, 1]."""
    found: Floats = np.stack([one.pixels.ravel() for one in pictures]) / 255
    return found


def deviation(pixels: Floats) -> float:
    """The root of the summed variance of all pixels (N, D)."""
    return float(np.sqrt(pixels.var(0).sum()))
