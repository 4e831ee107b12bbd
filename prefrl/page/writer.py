"""The one thread that writes for the server: what waits together is written together, and answered after the commit."""

from __future__ import annotations

import logging
import queue
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from dataclasses import dataclass, field
from typing import Any, TypeVar

from sqlalchemy.exc import OperationalError

from prefrl.storage.log import EventLog, StoreFull, Transaction

T = TypeVar("T")
TOGETHER = 256
"""Jobs in one transaction at most."""
WAITING = 4096
"""Jobs that may wait; with more, the disk is so far behind that it is kinder to say no."""
log = logging.getLogger(__name__)


class Unavailable(RuntimeError):
    """Nothing was written, and it is worth trying again."""


def _nothing(*_: object) -> None:
    """No one needs to know."""


@dataclass
class _Job:
    """What is done inside the transaction, and who hears of the outcome, in the writer's thread."""

    run: Callable[[Transaction], Any]
    done: Callable[[Any], None]
    failed: Callable[[], None]
    future: Future[Any] = field(default_factory=Future)
    result: Any = None
    error: Exception | None = None


class Writer:
    """Group commit: `submit` a job, and its future is resolved once what it wrote is on disk.

    A job that raises fails alone. A transaction that fails takes its jobs with it, and the thread goes on.
    """

    def __init__(self, events: EventLog) -> None:
        self._log = events
        self._queue: queue.Queue[_Job | None] = queue.Queue(WAITING)
        self._gate = threading.Lock()
        self._closed = False
        self.trouble = ""
        """What went wrong with the last transaction; "" after a good one."""
        self._thread = threading.Thread(target=self._work, name="prefrl-writer", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def close(self) -> None:
        """Take no more jobs, write those that wait, and end."""
        # Behind the gate nobody can slip a job in after the None that ends the thread.
        with self._gate:
            self._closed = True
        if self._thread.is_alive():
            self._queue.put(None)
            self._thread.join()
        self._give_up()

    @property
    def alive(self) -> bool:
        """Whether jobs are being taken."""
        return self._thread.is_alive() and not self._closed

    @property
    def waiting(self) -> int:
        """How many jobs wait, about."""
        return self._queue.qsize()

    def submit(
        self,
        run: Callable[[Transaction], T],
        done: Callable[[T], None] = _nothing,
        failed: Callable[[], None] = _nothing,
    ) -> Future[T]:
        """Have `run` called inside a transaction.

        `done` hears of the result once it is on disk, `failed` that nothing was written; both in the order of the
        commits, before the future is resolved. The future raises what `run` raised, `StoreFull`, or `Unavailable`.
        """
        job = _Job(run, done, failed)
        with self._gate:
            if not self.alive:
                _fail(job, Unavailable("answers cannot be stored just now: try again in a moment"))
                return job.future
            try:
                self._queue.put_nowait(job)  # never put(): the event loop must not wait here
            except queue.Full:
                _fail(job, Unavailable("too many answers wait to be stored: try again in a moment"))
        return job.future

    def _work(self) -> None:
        jobs: list[_Job] = []
        try:
            while jobs := self._take():
                self._write(jobs)
        finally:  # whatever ends this thread, nobody waits for ever
            with self._gate:
                self._closed = True
            for job in jobs:
                if not job.future.done():
                    _fail(job, Unavailable("the server stopped before this was stored: try again in a moment"))
            self._give_up()

    def _take(self) -> list[_Job]:
        """All that waits, up to a limit; none at the end."""
        jobs = [self._queue.get()]
        while jobs[-1] is not None and len(jobs) < TOGETHER:
            try:
                jobs.append(self._queue.get_nowait())
            except queue.Empty:
                break
        if jobs[-1] is None and len(jobs) > 1:
            self._queue.put(None)  # seen again after these
        return [job for job in jobs if job is not None]

    def _write(self, jobs: Sequence[_Job]) -> None:
        jobs = [job for job in jobs if _begin(job)]
        try:
            with self._log.transaction() as at:
                for job in jobs:
                    _attempt(job, at)
        except StoreFull as error:
            self._lose(jobs, error, str(error))
        except Exception as error:
            log.error("a transaction failed: %s", type(error).__name__)
            trouble = f"the store could not be written to ({type(error).__name__})"
            self._lose(jobs, Unavailable("this could not be stored: try again in a moment"), trouble)
        else:
            self.trouble = ""
            for job in jobs:
                self._settle(job)

    def _lose(self, jobs: Sequence[_Job], error: Exception, trouble: str) -> None:
        """Nothing of a transaction was written."""
        self.trouble = trouble
        for job in jobs:
            _fail(job, error)

    def _settle(self, job: _Job) -> None:
        """Tell how a job went, now that what it wrote is on disk."""
        if job.error is not None:
            _fail(job, job.error)
            return
        try:
            job.done(job.result)
        except Exception as error:
            log.exception("a stored answer was not taken note of")
            self.trouble = f"a stored answer was not taken note of ({type(error).__name__})"
        job.future.set_result(job.result)

    def _give_up(self) -> None:
        """Fail what still waits."""
        while True:
            try:
                job = self._queue.get_nowait()
            except queue.Empty:
                return
            if job is not None:
                _fail(job, Unavailable("the server is closing: try again in a moment"))


def _begin(job: _Job) -> bool:
    """Whether a job is still wanted; once it has begun, it cannot be called off."""
    wanted = job.future.set_running_or_notify_cancel()
    if not wanted:
        job.failed()
    return wanted


def _attempt(job: _Job, at: Transaction) -> None:
    try:
        with at.savepoint():  # what one job wrote before it failed is undone, and the others stand
            job.result = job.run(at)
    except (StoreFull, OperationalError):  # the database may have undone everything: there is no going on
        raise
    except Exception as error:
        job.error = error


def _fail(job: _Job, error: Exception) -> None:
    if not job.future.done():
        job.failed()
        job.future.set_exception(error)
