"""Moving pictures: how frames become a file that a browser plays, and candidates side by side for the terminal.

H.264 by PyAV or by the ffmpeg of imageio-ffmpeg, VP9 for browsers without H.264, animated WebP where neither is
installed. A key frame every `KEY_FRAMES`: measured on 60 frames of 240 x 240, a seek costs 1.6 ms instead of the 7.5 of
one key frame in all, and the file is 29 KiB instead of the 134 of key frames alone.
"""

from __future__ import annotations

import os
import re
import struct
import subprocess
import tempfile
from collections.abc import Callable, Mapping, Sequence
from fractions import Fraction
from functools import cache
from importlib.util import find_spec
from io import BytesIO
from math import ceil
from pathlib import Path
from typing import BinaryIO

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
ENCODE_SECONDS = 120.0
"""A time limit for ffmpeg as a process of its own."""
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
    video = find_spec("av") is not None or find_spec("imageio_ffmpeg") is not None
    return ("mp4", "webm") if video else ("webp",)


def encode(frames: np.ndarray, fps: float, format: str) -> bytes:
    """Frames (T, H, W, 3) uint8, shown at `fps` a second, as a whole file: "mp4", "webm", "webp" or "gif".

    Odd heights and widths gain a row or column. Raises `EncodingError` for what no clip can be made of, and where no
    encoder works.
    """
    _check(frames, fps)
    if format in ("webp", "gif"):
        return _stills(frames, fps, format)
    frames = np.pad(frames, ((0, 0), (0, frames.shape[1] % 2), (0, frames.shape[2] % 2), (0, 0)), "edge")
    wrong = []
    for encoder in _encoders():
        try:
            return encoder(frames, Fraction(fps).limit_denominator(1000), format)
        except Exception as error:  # PyAV raises many kinds of its own
            wrong.append(f"{encoder.__name__.removeprefix('_by_')}: {error}")
    raise EncodingError(f"no encoder for {format} works ({'; '.join(wrong) or 'none is installed'}); run: {INSTALL}")


def write_clip(path: Path, clips: Sequence[np.ndarray], fps: float) -> Path:
    """Write K clips (T, H, W, 3) uint8 as one; the file gets the suffix .mp4, or .gif where no video can be made.

    Shorter clips hold their last frame until the longest ends.
    """
    format = "mp4" if "mp4" in formats() else "gif"
    path = path.with_suffix(f".{format}")
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encode(side_by_side(clips), fps, format))
    return path


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


def whole(path: Path) -> bool:
    """Is this a clip from its first byte to its last? Every format says how long it is, so a torn file shows."""
    try:
        with path.open("rb") as file:
            return _SNIFF[path.suffix](file, os.fstat(file.fileno()).st_size)
    except (OSError, KeyError, struct.error):
        return False


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


Encoder = Callable[[np.ndarray, Fraction, str], bytes]


def _encoders() -> list[Encoder]:
    """Those installed, the faster first."""
    table: dict[str, Encoder] = {"av": _by_pyav, "imageio_ffmpeg": _by_ffmpeg}
    return [encoder for module, encoder in table.items() if find_spec(module) is not None]


def _by_pyav(frames: np.ndarray, rate: Fraction, format: str) -> bytes:
    import av

    codec, options = VIDEO[format]
    # A file, not memory: to move the index of an mp4 to its front, ffmpeg reads what it wrote.
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"clip.{format}"
        with av.open(str(path), "w", options=_container(format)) as container:
            stream = container.add_stream(codec, rate=rate, options={**options, "g": str(KEY_FRAMES)})
            stream.height, stream.width, stream.pix_fmt = frames.shape[1], frames.shape[2], "yuv420p"
            for frame in frames:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(frame, format="rgb24")))
            container.mux(stream.encode())
        return path.read_bytes()


def _by_ffmpeg(frames: np.ndarray, rate: Fraction, format: str) -> bytes:
    """By the ffmpeg that comes with imageio-ffmpeg, as a process of its own."""
    import imageio_ffmpeg

    codec, options = VIDEO[format]
    options = {**_container(format), **options, "g": str(KEY_FRAMES), "b:v": options.get("b", "0")}
    options.pop("b", None)
    size = f"{frames.shape[2]}x{frames.shape[1]}"
    source = ["-f", "rawvideo", "-pix_fmt", "rgb24", "-s", size, "-r", str(rate), "-i", "-"]
    chosen = [part for name, value in options.items() for part in (f"-{name}", value)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"clip.{format}"
        head = [imageio_ffmpeg.get_ffmpeg_exe(), "-loglevel", "error", "-nostdin", *source]
        command = [*head, "-c:v", codec, "-pix_fmt", "yuv420p", *chosen, str(path)]
        done = subprocess.run(
            command, input=np.ascontiguousarray(frames).data, capture_output=True, timeout=ENCODE_SECONDS, check=False
        )
        if done.returncode != 0:
            said = done.stderr.decode(errors="replace").strip().splitlines()
            raise RuntimeError(f"ffmpeg ended with {done.returncode}: {said[-1] if said else 'it said nothing'}")
        return path.read_bytes()


def _container(format: str) -> dict[str, str]:
    return {"movflags": "+faststart"} if format == "mp4" else {}


def _stills(frames: np.ndarray, fps: float, format: str) -> bytes:
    """An animated picture by Pillow; above `STILLS_PER_SECOND`, every second, third ... frame."""
    from PIL import Image

    step = ceil(fps / STILLS_PER_SECOND)
    first, *rest = (Image.fromarray(frame) for frame in frames[::step])
    unit = 10 if format == "gif" else 1  # a GIF counts hundredths of a second
    ends = np.rint(np.arange(len(rest) + 2) * (step * 1000 / fps / unit)).astype(int) * unit
    options: Mapping[str, object] = {"quality": 80, "method": 2} if format == "webp" else {}
    data = BytesIO()
    durations = np.diff(ends).tolist()
    first.save(data, format, save_all=True, append_images=rest, duration=durations, loop=0, **options)
    return data.getvalue()


# --- is it whole? -------------------------------------------------------------------------------------------------


def _whole_mp4(file: BinaryIO, size: int) -> bool:
    """Boxes one after another, each with its length, up to the end; the index and the pictures among them."""
    at, found = 0, set()
    while at < size:
        file.seek(at)
        length, kind = struct.unpack(">I4s", file.read(8))
        if length == 1:
            (length,) = struct.unpack(">Q", file.read(8))
        if length < 8 or (at == 0 and kind != b"ftyp"):
            return False
        found.add(kind)
        at += length
    return at == size and {b"ftyp", b"moov", b"mdat"} <= found


def _whole_webm(file: BinaryIO, size: int) -> bool:
    """An EBML header and one segment (18 53 80 67), each with its length, up to the end."""
    at = 0
    for magic in (b"\x1a\x45\xdf\xa3", b"\x18\x53\x80\x67"):
        file.seek(at)
        head = file.read(12)
        if head[:4] != magic:
            return False
        # The first byte's leading zeros tell how many bytes the length has; its leading one is no part of it.
        width = 9 - head[4].bit_length()
        length = int.from_bytes(head[4 : 4 + width], "big") & ((1 << 7 * width) - 1)
        at += 4 + width + length
    return at == size


def _whole_webp(file: BinaryIO, size: int) -> bool:
    riff, length, kind = struct.unpack("<4sI4s", file.read(12))
    return (riff, kind) == (b"RIFF", b"WEBP") and bool(length + 8 == size)


_SNIFF: dict[str, Callable[[BinaryIO, int], bool]] = {
    ".mp4": _whole_mp4,
    ".webm": _whole_webm,
    ".webp": _whole_webp,
}
