"""What was made in another world is pointed out, and not refused."""

from pathlib import Path

import pytest

from prefrl import Config
from prefrl.rundir import Run
from prefrl.stages import label
from prefrl.storage.files import write_file

LABELS = ["labeler.kind=expert", "labeler.episodes=1", "select.kind=uniform", "select.candidates=1", "loop.labels=0"]
SHORT = ["task.horizon=20", "task.segment_steps=5", "task.segment_seconds=null"]


def demonstrated(folder: Path, *overrides: str) -> Path:
    label(Config.load("control/pendulum", [*LABELS, *SHORT, *overrides]), folder)
    return folder


def clone(folder: Path, *overrides: str) -> Config:
    settings = ["learner.kind=clone", f"learner.data={folder}", "loop.labels=0", *overrides]
    return Config.load("control/pendulum", settings)


def test_demonstrations_of_another_world_are_pointed_out_and_other_lengths_are_not(tmp_path: Path) -> None:
    alike, other = demonstrated(tmp_path / "alike"), demonstrated(tmp_path / "other", "task.options={g: 1.62}")
    assert clone(alike).notes() == []
    (note,) = clone(other).notes()
    assert note.startswith(f"learner.data: {other} is of another world (task.options.g is 1.62 there, not set here)")
    with Run(clone(other), tmp_path / "run") as run:
        assert note in run.notes
    told: list[str] = []
    beside = Config.load("control/pendulum", [*LABELS, f"learner.clone.data={other}", "learner.clone.epochs=1"])
    label(beside, tmp_path / "labels", tell=told.append)
    assert told == [note.replace("learner.data", "learner.clone.data")]


@pytest.mark.parametrize("text", ["[]", "task: 3", "task: {kind: nobody}", "{", "task: {kind: control, hue: 1}"])
def test_settings_that_cannot_be_read_tell_nothing(tmp_path: Path, text: str) -> None:
    write_file(tmp_path / "config.yaml", text.encode())
    assert clone(tmp_path).notes() == []
