"""What is kept of candidates for the report."""

import json
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from prefrl.evaluate.hindsight import read_from
from prefrl.report.examples import GAP, GREY, save_examples, strip
from prefrl.report.records import read
from prefrl.rundir import OF_START, Run, open_saved
from prefrl.types import Response, Segment


@dataclass(frozen=True)
class Drawn:
    """A task that draws grey squares, or cannot."""

    name: str = "squares"
    kind: str = "control"
    fps: float = 20.0
    error: Exception | None = None
    size: int = field(default=40)

    def frames(self, segment: Segment) -> np.ndarray:
        if self.error is not None:
            raise self.error
        shades = np.linspace(0, 255, len(segment)).astype(np.uint8)
        return np.broadcast_to(shades[:, None, None, None], (len(segment), self.size, self.size, 3))


@dataclass(frozen=True)
class Moving(Drawn):
    """One whose steps take time."""

    steps_per_second: float = 20.0


def segment(start: int = 0, gold: float | None = 1.0) -> Segment:
    zeros = np.zeros((30, 2), np.float32)
    return Segment(zeros, zeros, "e", start, gold=None if gold is None else np.full(30, gold))


def test_a_strip_shows_the_first_and_the_last_frame_and_gaps_between() -> None:
    frames = np.arange(11, dtype=np.uint8)[:, None, None, None] * np.ones((1, 4, 5, 3), np.uint8)
    joined = strip(frames, 6)
    assert joined.shape == (4, 6 * 5 + 5 * GAP, 3)
    assert [int(joined[0, i * (5 + GAP), 0]) for i in range(6)] == [0, 2, 4, 6, 8, 10]
    assert (joined[:, 5 : 5 + GAP] == GREY).all()


def test_a_short_clip_repeats_no_frame() -> None:
    assert strip(np.zeros((2, 4, 4, 3), np.uint8)).shape == (4, 8 + GAP, 3)


def test_segments_are_kept_as_strips_that_a_report_can_read(tmp_path: Path) -> None:
    path = save_examples(Moving(size=320), [segment(0), segment(30, None)], np.array([0.5, 2.0]), tmp_path, "before")
    entries = json.loads(path.read_text())
    assert [e["gold"] for e in entries] == [30.0, None]
    assert entries[0]["caption"] == "30 steps, 1.5 s of simulated time, from left to right"
    with Image.open(path.parent / entries[1]["strip"]) as picture:
        assert picture.height == 160
    assert [e.picture[:22] for e in read(tmp_path).before] == ["data:image/png;base64,"] * 2
    with Image.open(path.parent / entries[0]["film"]) as film:
        assert (getattr(film, "n_frames"), film.height) == (15, 160)  # noqa: B009 - every second frame
    assert [e.film[:23] for e in read(tmp_path).before] == ["data:image/webp;base64,"] * 2


def test_of_steps_that_take_no_time_no_seconds_are_told(tmp_path: Path) -> None:
    path = save_examples(Drawn(), [segment()], None, tmp_path, "before")
    assert json.loads(path.read_text())[0]["caption"] == "30 steps, from left to right"


def test_a_renderer_that_fails_leaves_a_caption(tmp_path: Path) -> None:
    task = Drawn(error=ImportError("no GL"))
    path = save_examples(task, [segment()], None, tmp_path, "after")
    caption = "No picture: drawing failed with ImportError: no GL"
    assert json.loads(path.read_text()) == [{"gold": 30.0, "learned": None, "caption": caption}]


def test_texts_are_kept_as_they_are_even_lone_surrogates(tmp_path: Path) -> None:
    wild = Response("p\n", "\ud800 </script> \u202e", gold=np.array([np.nan]))
    path = save_examples(Drawn(kind="text"), [wild], np.array([0.25]), tmp_path, "after")
    assert json.loads(path.read_text()) == [{"gold": None, "learned": 0.25, "prompt": "p\n", "text": wild.text}]
    assert list(path.parent.iterdir()) == [path]


def test_scores_must_match_examples(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="one learned score for each of 1"):
        save_examples(Drawn(), [segment()], np.zeros(2), tmp_path, "after")


@pytest.mark.parametrize("name", ["control/toy", "text/toy"])
def test_examples_of_the_start_are_scored_by_the_newest_reward(
    name: str, finished_tiny: dict[str, Path], tmp_path: Path
) -> None:
    folder = shutil.copytree(finished_tiny[name], tmp_path / "run")
    with Run.resume(folder) as run:
        run.report()
    saved = open_saved(folder)
    start: list[Any] = read_from(folder / OF_START)
    scores = saved.reward(saved.config.build_task()).score(start)
    said = [entry["learned"] for entry in json.loads((folder / "examples" / "before.json").read_text())]
    np.testing.assert_allclose(said, scores, rtol=1e-4, atol=1e-5)
    assert all(one.gold is None for one in start)  # nothing that learns may see it


@pytest.mark.parametrize("said", ["garbage", "[1, 2]", "{}", None])
def test_a_report_is_made_whatever_became_of_the_examples(
    said: str | None, finished_tiny: dict[str, Path], tmp_path: Path
) -> None:
    folder = shutil.copytree(finished_tiny["control/toy"], tmp_path / "run")
    before = folder / "examples" / "before.json"
    if said is None:
        shutil.rmtree(folder / OF_START)
        (folder / OF_START).mkdir()
    else:
        before.write_text(said)
    with Run.resume(folder) as run:
        assert run.report().exists()
    assert said is None or before.read_text() == said
