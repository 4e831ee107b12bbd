"""Frames become files that browsers play."""

from __future__ import annotations

import struct
import subprocess
from collections.abc import Iterator
from fractions import Fraction
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from prefrl.page.clips import encode as clips
from prefrl.page.clips.encode import KEY_FRAMES, VIDEO, EncodingError, encode, formats, whole, write_clip

needs_av = pytest.mark.skipif(find_spec("av") is None, reason="no PyAV")
needs_ffmpeg = pytest.mark.skipif(find_spec("imageio_ffmpeg") is None, reason="no imageio-ffmpeg")
CACHED = ["mp4", "webm", "webp"]


def ramp(count: int, height: int = 32, width: int = 32) -> np.ndarray:
    """Frames that get brighter, so that each can be told from the next."""
    shade = np.linspace(20, 230, count).astype(np.uint8)
    return np.broadcast_to(shade[:, None, None, None], (count, height, width, 3)).copy()


def decoded(data: bytes) -> tuple[np.ndarray, list[float], list[bool]]:
    """Frames, the second at which each is shown, and which of them are key frames."""
    import av

    with av.open(BytesIO(data)) as container:
        found = list(container.decode(video=0))
    return (
        np.stack([f.to_ndarray(format="rgb24") for f in found]),
        [f.time for f in found],
        [f.key_frame for f in found],
    )


def only(monkeypatch: pytest.MonkeyPatch, *modules: str) -> None:
    """Pretend that no other encoder is installed."""
    monkeypatch.setattr(clips, "find_spec", lambda name: find_spec(name) if name in modules else None)
    formats.cache_clear()


@pytest.fixture(autouse=True)
def _look_again() -> Iterator[None]:
    """What is installed is looked up once; tests change it."""
    yield
    formats.cache_clear()


@needs_av
@pytest.mark.parametrize("format", list(VIDEO))
def test_every_frame_is_in_the_video_at_its_time_and_in_order(format: str) -> None:
    frames = ramp(25, 48, 64)
    found, times, keys = decoded(encode(frames, 12.5, format))
    assert found.shape == frames.shape
    assert np.abs(found.astype(int) - frames).mean() < 6
    assert times == pytest.approx([k / 12.5 for k in range(25)], abs=2e-3)
    assert max(np.diff(np.flatnonzero(keys))) <= KEY_FRAMES


@needs_av
@needs_ffmpeg
@pytest.mark.parametrize("format", list(VIDEO))
def test_both_encoders_make_the_same_video(format: str) -> None:
    frames = ramp(12)
    made = [decoded(encoder(frames, Fraction(10), format)) for encoder in (clips._by_pyav, clips._by_ffmpeg)]
    assert np.abs(made[0][0].astype(int) - made[1][0]).mean() < 3
    assert made[0][1] == pytest.approx(made[1][1], abs=2e-3)
    assert max(np.diff(np.flatnonzero(made[1][2]))) <= KEY_FRAMES


@pytest.mark.parametrize("format", CACHED)
@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 33, 21), (7, 240, 241), (2, 3000, 16)])
def test_odd_sizes_and_single_frames_can_be_encoded(format: str, shape: tuple[int, int, int], tmp_path: Path) -> None:
    path = tmp_path / f"x.{format}"
    path.write_bytes(encode(np.zeros((*shape, 3), np.uint8), 100 / 3, format))
    assert whole(path)


@needs_av
def test_padding_repeats_the_edge() -> None:
    found, _, _ = decoded(encode(np.full((2, 31, 31, 3), 200, np.uint8), 10, "mp4"))
    assert found.shape == (2, 32, 32, 3)
    assert np.abs(found.astype(int) - 200).max() < 6


def test_the_index_of_an_mp4_comes_first() -> None:
    data = encode(ramp(5), 10, "mp4")
    assert data.index(b"moov") < data.index(b"mdat")


@pytest.mark.parametrize(
    ("frames", "fps", "said"),
    [
        (np.zeros((0, 8, 8, 3), np.uint8), 10.0, "one frame or more"),
        (np.zeros((3, 0, 8, 3), np.uint8), 10.0, "one frame or more"),
        (np.zeros((3, 8, 8), np.uint8), 10.0, r"\(T, H, W, 3\)"),
        (np.zeros((3, 8, 8, 3), np.float32), 10.0, "uint8"),
        (np.zeros((1, 8, 5000, 3), np.uint8), 10.0, "too much"),
        (np.broadcast_to(np.uint8(0), (10_000, 400, 400, 3)), 10.0, "frame_size"),
        (np.zeros((1, 8, 8, 3), np.uint8), 0.0, "frames a second"),
        (np.zeros((1, 8, 8, 3), np.uint8), float("nan"), "frames a second"),
    ],
)
def test_what_cannot_be_a_clip_is_refused_and_said(frames: np.ndarray, fps: float, said: str) -> None:
    for format in CACHED:
        with pytest.raises(EncodingError, match=said):
            encode(frames, fps, format)


def test_without_an_encoder_there_are_animated_pictures(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    only(monkeypatch)
    assert formats() == ("webp",)
    with Image.open(BytesIO(encode(ramp(10), 10.0, "webp"))) as picture:
        assert (picture.n_frames, picture.info["loop"]) == (10, 0)  # type: ignore[attr-defined]
    path = write_clip(tmp_path / "clip", [ramp(4), ramp(6)], 10.0)
    assert path.suffix == ".gif"
    with Image.open(path) as picture:
        assert picture.n_frames == 6  # type: ignore[attr-defined]
        assert picture.info["duration"] == 100


@needs_ffmpeg
def test_ffmpeg_alone_is_enough(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    only(monkeypatch, "imageio_ffmpeg")
    assert formats() == ("mp4", "webm")
    path = write_clip(tmp_path / "clip", [ramp(4)], 10.0)
    assert path.suffix == ".mp4"
    assert whole(path)


@needs_ffmpeg
def test_where_one_encoder_fails_the_other_is_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> bytes:
        raise ImportError("libavcodec.so.62 is missing")

    good = clips._by_ffmpeg
    monkeypatch.setattr(clips, "_encoders", lambda: [broken, good])
    assert encode(ramp(3), 10.0, "mp4")[4:8] == b"ftyp"
    monkeypatch.setattr(clips, "_encoders", lambda: [broken])
    with pytest.raises(EncodingError, match=r"libavcodec\.so\.62 is missing.*pip install"):
        encode(ramp(3), 10.0, "mp4")


@needs_ffmpeg
def test_an_ffmpeg_that_fails_is_quoted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(VIDEO, "mp4", ("no-such-codec", {}))
    monkeypatch.setattr(clips, "_encoders", lambda: [clips._by_ffmpeg])
    with pytest.raises(EncodingError, match="ffmpeg ended with"):
        encode(ramp(3), 10.0, "mp4")


@needs_ffmpeg
def test_an_ffmpeg_that_hangs_is_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    def hang(*_: object, timeout: float, **__: object) -> object:
        raise subprocess.TimeoutExpired("ffmpeg", timeout)

    monkeypatch.setattr(subprocess, "run", hang)
    monkeypatch.setattr(clips, "_encoders", lambda: [clips._by_ffmpeg])
    with pytest.raises(EncodingError, match="timed out"):
        encode(ramp(3), 10.0, "mp4")


def test_pictures_are_shown_for_20_ms_or_more_and_end_on_time() -> None:
    with Image.open(BytesIO(encode(ramp(60), 125.0, "webp"))) as picture:
        count = picture.n_frames  # type: ignore[attr-defined]
        shown = []
        for k in range(count):
            picture.seek(k)
            picture.load()
            shown.append(picture.info["duration"])
    assert count == 20
    assert min(shown) >= 20
    assert sum(shown) == pytest.approx(60 / 125 * 1000, abs=1)


@pytest.mark.parametrize("format", CACHED)
def test_a_torn_file_is_told_from_a_whole_one(format: str, tmp_path: Path) -> None:
    path = tmp_path / f"x.{format}"
    data = encode(ramp(20, 64, 64), 10.0, format)
    path.write_bytes(data)
    assert whole(path)
    for torn in (data[:-1], data[: len(data) // 2], data[:9], b"", data + b"\0", bytes(len(data)), b"\xff" * 400):
        path.write_bytes(torn)
        assert not whole(path)


def test_a_box_that_claims_no_length_does_not_go_round_in_circles(tmp_path: Path) -> None:
    path = tmp_path / "x.mp4"
    path.write_bytes(struct.pack(">I4sI4s", 8, b"ftyp", 0, b"free"))
    assert not whole(path)


def test_what_is_no_clip_is_not_whole(tmp_path: Path) -> None:
    assert not whole(tmp_path / "missing.mp4")
    assert not whole(tmp_path)
    (tmp_path / "x.html").write_text("<script>")
    assert not whole(tmp_path / "x.html")
