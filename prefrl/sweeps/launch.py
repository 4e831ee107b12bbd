"""Where the runs of a sweep are started: in processes of this machine, or on a cluster through submitit or Ray.

Each is the command `prefrl run` in a process of its own, with one thread unless `OMP_NUM_THREADS` says otherwise, so
that a run comes to the same result wherever it was started.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import contextmanager
from pathlib import Path
from typing import IO, Any, Generic, NamedTuple, Protocol, TypeVar

from prefrl.components import ConfigError, suggest
from prefrl.sweeps.plan import Member

T = TypeVar("T")
STOPPING = 30.0
"""Seconds that runs are given to stop in good order."""
STOPPED = 130
"""The status of a run that Ctrl-C stopped."""
HOURS = 72
"""The time limit of a cluster job, in hours."""


class Job(NamedTuple):
    """A run to start."""

    member: Member
    folder: Path
    log: Path
    """Takes what the command says."""

    def command(self) -> list[str]:
        run = [sys.executable, "-m", "prefrl", "run"]
        return [*run, self.member.source, *self.member.overrides, "--out", str(self.folder)]


class Launcher(Protocol):
    """A place where commands run."""

    def call(self, job: Job) -> int:
        """Run it to its end, and give its exit status; called from several threads."""

    def stop(self) -> None:
        """Stop what is running; nothing is started any more."""


def launcher(name: str, state: Path) -> Launcher:
    """The launcher of a name; `state` is a folder for what it writes. Raises `ConfigError`."""
    made: dict[str, Callable[[], Launcher]] = {"local": Local, "submitit": lambda: Submitit(state), "ray": Ray}
    if name not in made:
        raise ConfigError(f"unknown launcher {name!r}; {suggest(name, made)}")
    return made[name]()


def each(
    starts: Callable[[Job], int], stop: Callable[[], None], jobs: Sequence[Job], at_once: int
) -> Iterator[tuple[Job, int]]:
    """The jobs with their exit status, as they end. Where the caller is stopped, they are stopped as well."""
    with ThreadPoolExecutor(at_once) as pool:
        waiting: dict[Future[int], Job] = {pool.submit(starts, job): job for job in jobs}
        try:
            for future in as_completed(waiting):
                yield waiting[future], future.result()
        finally:
            pool.shutdown(wait=False, cancel_futures=True)
            stop()


class _UnderWay(Generic[T]):
    """What was begun and is not over, from several threads; once it is stopped, nothing begins any more."""

    def __init__(self) -> None:
        self.there: set[T] = set()
        self.stopped, self._lock = False, threading.Lock()

    def begin(self, start: Callable[[], T]) -> T | None:
        """What `start` gives; None where all is stopped."""
        with self._lock:
            if self.stopped:
                return None
            self.there.add(begun := start())
            return begun

    def stop(self) -> list[T]:
        """What was under way then."""
        with self._lock:
            self.stopped = True
            return list(self.there)


class Local:
    """Processes of this machine."""

    def __init__(self) -> None:
        self._processes: _UnderWay[subprocess.Popen[bytes]] = _UnderWay()

    def call(self, job: Job) -> int:
        with job.log.open("ab") as log:
            process = self._processes.begin(lambda: _started(job.command(), log))
        if process is None:
            return STOPPED
        status = process.wait()
        self._processes.there.discard(process)
        return status

    def stop(self) -> None:
        left = self._processes.stop()
        for process in left:
            process.send_signal(signal.SIGINT)  # to all, before one is waited for
        deadline = time.monotonic() + STOPPING
        for process in left:
            _end(process, deadline)


class Submitit:
    """Jobs of submitit: on Slurm where there is one, else processes of this machine."""

    def __init__(self, state: Path) -> None:
        import submitit

        self._executor = submitit.AutoExecutor(folder=state)
        self._executor.update_parameters(timeout_min=60 * HOURS, name="prefrl", cpus_per_task=1)
        self._jobs: _UnderWay[Any] = _UnderWay()

    def call(self, job: Job) -> int:
        sent = self._jobs.begin(lambda: self._executor.submit(_called, *_told(job)))
        if sent is None:
            return STOPPED
        sent.wait()
        self._jobs.there.discard(sent)
        return int(sent.result()) if sent.exception() is None else 1

    def stop(self) -> None:
        for sent in self._jobs.stop():
            sent.cancel(check=False)


class Ray:
    """Tasks of Ray, one CPU each: on the cluster that `RAY_ADDRESS` names, else on one that is started here.

    Nothing of this process's environment is taken along: nodes have prefrl, and see the folder, as with Slurm. Raises
    `ConfigError` where there is no cluster at that address.
    """

    def __init__(self) -> None:
        import ray

        self._ray = ray
        # Of a cluster that is started here: Ray reports its use by default, and has its workers stand back.
        for name in ("RAY_USAGE_STATS_ENABLED", "RAY_worker_niceness"):
            os.environ.setdefault(name, "0")
        where = os.environ.get("RAY_ADDRESS") or "local"  # else it would join any cluster that was started here
        own: dict[str, Any] = {"include_dashboard": False} if where == "local" else {}
        try:
            ray.init(where, log_to_driver=False, configure_logging=False, **own)
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise ConfigError(f"--launcher ray: there is no cluster at RAY_ADDRESS={where}: {error}") from error
        self._called = ray.remote(num_cpus=1, max_retries=0)(_called)
        self._tasks: _UnderWay[Any] = _UnderWay()

    def call(self, job: Job) -> int:
        sent = self._tasks.begin(lambda: self._called.remote(*_told(job)))
        if sent is None:
            return STOPPED
        try:
            return int(self._ray.get(sent))
        except self._ray.exceptions.RayError as error:  # its node is gone, say: the folder tells how far it came
            if not self._tasks.stopped:
                with job.log.open("a", encoding="utf-8") as log:
                    log.write(f"Ray: {error}\n")
            return 1
        finally:
            self._tasks.there.discard(sent)

    def stop(self) -> None:
        for sent in self._tasks.stop():
            self._ray.cancel(sent)  # raises KeyboardInterrupt there
        deadline = time.monotonic() + 2 * STOPPING
        while self._tasks.there and time.monotonic() < deadline:
            time.sleep(0.05)  # whoever waits for a task would be ended by a shutdown
        self._ray.shutdown()


def _told(job: Job) -> tuple[list[str], str, str]:
    """What `_called` is given."""
    return job.command(), str(job.log.absolute()), str(Path.cwd())


def _called(command: list[str], log: str, place: str) -> int:
    """On a node: run a command in a working directory, to its end, or stop it in good order where this is stopped."""
    with open(log, "ab") as file:
        process = None
        try:
            with _heard():
                process = _started(command, file, place)
            while process.poll() is None:  # Ray interrupts Python alone, and not a call that waits
                time.sleep(0.2)
            return process.returncode
        finally:
            if process is not None:
                signal.signal(signal.SIGINT, signal.SIG_IGN)  # a second interrupt would leave the run behind
                process.send_signal(signal.SIGINT)  # does nothing where it has ended
                _end(process, time.monotonic() + STOPPING)
                signal.signal(signal.SIGINT, signal.default_int_handler)


@contextmanager
def _heard() -> Iterator[None]:
    """What is started meanwhile hears of Ctrl-C: a shell's background ignores it, a worker of Ray blocks it."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    blocked = signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, blocked)


def _started(command: list[str], log: IO[bytes], place: str | None = None) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        command,
        cwd=place,
        env=_environment(),
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=log,
        start_new_session=True,  # Ctrl-C is for this process, which stops the others in good order
    )


def _end(process: subprocess.Popen[bytes], deadline: float) -> None:
    """Wait for a process that was told to stop and leads a group, or else kill it with what it has started."""
    try:
        process.wait(max(deadline - time.monotonic(), 0.0))
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)


def _environment() -> dict[str, str]:
    return {"OMP_NUM_THREADS": "1"} | os.environ
