"""Moving pictures: how frames become a file that a browser plays, and candidates side by side for the terminal.

H.264 by PyAV, VP9 for browsers without H.264, animated WebP where PyAV is not installed. A key frame every
`KEY_FRAMES`: measured on 60 frames of 240 x 240, a seek costs 1.6 ms instead of the 7.5 of one key frame in all, and
the file is 29 KiB instead of the 134 of key frames alone.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Iterable, Mapping, Sequence
from fractions import Fraction
from functools import cache
from importlib.util import find_spec
from io import BytesIO
from math import ceil
from pathlib import Path

import numpy as np

GAP = 8
"""Pixels between two candidates."""
KEY_FRAMES = 10
"""Frames from one key frame to the next: what a browser decodes at most to show a frame that was jumped to."""
LARGEST = 4096
"""Pixels of a frame's longer side at most: beyond, few browsers decode H.264."""
MOST_BYTES = 1 << 30
"""Of raw frames in one clip."""
STILLS_PER_SECOND = 50.0
"""Browsers slow down WebP and GIF pictures that are shown for less than 20 ms."""
ENCODING = "1"
"""Told apart by every name of a clip: to be raised with each change of how clips look."""

VIDEO = {
    "mp4": ("libx264", {"crf": "20", "preset": "veryfast", "bf": "0"}),
    "webm": ("libvpx-vp9", {"deadline": "realtime", "cpu-used": "8", "crf": "30", "b": "0"}),
}
"""Codec and options; no B frames, so that a clip begins at 0 and steps in order."""
NAME = re.compile("([0-9a-f]{64})[.](mp4|webm|webp)")
"""What the file of a candidate's clip is called, for the page."""
INSTALL = "pip install 'prefrl[label]'"


class EncodingError(ValueError):
    """Frames cannot be made into a clip. The message says why, and what to do."""


@cache
def formats() -> tuple[str, ...]:
    """The formats that can be made here, the most widely played first."""
    return ("mp4", "webm") if find_spec("av") is not None else ("webp",)


def encode(frames: np.ndarray, fps: float, format: str) -> bytes:
    """Frames (T, H, W, 3) uint8, shown at `fps` a second, as a whole file: "mp4", "webm", "webp" or "gif".

    Odd heights and widths gain a row or column. Raises `EncodingError` for what no clip can be made of, and where the
    encoder does not work.
    """
    _check(frames, fps)
    if format in ("webp", "gif"):
        return _stills(frames, fps, format)
    try:
        return _video([_even(frames)], Fraction(fps).limit_denominator(1000), format)
    except Exception as error:  # PyAV raises many kinds of its own, and may not be installed
        raise EncodingError(f"no {format} can be made ({error}); run: {INSTALL}") from error


def write_clip(path: Path, clips: Sequence[np.ndarray], fps: float) -> Path:
    """Write K clips (T, H, W, 3) uint8 as one; the file gets the suffix .mp4, or .gif where no video can be made.

    Shorter clips hold their last frame until the longest ends.
    """
    format = "mp4" if "mp4" in formats() else "gif"
    path = path.with_suffix(f".{format}")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encode(side_by_side(clips), fps, format))
    return path


def write_film(path: Path, clips: Iterable[np.ndarray], fps: float) -> None:
    """Write clips (T, H, W, 3) uint8 of one size, one after another, as one file, whose suffix says how: .mp4, .webm,
    .webp or .gif.

    As a video no more than one clip is held in memory. Raises `EncodingError` for other suffixes, and where PyAV is
    wanted and not installed.
    """
    format, known = path.suffix.removeprefix("."), (*VIDEO, "webp", "gif")
    if format not in known:
        raise EncodingError(f"{path}: expected a name that ends in .{', .'.join(known)}")
    if format in VIDEO and format not in formats():
        raise EncodingError(f"{path}: a video needs PyAV; run: {INSTALL}, or write a .gif")
    if format in VIDEO:
        data = _video((_even(clip) for clip in clips), Fraction(fps).limit_denominator(1000), format)
    else:
        data = encode(np.concatenate(list(clips)), fps, format)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(data)


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


# --- encoders -----------------------------------------------------------------------------------------------------


def _check(frames: np.ndarray, fps: float) -> None:
    if frames.ndim != 4 or frames.shape[-1] != 3 or frames.dtype != np.uint8:
        raise EncodingError(
            f"frames must be uint8 pictures (T, H, W, 3), got {frames.dtype} of shape {frames.shape}; "
            "correct the task's frames()"
        )
    if frames.size == 0:
        raise EncodingError(f"there is nothing to show: expected one frame or more, got the shape {frames.shape}")
    if not 0.01 <= fps <= 1000:
        raise EncodingError(f"expected between 0.01 and 1000 frames a second, got {fps}; set task.fps")
    if max(frames.shape[1:3]) > LARGEST or frames.nbytes > MOST_BYTES:
        raise EncodingError(
            f"{len(frames)} frames of {frames.shape[1]} x {frames.shape[2]} pixels are too much for a clip (at most "
            f"{LARGEST} a side, and {MOST_BYTES >> 20} MiB in all): make task.frame_size or the segments smaller"
        )


def _even(frames: np.ndarray) -> np.ndarray:
    return np.pad(frames, ((0, 0), (0, frames.shape[1] % 2), (0, frames.shape[2] % 2), (0, 0)), "edge")


def _video(clips: Iterable[np.ndarray], rate: Fraction, format: str) -> bytes:
    """Clips of one size, one after another."""
    import av

    codec, options = VIDEO[format]
    index_first = {"movflags": "+faststart"} if format == "mp4" else {}
    # A file, not memory: to move the index of an mp4 to its front, ffmpeg reads what it wrote.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"clip.{format}"
        with av.open(str(path), "w", options=index_first) as container:
            stream = container.add_stream(codec, rate=rate, options={**options, "g": str(KEY_FRAMES)})
            stream.pix_fmt = "yuv420p"
            for number, frames in enumerate(clips):
                if number == 0:  # the codec opens with the first frame
                    stream.height, stream.width = frames.shape[1:3]
                for frame in frames:
                    container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
            container.mux(stream.encode())
        return path.read_bytes()


def _stills(frames: np.ndarray, fps: float, format: str) -> bytes:
    """An animated picture by Pillow; above `STILLS_PER_SECOND`, every second, third ... frame."""
    from PIL import Image

    step = ceil(fps / STILLS_PER_SECOND)
    first, *rest = (Image.fromarray(frame) for frame in frames[::step])
    unit = 10 if format == "gif" else 1  # a GIF counts hundredths of a second
    ends = np.rint(np.arange(len(rest) + 2) * (step * 1000 / fps / unit)).astype(int) * unit
    options: Mapping[str, object] = {"quality": 80, "method": 2} if format == "webp" else {}
    if format == "webp" and not rest:
        options = {"lossless": True}  # a single picture is looked at closely
    data = BytesIO()
    durations = np.diff(ends).tolist()
    first.save(data, format, save_all=True, append_images=rest, duration=durations, loop=0, **options)
    return data.getvalue()
