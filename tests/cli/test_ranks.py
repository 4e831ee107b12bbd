"""A run on several processes, as it is started from a shell: what it comes to, and how it ends."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from runs import TINY, finish, tiny

from prefrl import distributed
from prefrl.components import ConfigError
from prefrl.config import Config
from prefrl.rundir import Run
from prefrl.store import Store

TORCHRUN = ("-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m")
ROUNDS, EQUAL_ROUNDS = "loop.rounds=8", 4
SETTINGS = ("text/toy", *TINY["text/toy"], ROUNDS)
BODIES = (
    *TINY["control/toy"], ROUNDS, "task.kind=control", "task.env=InvertedPendulum-v5", "task.horizon=20",
    "task.frame_size=16", "learner.environments=5",
)  # fmt: skip
slow = pytest.mark.slow
WITHIN = 10.0
"""Seconds in which all ranks end once one has."""


def started(*arguments: str, by: tuple[str, ...] = ("-m",), log: Path | None = None) -> subprocess.Popen[bytes]:
    with (log or Path(os.devnull)).open("wb") as out:
        return subprocess.Popen([sys.executable, *by, "prefrl", *arguments], stdout=out, stderr=subprocess.STDOUT)


def rows(folder: Path) -> list[dict[str, float]]:
    path = folder / "metrics.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def weights(folder: Path) -> bytes:
    """Of the newest checkpoint."""
    newest = max((folder / "checkpoints").iterdir())
    return b"".join((newest / f"{part}.safetensors").read_bytes() for part in ("learner", "reward"))


@pytest.fixture(scope="module")
def on_two(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("two") / "run"
    assert started("run", *SETTINGS, "--ranks", "2", "--out", str(folder)).wait() == 0
    return folder


@slow
def test_two_ranks_ask_and_count_what_one_does(on_two: Path, tmp_path: Path) -> None:
    finish(tiny("text/toy", ROUNDS), alone := tmp_path / "one")
    # Sooner or later rounding decides about a token, and the runs part (docs/ranks.md).
    begun = list(zip(rows(alone), rows(on_two), strict=True))[:EQUAL_ROUNDS]
    asked = int(begun[-1][0]["label/asked"])  # until then
    with Store[Any](alone, write=False) as a, Store[Any](on_two, write=False) as b:
        assert [one.query.id for one in a.judged()][:asked] == [one.query.id for one in b.judged()][:asked] != []
    for one, two in begun:
        counted = [name for name in one if name.startswith(("steps/", "label/"))]
        assert len(counted) >= 5
        assert {name: one[name] for name in counted} == {name: two[name] for name in counted}
        assert two["evaluate/kl"] == pytest.approx(one["evaluate/kl"], abs=1e-4)


@pytest.mark.nightly
def test_torchrun_starts_the_same(on_two: Path, tmp_path: Path) -> None:
    assert started("run", *SETTINGS, "--out", str(tmp_path / "run"), by=TORCHRUN).wait() == 0
    assert weights(tmp_path / "run") == weights(on_two)


@slow
@pytest.mark.parametrize("killed", ["first", "other"])
def test_where_one_rank_is_killed_all_end_and_the_run_goes_on_to_the_same_bytes(
    killed: str, on_two: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "run"
    first = started("run", *SETTINGS, "--ranks", "2", "--out", str(folder))
    while not rows(folder):
        assert first.poll() is None
        time.sleep(0.02)
    (other,) = children(first.pid)
    os.kill(first.pid if killed == "first" else other, signal.SIGKILL)
    begin = time.monotonic()
    assert first.wait(WITHIN) != 0
    while alive(other):
        assert time.monotonic() - begin < WITHIN
        time.sleep(0.02)
    assert len(rows(folder)) < len(rows(on_two))
    assert started("resume", str(folder), "--ranks", "2").wait() == 0
    assert weights(folder) == weights(on_two)


@slow
def test_ctrl_c_stops_all_ranks_and_says_how_to_go_on(tmp_path: Path, heard: None) -> None:
    folder, log = tmp_path / "run", tmp_path / "log"
    first = started("run", *SETTINGS, "--ranks", "2", "--out", str(folder), log=log)
    while not rows(folder):
        assert first.poll() is None
        time.sleep(0.02)
    (other,) = children(first.pid)
    first.send_signal(signal.SIGINT)
    assert first.wait(WITHIN) == 130
    assert f"prefrl resume {folder}" in log.read_text()
    assert "Traceback" not in log.read_text()
    begin = time.monotonic()
    while alive(other):
        assert time.monotonic() - begin < WITHIN
        time.sleep(0.02)


@slow
def test_a_run_of_control_that_lost_a_rank_ends_on_one_in_the_bytes_of_one_that_had_no_other(tmp_path: Path) -> None:
    folder, alone = tmp_path / "run", tmp_path / "alone"
    first = started("run", "control/toy", *BODIES, "--ranks", "2", "--out", str(folder))
    while len(rows(folder)) < 3:
        assert first.poll() is None
        time.sleep(0.02)
    (other,) = children(first.pid)
    os.kill(other, signal.SIGKILL)
    assert first.wait(WITHIN) != 0
    finish(Config.load("control/toy", BODIES), alone)
    assert len(rows(folder)) < len(rows(alone))
    finish(Config.load("control/toy", BODIES), folder)
    assert weights(folder) == weights(alone)
    for one, two in zip(rows(alone), rows(folder), strict=True):
        timed = {name for name in one if name.startswith("seconds/")}
        assert {k: v for k, v in one.items() if k not in timed} == {k: v for k, v in two.items() if k not in timed}
    with Store[Any](alone, write=False) as a, Store[Any](folder, write=False) as b:
        assert [one.query.id for one in a.judged()] == [one.query.id for one in b.judged()] != []


@slow
def test_on_two_ranks_a_run_goes_on_where_nothing_new_was_said(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    first = started("run", "control/toy", *BODIES, "loop.first_share=1", "--ranks", "2", "--out", str(folder))
    while len(rows(folder)) < 3:
        assert first.poll() is None
        time.sleep(0.02)
    first.kill()
    assert first.wait(WITHIN) != 0
    assert len(rows(folder)) < 9
    assert started("resume", str(folder), "--ranks", "2").wait() == 0
    assert [row.get("fit/snapshot") is not None for row in rows(folder)] == [False, True, *[False] * 7]


@slow
def test_what_ranks_cannot_share_is_refused_in_one_line(tmp_path: Path) -> None:
    few = ("control/toy", "learner.environments=1", "--ranks", "2", "--out", str(tmp_path / "run"))
    assert started("run", *few, log=tmp_path / "log").wait() == 2
    (line,) = (tmp_path / "log").read_text().splitlines()
    assert line == (
        "error: 2 ranks share the environments of a learner, and learner.environments is 1: "
        "raise it, or start fewer ranks"
    )


def test_learners_that_ranks_cannot_share_are_refused_by_name_before_anything_is_asked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(distributed, "_joined", distributed.World(0, 2))
    config = Config.parse({"task": {"kind": "point"}, "reward": {"kind": "mlp"}, "learner": {"kind": "sb3"}})
    with pytest.raises(ConfigError, match="2 ranks can share the learner SB3 on text alone"):
        Run(config, tmp_path / "run")
    with Store[Any](tmp_path / "run", write=False) as store:
        assert store.counts()["asked"] == 0


def children(pid: int) -> list[int]:
    """The other ranks, which a first one started."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((folder / "stat").read_text().rpartition(")")[2].split()[1])
            command = (folder / "cmdline").read_bytes()
        except OSError:  # it has ended meanwhile
            continue
        if parent == pid and b"prefrl" in command:
            found.append(int(folder.name))
    return found


def alive(pid: int) -> bool:
    """Also false for one that has ended, and that nobody has asked about yet."""
    try:
        return (Path("/proc") / str(pid) / "stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False
