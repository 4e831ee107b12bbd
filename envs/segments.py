"""A control task whose simulator is not there: behaviour that was recorded, from a file."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, Self

import numpy as np
from pydantic import Field

from prefrl.components import ConfigError, Settings
from prefrl.exchange.recordings import recording
from prefrl.protocols import Environments
from prefrl.types import Floats, Segment


class SegmentsSettings(Settings):
    """Recorded behaviour from a file; there is nothing to act in, and its value is known only where the file has it."""

    kind: Literal["segments"] = "segments"
    data: Path | None = None
    """An .npz file of segments or of judged pairs, or the folder of a Minari data set: the sizes and bounds of
    observations and actions are its own."""
    segment_steps: int | None = Field(None, gt=0)
    """Length of a judged segment; by default that of the shortest one in the file."""
    fps: float = Field(20.0, gt=0)
    """Control steps per simulated second."""

    def identity(self) -> Self:
        """Without where its behaviour comes from: a reward model hangs on sizes alone."""
        return self.model_copy(update={"data": None})

    def build(self) -> SegmentsTask:
        """Raises `ConfigError` where there is no such file, `ValueError` for a bad one."""
        if self.data is None or not self.data.exists():
            raise ConfigError(f"task.data: expected a file of segments or a Minari data set, got {self.data}")
        found = recording(self.data)
        lengths = [len(one) for one in found.segments]
        steps = self.segment_steps or min(lengths)
        if steps > max(lengths):
            raise ConfigError(f"task.segment_steps={steps}, but the longest segment of {self.data} has {max(lengths)}")
        first = found.segments[0]
        return SegmentsTask(
            name=self.data.stem,
            segments=found.segments,
            action_bounds=found.bounds,
            observation_size=first.observations.shape[1],
            action_size=first.actions.shape[1],
            horizon=max(lengths),
            segment_steps=steps,
            fps=self.fps,
        )


@dataclass(frozen=True, eq=False)
class SegmentsTask:
    """A `prefrl.protocols.ControlTask` that is `prefrl.protocols.Recorded`."""

    name: str
    segments: tuple[Segment, ...] = field(repr=False)
    action_bounds: tuple[Floats, Floats] | None
    observation_size: int
    action_size: int
    horizon: int
    """The steps of the longest segment."""
    segment_steps: int
    fps: float

    @property
    def kind(self) -> str:
        return "control"

    def environments(self, count: int) -> Environments:
        """Raises `ConfigError`: there are none."""
        raise ConfigError(f"{self.name} has no simulator to act in: use task.kind=control where there is one")

    def frames(self, segment: Segment) -> np.ndarray:
        """Raises `ValueError`: there is nothing to draw with."""
        raise ValueError(f"{self.name} has no simulator, so that its segments cannot be drawn")
