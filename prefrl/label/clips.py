"""Moving pictures of a query: its candidates side by side, as one mp4, or a GIF where PyAV is not installed."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

GAP = 8
"""Pixels between two candidates."""


def write_clip(path: Path, clips: Sequence[np.ndarray], fps: float) -> Path:
    """Write K clips (T, H, W, 3) uint8 as one; the file gets the suffix .mp4, or .gif without PyAV.

    Shorter clips hold their last frame until the longest ends.
    """
    frames = side_by_side(clips)
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        import av  # noqa: F401
    except ModuleNotFoundError:
        return _write_gif(path.with_suffix(".gif"), frames, fps)
    return _write_mp4(path.with_suffix(".mp4"), frames, fps)


def side_by_side(clips: Sequence[np.ndarray]) -> np.ndarray:
    """K clips (T, H, W, 3) -> (T, H', W', 3) on white, padded to even sizes: H.264 takes no odd ones."""
    length, height = max(len(c) for c in clips), max(c.shape[1] for c in clips)
    width = sum(c.shape[2] for c in clips) + GAP * (len(clips) - 1)
    canvas = np.full((length, height + height % 2, width + width % 2, 3), 255, np.uint8)
    left = 0
    for clip in clips:
        held = clip[np.minimum(np.arange(length), len(clip) - 1)]
        canvas[:, : clip.shape[1], left : left + clip.shape[2]] = held
        left += clip.shape[2] + GAP
    return canvas


def _write_mp4(path: Path, frames: np.ndarray, fps: float) -> Path:
    import av

    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=round(fps), options={"crf": "20", "preset": "veryfast"})
        stream.height, stream.width, stream.pix_fmt = frames.shape[1], frames.shape[2], "yuv420p"
        for frame in frames:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
        container.mux(stream.encode())
    return path


def _write_gif(path: Path, frames: np.ndarray, fps: float) -> Path:
    from PIL import Image

    first, *rest = (Image.fromarray(frame) for frame in frames)
    first.save(path, save_all=True, append_images=rest, duration=1000 / fps, loop=0)
    return path
