"""A number with its interval, as plain data: for report cards, pages and files. Light, so that a server starts fast."""

from __future__ import annotations

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
