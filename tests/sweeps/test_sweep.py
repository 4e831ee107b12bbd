"""Many runs as one folder: which ones, what is started, what is kept."""

import _thread
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import pytest
import yaml

from prefrl import Config
from prefrl.components import ConfigError
from prefrl.rundir import RunError, finished
from prefrl.storage.engines import disown, own, owned
from prefrl.sweeps.drive import Ended, Sweep
from prefrl.sweeps.launch import Job, Launcher, Local, Ray, Submitit, _called, launcher
from prefrl.sweeps.plan import Member, SweepPlan

SMALL = ("loop.rounds=1", "loop.labels=20", "learner.steps_per_round=640", "learner.evaluation_episodes=2")


def leave(folder: Path) -> None:
    """What a sweep looks for in the folder of a finished run."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "config.yaml").write_text(Config.load("control/toy").dump())
    (folder / "summary.json").write_text('{"rounds": 99}')
    (folder / "report.html").write_text("")


class Pretend:
    """Leaves what a finished run leaves, or fails."""

    def __init__(self, failing: str = "") -> None:
        self.called: list[str] = []
        self.failing, self.lock = failing, threading.Lock()

    def call(self, job: Job) -> int:
        with self.lock:
            self.called.append(job.member.name)
        if job.member.name == self.failing:
            return 2
        leave(job.folder)
        return 0

    def stop(self) -> None:
        pass


def test_a_plan_is_every_preset_with_every_value_for_every_seed() -> None:
    grid = {"learner.rollback": (None, 0.1), "learner.learning_rate": (1e-3, 0.003)}
    plan = SweepPlan(presets=("control/toy",), seeds=2, first=100, set=SMALL, grid=grid)
    members = plan.members()
    assert len(members) == 8
    assert members[3].name == "control-toy,learner.rollback=null,learner.learning_rate=0.003/seed-101"
    assert members[3].overrides == (*SMALL, "learner.rollback=null", "learner.learning_rate=0.003", "seed=101")


def test_a_mistake_in_any_run_is_told_before_one_is_started(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"learner\.learnin_rate: unknown setting; did you mean"):
        Sweep(SweepPlan(presets=("control/toy",), grid={"learner.learnin_rate": (1, 2)}), tmp_path / "sweep")
    assert not (tmp_path / "sweep").exists()
    file = tmp_path / "sweep.yaml"
    file.write_text("presets: [control/toy]\nseed: 3\n")
    with pytest.raises(ConfigError, match=r"sweep\.yaml, line 2: seed: unknown setting; did you mean 'seeds'"):
        SweepPlan.load(file)
    file.write_text("presets: [")
    with pytest.raises(ConfigError, match="not valid YAML"):
        SweepPlan.load(file)
    with pytest.raises(ValueError, match="set it with `first` and `seeds`"):
        SweepPlan(presets=("control/toy",), grid={"seed": (1, 2)})
    with pytest.raises(ConfigError, match="cannot ask people"):
        SweepPlan(presets=("control/toy",), set=("labeler.kind=web",)).members()
    with pytest.raises(ConfigError, match="listed twice"):
        SweepPlan(presets=("control/toy", "control/toy")).members()
    with pytest.raises(ConfigError, match="unknown launcher 'slurn'"):
        launcher("slurn", tmp_path)


def test_what_is_finished_is_not_run_again_and_what_failed_is(tmp_path: Path) -> None:
    plan = SweepPlan(presets=("control/toy",), seeds=3)
    first, again = Pretend(failing="control-toy/seed-1"), Pretend()
    ended = list(Sweep(plan, tmp_path).run(first, 2))
    assert sorted((e.folder.name, e.status) for e in ended) == [("seed-0", 0), ("seed-1", 2), ("seed-2", 0)]
    sweep = Sweep(plan, tmp_path)
    assert [job.folder.name for job in sweep.jobs] == ["seed-1"]
    list(sweep.run(again, 2))
    assert again.called == ["control-toy/seed-1"]


def test_a_folder_may_get_more_runs_but_no_others(tmp_path: Path) -> None:
    list(Sweep(SweepPlan(presets=("control/toy",), seeds=2), tmp_path).run(Pretend(failing="control-toy/seed-0"), 1))
    assert len(Sweep(SweepPlan(presets=("control/toy",), seeds=4), tmp_path).jobs) == 3
    with pytest.raises(RunError, match="other runs"):
        Sweep(SweepPlan(presets=("control/toy",), seeds=4, set=("loop.rounds=2",)), tmp_path)
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "config.yaml").write_text("")
    with pytest.raises(RunError, match="holds a single run"):
        Sweep(SweepPlan(presets=("control/toy",)), tmp_path / "run")


def test_a_run_that_another_process_is_at_is_waited_for(tmp_path: Path) -> None:
    plan, pretend = SweepPlan(presets=("control/toy",), seeds=1), Pretend()
    sweep = Sweep(plan, tmp_path)
    lock = own(sweep.jobs[0].folder)
    assert owned(sweep.jobs[0].folder)
    thread = threading.Thread(target=lambda: list(sweep.run(pretend, 1)))
    thread.start()
    time.sleep(0.3)
    assert not pretend.called
    with pytest.raises(RunError, match="another process runs the sweep"):
        list(Sweep(plan, tmp_path).run(pretend, 1))
    leave(sweep.jobs[0].folder)
    disown(sweep.folder / sweep.members[0].name, lock)
    thread.join(10)
    assert not pretend.called


@pytest.mark.slow
def test_a_sweep_that_is_killed_ends_in_the_same_digits_wherever_its_runs_are_started(tmp_path: Path) -> None:
    plan = SweepPlan(presets=("control/toy",), seeds=1, set=SMALL)
    whole = Sweep(plan, tmp_path / "whole")
    assert [ended.status for ended in whole.run(Local(), 1)] == [0]
    file = tmp_path / "plan.yaml"
    file.write_text(yaml.safe_dump(plan.model_dump(mode="json")))
    command = [sys.executable, "-m", "prefrl", "sweep", str(file), "--out", str(tmp_path / "killed")]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL) as driver:
        deadline = time.monotonic() + 60
        while not list((tmp_path / "killed").rglob("owner.lock")) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert list((tmp_path / "killed").rglob("owner.lock"))
        os.kill(driver.pid, signal.SIGKILL)
    killed = Sweep(plan, tmp_path / "killed")
    assert all(ended.status == 0 for ended in killed.run(Local(), 1))
    sent = Sweep(plan, tmp_path / "sent")
    assert [ended.status for ended in sent.run(Submitit(tmp_path / "jobs"), 1)] == [0]
    tasks = Sweep(plan, tmp_path / "tasks")
    ray = Ray()
    assert ray.call(Job(Member("no", "no\0preset", ()), tmp_path / "no", tmp_path / "no.log")) == 1
    assert "embedded null byte" in (tmp_path / "no.log").read_text()
    assert [ended.status for ended in tasks.run(ray, 1)] == [0]
    for member in whole.members:
        rows = [
            [line for line in (folder / member.name / "metrics.jsonl").read_text().split(",") if "seconds" not in line]
            for folder in (whole.folder, killed.folder, sent.folder, tasks.folder)
        ]
        assert rows[0] == rows[1] == rows[2] == rows[3]
        assert finished(killed.folder / member.name)


STUBBORN = """
import signal, time
def stop(*_):
    time.sleep(1.5)
    print("in good order", flush=True)
    raise SystemExit(1)
signal.signal(signal.SIGINT, stop)
print("begun", flush=True)
time.sleep(60)
"""


@pytest.mark.usefixtures("heard")
def test_a_run_on_a_node_ends_in_good_order_though_it_is_stopped_twice(tmp_path: Path) -> None:
    log = tmp_path / "log"

    def interrupt() -> None:
        while not log.exists() or not log.read_text():
            time.sleep(0.02)
        _thread.interrupt_main()
        time.sleep(0.4)  # the first is seen within 0.2 seconds, and the run takes 1.5 to end
        if "order" not in log.read_text():  # else it would be for whoever runs the tests
            _thread.interrupt_main()

    twice = threading.Thread(target=interrupt)
    twice.start()
    with pytest.raises(KeyboardInterrupt):
        _called([sys.executable, "-c", STUBBORN], str(log), str(tmp_path))
    twice.join()
    assert log.read_text().split("\n")[1:2] == ["in good order"]


@pytest.mark.slow
@pytest.mark.usefixtures("heard")
@pytest.mark.parametrize("place", [Local, Ray])
def test_ctrl_c_stops_the_runs_in_good_order(place: Callable[[], Launcher], tmp_path: Path) -> None:
    sweep = Sweep(SweepPlan(presets=("control/toy",), seeds=1, set=("loop.rounds=50",)), tmp_path)
    started = place()
    ended: list[Ended] = []
    thread = threading.Thread(target=lambda: ended.extend(sweep.run(started, 1)))
    thread.start()
    folder = tmp_path / "control-toy" / "seed-0"
    deadline = time.monotonic() + 60
    while not list(folder.glob("checkpoints/*")) and time.monotonic() < deadline:
        time.sleep(0.05)
    started.stop()
    thread.join(60)
    assert [bool(e.status) for e in ended] == [True]
    assert "Go on with: prefrl resume" in ended[0].log.read_text()
    assert not owned(folder)
