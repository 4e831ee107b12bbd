"""Frames become files that browsers play."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from prefrl.page.clips import encode as clips
from prefrl.page.clips.encode import KEY_FRAMES, VIDEO, EncodingError, encode, formats, write_clip

needs_av = pytest.mark.skipif(find_spec("av") is None, reason="no PyAV")
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


@pytest.mark.parametrize("format", CACHED)
@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 33, 21), (7, 240, 241), (2, 3000, 16)])
def test_odd_sizes_and_single_frames_can_be_encoded(format: str, shape: tuple[int, int, int]) -> None:
    data = encode(np.zeros((*shape, 3), np.uint8), 100 / 3, format)
    if format == "webp":
        with Image.open(BytesIO(data)) as picture:
            assert picture.size == (shape[2], shape[1])
    else:
        assert decoded(data)[0].shape == (shape[0], shape[1] + shape[1] % 2, shape[2] + shape[2] % 2, 3)


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


def test_an_encoder_that_fails_is_quoted(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> bytes:
        raise ImportError("libavcodec.so.62 is missing")

    monkeypatch.setattr(clips, "_video", broken)
    with pytest.raises(EncodingError, match=r"libavcodec\.so\.62 is missing.*pip install"):
        encode(ramp(3), 10.0, "mp4")
