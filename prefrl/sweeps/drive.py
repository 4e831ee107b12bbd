"""A sweep in its folder: what is finished stays, what was stopped goes on, and nothing is run twice."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import yaml
from filelock import FileLock, Timeout

from prefrl.rundir import RunError, finished
from prefrl.storage.engines import owned
from prefrl.storage.files import write_file
from prefrl.sweeps.launch import Job, Launcher, each
from prefrl.sweeps.plan import Member, SweepPlan

PLAN = "sweep.yaml"
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

    def __init__(self, plan: SweepPlan, folder: Path, options: Sequence[str] = ()) -> None:
        """`options`: of `prefrl` itself, that come before each command, such as `--plugin my_env.py`.

        Raises `ConfigError` for a wrong setting of any run, and `RunError` for a folder of something else."""
        self.folder, self.members, self._options = folder, plan.members(), tuple(options)
        if (folder / "config.yaml").exists():
            raise RunError(f"{folder} holds a single run: choose another folder")
        there = folder / PLAN
        if there.exists():
            missing = _missing(SweepPlan.load(there).members(), self.members)
            if missing:
                raise RunError(f"{folder} holds a sweep with other runs ({missing[0]}): choose another folder")
        write_file(there, yaml.safe_dump(plan.model_dump(mode="json"), sort_keys=False).encode())

    @property
    def jobs(self) -> list[Job]:
        """What is not finished yet."""
        jobs = [
            Job(member, self.folder / member.name, self.folder / f"{member.name}.log", self._options)
            for member in self.members
        ]
        return [job for job in jobs if not finished(job.folder)]

    def run(self, launcher: Launcher, at_once: int) -> Iterator[Ended]:
        """Run what is not finished, some at once. Raises `RunError` where another process does so."""

        stopped = threading.Event()

        def stop() -> None:
            stopped.set()
            launcher.stop()

        def start(job: Job) -> int:
            # A process of a sweep that was killed may still be at it.
            while owned(job.folder):
                if stopped.wait(PATIENCE):
                    return 130
            job.log.parent.mkdir(parents=True, exist_ok=True)
            return 0 if finished(job.folder) else launcher.call(job)

        lock = FileLock(self.folder / "sweep.lock", timeout=0)
        try:
            lock.acquire()
        except Timeout:
            raise RunError(f"another process runs the sweep in {self.folder}: wait for it, or stop it") from None
        with lock:
            for job, status in each(start, stop, self.jobs, at_once):
                yield Ended(job.folder, status, job.log)


def _missing(before: list[Member], now: list[Member]) -> list[str]:
    there = set(now)
    return [member.name for member in before if member not in there]
