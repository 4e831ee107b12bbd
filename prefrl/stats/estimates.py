"""A number with its interval, as plain data: for report cards, pages and files. It
loads no scipy, so that a server and the command line start fast."""

from __future__ import annotations

import math
from statistics import NormalDist
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

Number = Annotated[float, Field(ge=-1e15, le=1e15)]
"""Finite, and of a size that can be drawn."""
Words = Annotated[str, Field(max_length=1000)]


class Part(BaseModel):
    """A part of a file. A file that does not fit is refused as a whole."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)


class Estimate(Part):
    """A number with its 95 % interval; or no number, and why."""

    value: Number | None = None
    low: Number | None = None
    high: Number | None = None
    count: int = 0
    """How many comparisons, candidates, items, answers or steps it rests on."""
    how: Words = ""
    """How the interval was made, or why there is none."""
    why: Words = ""
    """Why the number itself is not defined."""


def undefined(why: str, count: int = 0) -> Estimate:
    """No number, and the reason."""
    return Estimate(why=why, count=count)


def wilson(share: float, count: int) -> tuple[float, float]:
    """The 95 % interval of a proportion (Wilson 1927), ties as halves; honest for small counts, within 0 and 1."""
    z = NormalDist().inv_cdf(0.975)
    centre = share + z * z / (2 * count)
    half = z * math.sqrt(share * (1 - share) / count + z * z / (4 * count * count))
    scale = 1 + z * z / count
    # Rounding must not put the share itself outside, where it is 0 or 1.
    return min(max((centre - half) / scale, 0.0), share), max(min((centre + half) / scale, 1.0), share)
