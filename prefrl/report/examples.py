"""A few candidates kept for the report: texts and pictures as they are, clips as small films and strips of frames."""

from __future__ import annotations

import io
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from PIL import Image

from prefrl.kinds import kind_of
from prefrl.protocols import Clocked, DrawnTask, Task
from prefrl.storage.files import write_file
from prefrl.types import Candidate, Floats, Json, gold_score

FRAMES = 6
GAP, GREY = 2, 215
"""Between two frames: pixels, and a shade that is seen on white pictures and on black ones."""
HEIGHT = 160
"""Pixels. Larger frames are made smaller, so that a report of many strips stays light."""
RATE = 12.5
"""Pictures of a film in a second, at most."""


def save_examples(task: Task, examples: Sequence[Candidate], learned: Floats | None, folder: Path, name: str) -> Path:
    """Write `examples/<name>.json` into a run's folder, with a film (WebP) and a strip (PNG) for each clip.

    Returns its path. `learned` (N,) is the reward model's score of each example, None before there is a fitted one.
    Where frames cannot be drawn (no graphics library, no simulator states) the caption says so.
    """
    if learned is not None and len(learned) != len(examples):
        raise ValueError(f"expected one learned score for each of {len(examples)} examples, got {len(learned)}")
    place, entries = folder / "examples", []
    scores = [math.nan] * len(examples) if learned is None else [float(score) for score in learned]
    for i, (candidate, score) in enumerate(zip(examples, scores, strict=True)):
        gold = None if candidate.gold is None else _finite(gold_score(candidate))
        shown = _show(task, candidate, place, f"{name}-{i}")
        entries.append({"gold": gold, "learned": _finite(score), **shown})
    path = place / f"{name}.json"
    write_file(path, json.dumps(entries, indent=1, allow_nan=False).encode())
    return path


def score_examples(folder: Path, name: str, learned: Floats) -> None:
    """Give the examples in `examples/<name>.json`, or the first of them, other learned scores."""
    path = folder / "examples" / f"{name}.json"
    entries = json.loads(path.read_text(encoding="utf-8"))
    for entry, score in zip(entries, learned, strict=False):
        entry["learned"] = _finite(float(score))
    write_file(path, json.dumps(entries, indent=1, allow_nan=False).encode())


def strip(frames: np.ndarray, count: int = FRAMES) -> np.ndarray:
    """Evenly spaced frames of (T, H, W, 3) uint8, the first and the last among them, side by side with thin gaps."""
    at = np.unique(np.linspace(0, len(frames) - 1, count).round().astype(int))
    gap = np.full((frames.shape[1], GAP, 3), GREY, np.uint8)
    parts = [part for i in at for part in (gap, frames[i])][1:]
    return np.concatenate(parts, axis=1)


def _show(task: Task, candidate: Candidate, place: Path, file: str) -> Json:
    kind = kind_of(candidate)
    shown = kind.shown(kind.describe(candidate))
    if shown.text is not None:
        return {"prompt": shown.prompt, "text": shown.text}
    drawn = cast(DrawnTask[Candidate], task)
    try:
        frames = drawn.frames(candidate)
    except Exception as error:  # a renderer may raise anything, and a missing picture must not end a run
        return {"caption": f"No picture: drawing failed with {type(error).__name__}: {error}"}
    save_strip(strip(frames), place / f"{file}.png")
    if kind.still:
        return {"strip": f"{file}.png", "still": True, "caption": shown.prompt or ""}
    save_film(frames, drawn.fps, place / f"{file}.webp")
    return {"strip": f"{file}.png", "film": f"{file}.webp", "caption": _caption(drawn, shown.steps)}


def _caption(task: DrawnTask[Any], steps: int) -> str:
    time = f", {steps / task.fps:.1f} s of simulated time" if isinstance(task, Clocked) else ""
    return f"{steps} steps{time}, from left to right"


def save_strip(picture: np.ndarray, path: Path) -> None:
    """Write a picture (H, W, 3) uint8 as a PNG."""
    buffer = io.BytesIO()
    _small(picture).save(buffer, format="PNG", optimize=True)
    write_file(path, buffer.getvalue())


def save_film(frames: np.ndarray, fps: float, path: Path) -> None:
    """Write frames (T, H, W, 3) uint8, so many of a second, as a WebP that plays over and over."""
    step = max(1, math.ceil(fps / RATE))
    first, *rest = (_small(frame) for frame in frames[::step])
    buffer, seconds = io.BytesIO(), step / fps
    first.save(
        buffer, format="WEBP", save_all=True, append_images=rest, duration=round(1000 * seconds), loop=0, quality=60
    )
    write_file(path, buffer.getvalue())


def _small(picture: np.ndarray) -> Image.Image:
    image = Image.fromarray(picture)
    if image.height <= HEIGHT:
        return image
    return image.resize((round(image.width * HEIGHT / image.height), HEIGHT), Image.Resampling.LANCZOS)


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None
