"""A command on several processes: the one that was typed is rank 0, it starts the others, and they follow it."""

from __future__ import annotations

import _thread
import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

import typer

if TYPE_CHECKING:
    from prefrl.loop import Loop
    from prefrl.store import Store
    from prefrl.types import Json

Ranks = Annotated[int, typer.Option(min=1, help="Processes that share the work.")]
MEETING = "PREFRL_MEETING"
"""Names, for a process that was started here, the file in which the ranks meet."""
GRACE = 10.0
"""Seconds in which the others end by themselves once rank 0 is done."""
NOTICED = 3.0
"""Seconds in which rank 0 notices by itself that another has ended, unless it waits for people."""


@contextmanager
def on(ranks: int) -> Iterator[bool]:
    """Whether this process is to do what was asked for, as rank 0 or alone; where it is not, it has followed rank 0.

    Where torchrun started this process, its number of ranks counts.
    """
    from prefrl.distributed import LostRanksError, join, leave

    told = MEETING in os.environ or "TORCHELASTIC_RUN_ID" in os.environ
    with ExitStack() as others:
        rank, size = (int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])) if told else (0, ranks)
        if size > 1:
            join(rank, size, os.environ.get(MEETING, "env://") if told else others.enter_context(_started(size)))
        if rank:
            try:
                _follow()
            except LostRanksError:
                sys.exit(1)  # rank 0 says why, if it can
        yield not rank
        leave()


def _follow() -> None:
    from prefrl.config import Config
    from prefrl.ranks import Elsewhere, follow

    nowhere = cast("Store", None)  # rank 0 has the store and the labeler, and says what came of them

    def build(settings: Json) -> Loop:
        config = Config.model_validate(settings)
        return config.model_copy(update={"labeler": Elsewhere()}).build(nowhere)

    follow(build)


@contextmanager
def _started(size: int) -> Iterator[str]:
    """Run this very command as the other ranks, too; gives the place where all meet."""
    with tempfile.TemporaryDirectory(prefix="prefrl-") as folder:
        meeting = (Path(folder) / "meeting").as_uri()
        threads = {"OMP_NUM_THREADS": str(max((os.cpu_count() or 1) // size, 1))} | os.environ
        place = threads | {MEETING: meeting, "WORLD_SIZE": str(size)}
        others = [
            # A session of their own: Ctrl-C is for rank 0, which stops in good order.
            subprocess.Popen(
                [sys.executable, "-m", "prefrl", *sys.argv[1:]],
                env=place | {"RANK": str(rank), "LOCAL_RANK": str(rank)},
                stdin=subprocess.DEVNULL,
                start_new_session=True,
            )
            for rank in range(1, size)
        ]
        done = threading.Event()
        for rank, other in enumerate(others, 1):
            threading.Thread(target=_watch, args=(rank, other, done), daemon=True).start()
        try:
            yield meeting
            done.set()
            with suppress(subprocess.TimeoutExpired):
                for other in others:
                    other.wait(GRACE)
        finally:
            done.set()
            for other in others:
                other.terminate()
                other.wait()


def _watch(rank: int, process: subprocess.Popen[bytes], done: threading.Event) -> None:
    """Stop rank 0 where another rank ends too early: it may be waiting for people, and would not notice."""
    status = process.wait()
    # What rank 0 hears by itself, or went wrong on all ranks, it says itself.
    if status and not done.wait(NOTICED):
        sys.stderr.write(f"rank {rank} has ended, with status {status}\n")
        _thread.interrupt_main()
