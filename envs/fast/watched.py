"""Environments at fault: those that raise, change their form, give numbers that are none, or do not come back."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Timer

from prefrl.components import resume_command

TIMED_OUT = 124
"""The exit status of a process whose environment hung; that of `timeout`."""


class EnvironmentFault(ValueError):
    """An environment is at fault. The message names it and the step of its episode."""


@contextmanager
def guarded(where: str, seconds: float | None) -> Iterator[None]:
    """Raise `EnvironmentFault` for whatever an environment raises meanwhile.

    Where that takes more than `seconds`, the process ends at once with status 124 and a line on stderr: what hangs in
    an environment's own code cannot be interrupted. Code that never lets go of Python's lock is not noticed.
    """
    # A thread for each call, about 0.1 ms: nobody has to tell an old one that its environments are gone.
    timer = None if seconds is None else Timer(seconds, _give_up, (where, seconds))
    if timer is not None:
        timer.daemon = True
        timer.start()
    try:
        yield
    except Exception as error:  # an environment may raise anything
        raise EnvironmentFault(f"{where} raised {type(error).__name__}: {error}") from error
    finally:
        if timer is not None:
            timer.cancel()


def _give_up(where: str, seconds: float) -> None:
    sys.stderr.write(
        f"error: {where} has not come back within {seconds:g} seconds (task.step_seconds). Finished rounds are in the "
        f"run's folder: go on with {resume_command(Path('FOLDER'))}\n"
    )
    sys.stderr.flush()
    os._exit(TIMED_OUT)  # sys.exit would end this thread alone


__all__ = ["EnvironmentFault", "TIMED_OUT", "guarded"]
