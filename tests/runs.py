"""Runs that tests share, and settings with which one of their own costs little."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from filelock import FileLock

from prefrl.config import Config
from prefrl.rundir import Run

if TYPE_CHECKING:
    from prefrl.envs.text import Reviews

SHARED = "PREFRL_TESTS_SHARED"
TINY = {
    "control/toy": (
        "loop.rounds=3", "loop.labels=24", "learner.steps_per_round=400", "fitting.epochs=2",
    ),
    "text/toy": (
        "loop.labels=8", "learner.updates=1", "learner.evaluation_prompts=4", "fitting.epochs=1",
    ),
    "pictures/digits": (
        "task.denoiser.steps=4", "task.denoiser.width=32", "task.denoiser.layers=1", "task.denoiser.batches=300",
        "loop.rounds=2", "loop.labels=16", "learner.updates=1", "learner.pictures=16", "learner.evaluation_pictures=8",
        "fitting.epochs=2",
    ),
}  # fmt: skip
"""Enough of each toy preset that every stage has something to do in every round, and no more."""


def tiny(name: str, *overrides: str) -> Config:
    """A toy preset that takes a tenth of the time, and says nothing about what is learned."""
    return Config.load(name, (*TINY[name], *overrides))


def finish(config: Config, folder: Path) -> None:
    """Run it to its end, or go on there."""
    with Run(config, folder) as run:
        list(run)


def made_once(factory: pytest.TempPathFactory, name: str, make: Callable[[Path], None]) -> Path:
    """A folder that the first process in need of it makes for all that run these tests. It is to be read alone.

    `.ci/in_memory --shared` names a place for what several runs of pytest share, one after another.
    """
    base = factory.getbasetemp()
    root = Path(os.environ.get(SHARED) or (base.parent if "PYTEST_XDIST_WORKER" in os.environ else base))
    folder = root / f"shared-{name}"
    with FileLock(root / f"shared-{name}.lock"):
        if not folder.exists():
            work = root / f"making-{name}"
            make(work)
            work.rename(folder)
    return folder


def copied(run: Path, folder: Path) -> Path:
    shutil.copytree(run, folder)
    return folder


def small_reviews(cache: Path) -> Reviews:
    """The text task with a tiny starting policy, which is kept in that folder once it was cloned."""
    from prefrl.envs.text import ReviewsSettings
    from prefrl.policies.cloning import CloningSettings

    cloning = CloningSettings(layers=1, width=32, heads=2, vocabulary=1000, reviews=2400, batch_size=16, cache=cache)
    return ReviewsSettings(response_tokens=24, cloning=cloning).build()


def exit_code(program: str, *arguments: str) -> int:
    """Run a program in a process of its own; less than 0 names the signal that ended it.

    The process is forked from one that has imported what a run needs, which takes longer than a tiny run. That one
    has no threads, and has computed nothing: it can be forked.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(["prefrl.rundir", "torch.utils.tensorboard", "prefrl.envs.text", "transformers"])
    process = context.Process(target=_execute, args=(program, arguments))
    process.start()
    process.join()
    assert process.exitcode is not None
    return process.exitcode


def _execute(program: str, arguments: tuple[str, ...]) -> None:
    sys.argv = ["-c", *arguments]
    exec(compile(program, "<program>", "exec"), {"__name__": "__main__"})
