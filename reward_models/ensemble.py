"""How the members of an ensemble are put together into the one reward that learners optimise.

Variants: the mean (Christiano et al. 2017, section 2.2.3), the worst member (Coste et al. 2024), or the mean less
standard deviations, where their uncertainty-weighted reward takes off the variance. The bonus is RUNE's (Liang et al.
2022), which shrinks here from fit to fit and not by the policy's step.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from pydantic import Field

from prefrl.components import Settings
from prefrl.types import Floats

if TYPE_CHECKING:  # torch is heavy, and who reads settings needs none
    from torch import Tensor

LEAST = 1e-12
"""The least variance that a gradient goes through: the root of zero has none."""


class Ensemble(Settings):
    """What an ensemble of E members answers: their mean, or less where they disagree, and a bonus for disagreement."""

    by: Literal["mean", "lower", "worst"] = "mean"
    """The mean; `lower`, the mean less `caution` standard deviations; or `worst`, the lowest of the members."""
    caution: float = Field(1.0, ge=0)
    """How many standard deviations over members `lower` takes off."""
    optimism: float = Field(0.0, ge=0)
    """How many standard deviations over members are added on top, to explore what is not yet known; 0 adds none."""
    optimism_decay: float = Field(0.1, ge=0, le=1)
    """By what share the bonus shrinks from each fit to the next."""


def combine(values: Floats, settings: Ensemble, fits: int) -> Floats:
    """(E, ...) values of E members after `fits` fits -> (...).

    The bonus is beta * std with beta = optimism * (1 - decay)^(fits - 1) (RUNE, Liang et al. 2022, who
    count steps of the policy; here it is the fits that make the reward surer). One member has no spread.
    """
    found: Floats = values.min(0) if settings.by == "worst" else values.mean(0)
    spread = _spread(settings, fits)
    return found + spread * values.std(0) if spread else found


def combine_traced(values: Tensor, settings: Ensemble, fits: int) -> Tensor:
    """As `combine`, in torch, with its gradient."""
    found = values.amin(0) if settings.by == "worst" else values.mean(0)
    spread = _spread(settings, fits)
    return found + spread * values.var(0, correction=0).clamp(min=LEAST).sqrt() if spread else found


def _spread(settings: Ensemble, fits: int) -> float:
    """How many standard deviations over members are added."""
    # max: before the first fit the bonus is as large as after it, and no larger.
    beta = settings.optimism * (1 - settings.optimism_decay) ** max(fits - 1, 0)
    return beta - (settings.caution if settings.by == "lower" else 0.0)


__all__ = ["Ensemble", "combine", "combine_traced"]
