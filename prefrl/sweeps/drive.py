"""A sweep in its folder: what is finished stays, what was stopped goes on, and nothing is run twice."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import yaml
from filelock import FileLock, Timeout

from prefrl.rundir import RunError, finished
from prefrl.storage.engines import owned
from prefrl.storage.files import write_file
from prefrl.sweeps.launch import Job, Launcher, each
from prefrl.sweeps.plan import Member, SweepPlan

PLAN = "plan.yaml"
PATIENCE = 1.0
"""Seconds between two looks at a folder that another process writes to."""


class Ended(NamedTuple):
    """A run of a sweep that is over."""

    folder: Path
    status: int
    """The exit status of its command; 0 is well."""
    log: Path


class Sweep:
    """The folder of a sweep. A folder with another plan is refused, unless the plan holds all of its runs."""

    def __init__(self, plan: SweepPlan, folder: Path) -> None:
        """Raises `ConfigError` for a wrong setting of any run, and `RunError` for a folder of something else."""
        self.folder, self.members = folder, plan.members()
        if (folder / "config.yaml").exists():
            raise RunError(f"{folder} holds a single run: choose another folder")
        self._plan = plan
        self._refuse_others()

    def _refuse_others(self) -> None:
        there = self.folder / PLAN
        missing = _missing(SweepPlan.load(there).members(), self.members) if there.exists() else []
        if missing:
            raise RunError(f"{self.folder} holds a sweep with other runs ({missing[0]}): choose another folder")

    def _claim(self) -> None:
        self._refuse_others()
        text = yaml.safe_dump(self._plan.model_dump(mode="json"), sort_keys=False)
        write_file(self.folder / PLAN, text.encode())

    @property
    def jobs(self) -> list[Job]:
        """What is not finished yet."""
        jobs = [Job(member, self.folder / member.name, self.folder / f"{member.name}.log") for member in self.members]
        return [job for job in jobs if not finished(job.folder)]

    def run(self, launcher: Launcher, at_once: int) -> Iterator[Ended]:
        """Run what is not finished, some at once. Raises `RunError` where another process does so."""
        stopped = threading.Event()

        def stop() -> None:
            stopped.set()
            launcher.stop()

        def start(job: Job) -> int:
            job.log.parent.mkdir(parents=True, exist_ok=True)
            while True:
                # A process of a sweep that was killed may still be at it, or get to it while this one starts.
                while owned(job.folder):
                    if stopped.wait(PATIENCE):
                        return 130
                status = 0 if finished(job.folder) else launcher.call(job)
                if not status or not owned(job.folder):
                    return status

        self.folder.mkdir(parents=True, exist_ok=True)
        try:
            held = FileLock(self.folder / "sweep.lock", timeout=0).acquire()
        except Timeout:
            raise RunError(f"another process runs the sweep in {self.folder}: wait for it, or stop it") from None
        with held:
            self._claim()
            for job, status in each(start, stop, self.jobs, at_once):
                yield Ended(job.folder, status, job.log)


def _missing(before: list[Member], now: list[Member]) -> list[str]:
    there = set(now)
    return [member.name for member in before if member not in there]
