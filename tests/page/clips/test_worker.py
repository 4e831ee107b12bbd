"""The process that draws clips: one line in, one line out, and a file."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from prefrl.envs.control import ControlSettings
from prefrl.envs.render import graphics
from prefrl.envs.toys import ToyTask
from prefrl.page.clips.encode import formats
from prefrl.page.clips.worker import Artist, JobError, _lasting, _sentence
from prefrl.storage.engines import StoreError
from prefrl.store import Store
from prefrl.types import Query, Response, Segment

CONFIG = "task:\n  kind: point\n  segment_steps: 5\n  frame_size: 33\n"
IMPORTS = """
import os, sys, time
from prefrl.page.clips import worker
from prefrl.envs.toys import ToyTask
"""
FILE = f"{'ab' * 32}.{formats()[0]}"
SOON = 40.0
"""Seconds in which a process must have ended, on a machine that does other things too; nothing drawn takes as long."""


def point_segment(number: int, states: bool = True) -> Segment:
    where = np.random.default_rng(number).uniform(-1, 1, (5, 2))
    zeros = np.zeros((5, 2), np.float32)
    return Segment(where.astype(np.float32), zeros, f"e{number}", 0, where if states else None)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A run's folder with two segments, the second without states."""
    (tmp_path / "config.yaml").write_text(CONFIG)
    with Store[Segment](tmp_path) as store:
        store.ask([Query((point_segment(0), point_segment(1, states=False)))])
    return tmp_path


class Child:
    """A running `python -m prefrl.page.clips.worker`."""

    def __init__(self, folder: Path, code: str = "") -> None:
        start = ["-m", "prefrl.page.clips.worker"] if not code else ["-c", f"{code}\nworker.main(sys.argv[1])"]
        pipe = subprocess.PIPE
        self.process = subprocess.Popen(
            [sys.executable, *start, str(folder)], stdin=pipe, stdout=pipe, stderr=pipe, text=True
        )

    def send(self, candidate: str, file: str = FILE, limit: float = 60.0) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(json.dumps({"candidate": candidate, "file": file, "limit": limit}) + "\n")
        self.process.stdin.flush()

    def receive(self) -> dict[str, Any]:
        assert self.process.stdout is not None
        return dict(json.loads(self.process.stdout.readline()))

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()


@pytest.fixture
def start(folder: Path) -> Iterator[Callable[..., Child]]:
    """Starts children; none outlives the test."""
    children: list[Child] = []

    def begin(body: str = "") -> Child:
        """With `body`, the frames of the toy task are made by these lines."""
        children.append(Child(folder, IMPORTS + body if body else ""))
        return children[-1]

    yield begin
    for child in children:
        child.close()


def test_a_clip_is_drawn_and_the_reply_says_how_large_it_is(folder: Path, start: Callable[..., Child]) -> None:
    child = start()
    child.send(point_segment(0).id)
    path = folder / "clips" / "ab" / FILE
    assert child.receive() == {"file": FILE, "bytes": path.stat().st_size}
    assert path.read_bytes()[4:8] == b"ftyp"
    child.send("0" * 64)
    assert "holds no candidate" in child.receive()["error"]  # and it still works
    child.send(point_segment(0).id)
    assert "bytes" in child.receive()


def test_what_libraries_print_is_kept_from_the_replies(start: Callable[..., Child]) -> None:
    child = start(
        "drawn = ToyTask.frames\n"
        "def frames(task, segment):\n"
        "    print('hello'); os.write(1, b'from C\\n'); os.system('echo from a child')\n"
        "    assert sys.stdin.read() == ''\n"
        "    return drawn(task, segment)\n"
        "ToyTask.frames = frames"
    )
    child.send(point_segment(0).id)
    assert set(child.receive()) == {"file", "bytes"}


def test_the_end_of_the_input_ends_it_even_while_it_draws(start: Callable[..., Child]) -> None:
    child = start("def frames(task, segment):\n    os.write(2, b'drawing\\n'); time.sleep(60)\nToyTask.frames = frames")
    child.send(point_segment(0).id)
    assert child.process.stdin is not None
    assert child.process.stderr is not None
    assert child.process.stderr.readline() == "drawing\n"
    child.process.stdin.close()
    child.process.stdin = None
    assert child.process.wait(SOON) == 0


def test_a_hang_that_nobody_ends_ends_itself_and_says_where(start: Callable[..., Child]) -> None:
    child = start("worker.GRACE = 0.1\ndef frames(task, segment):\n    time.sleep(60)\nToyTask.frames = frames")
    child.send(point_segment(0).id, limit=0.5)
    assert child.process.wait(SOON) == 1
    _, errors = child.process.communicate()
    assert "in frames" in errors


def test_an_unforeseen_error_is_one_sentence_for_people_and_a_trace_for_the_log(start: Callable[..., Child]) -> None:
    child = start("def frames(task, segment):\n    return {}['wheel']\nToyTask.frames = frames")
    child.send(point_segment(0).id)
    assert child.receive() == {"file": FILE, "error": "KeyError: 'wheel'", "lasting": False}
    _, errors = child.process.communicate(timeout=SOON)
    assert "Traceback" in errors


def test_a_segment_without_states_says_so(folder: Path) -> None:
    with pytest.raises(ValueError, match="drawn from its simulator states"):
        Artist(folder).draw(point_segment(1, states=False).id, FILE)


def test_a_task_that_gives_no_frames_says_so(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ToyTask, "frames", lambda task, segment: np.zeros((0, 8, 8, 3), np.uint8))
    with pytest.raises(ValueError, match="nothing to show"):
        Artist(folder).draw(point_segment(0).id, FILE)


@pytest.mark.parametrize("name", ["x.mp4", "../" + FILE, FILE.upper(), FILE + "\n", "ab" * 32 + ".html", "/" + FILE])
def test_only_names_of_clips_become_files(folder: Path, name: str) -> None:
    with pytest.raises(JobError, match="64 hex digits"):
        Artist(folder).draw(point_segment(0).id, name)


def test_a_linked_folder_is_not_written_through(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> None:
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    (folder / "clips").mkdir()
    (folder / "clips" / "ab").symlink_to(elsewhere)
    with pytest.raises(JobError, match="is a link"):
        Artist(folder).draw(point_segment(0).id, FILE)
    assert not list(elsewhere.iterdir())


def test_a_linked_file_is_replaced_and_what_it_led_to_is_left(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine")
    (folder / "clips" / "ab").mkdir(parents=True)
    (folder / "clips" / "ab" / FILE).symlink_to(tmp_path / "mine.txt")
    Artist(folder).draw(point_segment(0).id, FILE)
    assert (tmp_path / "mine.txt").read_text() == "mine"
    assert not (folder / "clips" / "ab" / FILE).is_symlink()


def test_a_folder_without_settings_says_what_is_missing(folder: Path) -> None:
    (folder / "config.yaml").unlink()
    with pytest.raises(JobError, match=r"config\.yaml"):
        Artist(folder).draw(point_segment(0).id, FILE)
    with pytest.raises(StoreError, match="holds no store"):
        Artist(folder / "nowhere").draw(point_segment(0).id, FILE)


def test_a_text_has_no_clip(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text(CONFIG)
    texts = Response("p", "a"), Response("p", "b")
    with Store[Response](tmp_path) as store:
        store.ask([Query(texts)])
    with pytest.raises(JobError, match="a text has no clip"):
        Artist(tmp_path).draw(texts[0].id, FILE)


def test_a_damaged_segment_is_not_drawn(folder: Path) -> None:
    (blob,) = (folder / "blobs").rglob(f"{point_segment(0).id}.safetensors")
    data = bytearray(blob.read_bytes())
    data[-1] ^= 1
    blob.write_bytes(data)
    with pytest.raises(ValueError, match="has changed since it was filed"):
        Artist(folder).draw(point_segment(0).id, FILE)


def test_a_full_disk_leaves_no_file_and_may_pass(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space") as caught:
        Artist(folder).draw(point_segment(0).id, FILE)
    assert not list((folder / "clips").rglob("*.*"))
    assert not _lasting(caught.value)


def test_a_sentence_says_nothing_of_where_the_folder_is(folder: Path) -> None:
    error = OSError(13, "Permission denied", str(folder / "clips" / "x.mp4"))
    assert str(folder) not in _sentence(error, folder)
    assert "\n" not in _sentence(ValueError("one\ntwo"), folder)
    assert len(_sentence(ValueError("x" * 5000), folder)) == 400
    assert _sentence(ValueError(), folder) == "ValueError"


@pytest.mark.skipif(graphics() is None, reason="no OpenGL library (libegl1 libgl1-mesa-dri)")
def test_mujoco_is_drawn_without_any_variable_of_the_environment(tmp_path: Path) -> None:
    (tmp_path / "config.yaml").write_text("task: {kind: control, env: Hopper-v5, segment_steps: 3, frame_size: 64}\n")
    envs = ControlSettings(env="Hopper-v5", segment_steps=3).build().environments(3)
    envs.reset(np.random.default_rng(0))
    segments = [Segment(np.zeros((3, 11)), np.zeros((3, 3)), str(k), 0, envs.states()) for k in range(2)]
    with Store[Segment](tmp_path) as store:
        store.ask([Query(tuple(segments))])
    job = json.dumps({"candidate": segments[0].id, "file": FILE, "limit": 60})
    command = [sys.executable, "-m", "prefrl.page.clips.worker", str(tmp_path)]
    with subprocess.Popen(
        command, stdin=-1, stdout=-1, text=True, env={"PATH": "", "HOME": str(tmp_path)}, stderr=subprocess.DEVNULL
    ) as child:
        assert child.stdin is not None
        assert child.stdout is not None
        child.stdin.write(job + "\n")
        child.stdin.flush()
        assert set(json.loads(child.stdout.readline())) == {"file", "bytes"}
        child.stdin.close()
    assert (tmp_path / "clips" / "ab" / FILE).stat().st_size > 0
