import json
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from prefrl import Config
from prefrl.checkpoints import load_state
from prefrl.rundir import Run, RunError, open_saved
from prefrl.store import Store

TOYS = ["control/toy", "text/toy"]
SUMMARY = {
    "task", "kind", "seed", "rounds", "gold_before", "gold_after", "gold_best", "labels", "steps", "reward_accuracy",
    "kl", "fluency_before", "fluency_after", "seconds", "versions",
}  # fmt: skip


def finish(name: str, folder: Path, *overrides: str) -> None:
    with Run(Config.load(name, overrides), folder) as run:
        for _ in run:
            pass


def weights(folder: Path) -> dict[str, bytes]:
    """The files that hold what was learned, of the last checkpoint."""
    last = max((folder / "checkpoints").iterdir())
    return {p.name: p.read_bytes() for p in sorted(last.glob("*.safetensors"))}


def numbers(folder: Path) -> list[dict[str, float]]:
    """The metrics without the times."""
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [{k: v for k, v in row.items() if not k.startswith("seconds/")} for row in rows]


@pytest.mark.parametrize("name", TOYS)
def test_a_run_leaves_the_files_that_the_design_names(name: str, tmp_path: Path) -> None:
    folder, config = tmp_path / "run", Config.load(name)
    with Run(config, folder) as run:
        assert [r.number for r in run] == list(range(config.loop.rounds + 1))
        run.report()
    found = {p.name for p in folder.iterdir()}
    assert found >= {"config.yaml", "metrics.jsonl", "summary.json", "store.db", "report.html", "checkpoints", "gold"}
    assert any("tfevents" in f for f in found)
    assert ("blobs" in found) == name.startswith("control")
    summary = json.loads((folder / "summary.json").read_text())
    assert set(summary) == SUMMARY
    assert set(summary["seconds"]) == {"sample", "label", "fit", "improve", "evaluate", "total"}
    assert summary["labels"]["answered"] == summary["labels"]["asked"] > 0
    assert len(list((folder / "checkpoints").iterdir())) == 2


@pytest.mark.parametrize("name", TOYS)
def test_a_run_stopped_between_rounds_ends_in_the_same_bytes(name: str, tmp_path: Path) -> None:
    finish(name, tmp_path / "whole")
    with Run(Config.load(name), tmp_path / "parts") as run:
        rounds = iter(run)
        next(rounds), next(rounds)
    with Run.resume(tmp_path / "parts") as run:
        assert run.notes == ["going on after round 1"]
        assert [r.number for r in run] == list(range(2, run.config.loop.rounds + 1))
    assert weights(tmp_path / "parts") == weights(tmp_path / "whole")
    assert numbers(tmp_path / "parts") == numbers(tmp_path / "whole")


@pytest.mark.parametrize("name", TOYS)
def test_a_run_killed_at_any_moment_ends_in_the_same_bytes(name: str, tmp_path: Path) -> None:
    finish(name, tmp_path / "whole")
    code = (
        "import sys, torch; torch.set_num_threads(1); from prefrl import Config; from prefrl.rundir import Run\n"
        "with Run(Config.load(sys.argv[1]), sys.argv[2]) as run:\n"
        "    for r in run: print(r.number, flush=True)"
    )
    for wait in (0.3, 0.7):  # after the first line: in the middle of a round, wherever that is
        child = subprocess.Popen(
            [sys.executable, "-c", code, name, str(tmp_path / "killed")], stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        with child:
            assert child.stdout is not None
            child.stdout.readline()
            time.sleep(wait)
            child.send_signal(signal.SIGKILL)
    finish(name, tmp_path / "killed")
    assert weights(tmp_path / "killed") == weights(tmp_path / "whole")
    assert numbers(tmp_path / "killed") == numbers(tmp_path / "whole")
    with Store(tmp_path / "killed", write=False) as killed, Store(tmp_path / "whole", write=False) as whole:
        assert killed.answers() == whole.answers()


def test_a_damaged_checkpoint_is_passed_over_and_named(tmp_path: Path) -> None:
    finish("control/toy", tmp_path / "run")
    finish("control/toy", tmp_path / "whole")
    broken = max((tmp_path / "run/checkpoints").iterdir()) / "learner.safetensors"
    broken.write_bytes(broken.read_bytes()[:-1])
    with Run.resume(tmp_path / "run") as run:
        assert "learner.safetensors" in run.notes[0]
        assert run.notes[1] == f"going on after round {run.config.loop.rounds - 1}"
        list(run)
    assert weights(tmp_path / "run") == weights(tmp_path / "whole")


def test_no_good_checkpoint_is_an_error_that_says_why(tmp_path: Path) -> None:
    finish("control/toy", tmp_path / "run")
    for manifest in (tmp_path / "run/checkpoints").rglob("MANIFEST.json"):
        manifest.unlink()
    with pytest.raises(RunError, match="no checkpoint that can be used"):
        Run.resume(tmp_path / "run")
    with Store(tmp_path / "run"):
        """The failed attempt let go of the store."""


def test_a_finished_run_is_left_as_it_is(tmp_path: Path) -> None:
    finish("control/toy", tmp_path / "run")
    before = weights(tmp_path / "run")
    finish("control/toy", tmp_path / "run")
    assert weights(tmp_path / "run") == before
    assert len(numbers(tmp_path / "run")) == Config.load("control/toy").loop.rounds + 1


def test_a_folder_with_another_run_or_other_things_is_refused(tmp_path: Path) -> None:
    finish("control/toy", tmp_path / "run")
    with pytest.raises(RunError, match=r"fitting\.epochs is 60 there, 6 here"):
        Run(Config.load("control/toy", ["fitting.epochs=6"]), tmp_path / "run")
    (tmp_path / "things").mkdir()
    (tmp_path / "things/letter.txt").write_text("dear")
    with pytest.raises(RunError, match="not empty"):
        Run(Config.load("control/toy"), tmp_path / "things")
    with pytest.raises(RunError, match=r"expected a file config\.yaml"):
        Run.resume(tmp_path / "nothing")


def test_a_checkpoint_holds_all_that_is_needed_to_use_it(tmp_path: Path) -> None:
    finish("control/toy", tmp_path / "run")
    shutil.copytree(max((tmp_path / "run/checkpoints").iterdir()), tmp_path / "alone")
    saved = open_saved(tmp_path / "alone")
    assert saved.config == Config.load("control/toy")
    assert load_state(saved.folder, "learner")["steps"][0] > 0
