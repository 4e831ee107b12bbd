"""Break the product in one place at a time, and see whether the tests notice.

    python tests/mutants/mutate.py [--jobs 2] [--only WORDS] [--seconds 600]

`mutants.yaml` says what to break: for each file the tests that are to notice, and mutants, each with a name that says
what is broken, a text that stands in the file exactly once, and what takes its place. It all happens in copies of the
tree. Ends with status 1 where the tests fail on the whole product, where more than two mutants survive, or where one is
stale: its text is not there once, or its tests could not be run.
"""

from __future__ import annotations

import argparse
import os
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import yaml

ROOT = Path(__file__).resolve().parents[2]
MOST_SURVIVORS = 2
LEFT_OUT = shutil.ignore_patterns(".*", "__pycache__", "*.egg-info", "runs", "build", "dist", "_build")
FAILED = 1
"""pytest's status where a test failed; others above it say that something else went wrong."""
TOO_LONG = -1


@dataclass(frozen=True)
class Mutant:
    """One thing that is wrong."""

    name: str
    file: str
    old: str
    new: str
    tests: tuple[str, ...]


def read() -> list[Mutant]:
    """The mutants of `mutants.yaml`; those of a file share its tests, unless they name others."""
    told = yaml.safe_load((Path(__file__).parent / "mutants.yaml").read_text("utf-8"))
    return [
        Mutant(one["name"], file, one["old"], one["new"], tuple(one.get("tests", part["tests"])))
        for file, part in told.items()
        for one in part["mutants"]
    ]


def mutated(text: str, mutant: Mutant) -> str:
    """A file's text with the mutant in it. Raises `ValueError` where the old text does not stand there once."""
    if (found := text.count(mutant.old)) != 1:
        raise ValueError(f"{mutant.file}: expected {mutant.old!r} once, found it {found} times")
    return text.replace(mutant.old, mutant.new)


def verdict(tree: Path, mutant: Mutant, seconds: float) -> str:
    """killed, survived, or stale with the reason."""
    path = tree / mutant.file
    whole = path.read_text("utf-8")
    try:
        path.write_text(mutated(whole, mutant), "utf-8")
        status = run_tests(tree, mutant.tests, seconds)
    except (OSError, ValueError) as error:
        return f"stale ({error})"
    finally:
        path.write_text(whole, "utf-8")
    if status == FAILED or status < 0:  # a signal also says that it did not go well
        return "killed"
    return "survived" if status == 0 else f"stale (pytest ended with status {status}: were there such tests?)"


def run_tests(tree: Path, tests: Sequence[str], seconds: float, output: int | None = subprocess.DEVNULL) -> int:
    """pytest's status, or TOO_LONG; where `output` is None its words are shown.

    No bytecode is kept: a mutant may have the size and the second of what it was.
    """
    own = {"PYTHONPATH": f"{tree}", "PYTHONDONTWRITEBYTECODE": "1", "OMP_NUM_THREADS": "1"}
    options = ["-x", "-q", "-p", "no:cacheprovider", "--hypothesis-seed=0"]
    with subprocess.Popen(
        [sys.executable, "-m", "pytest", *options, *tests],
        cwd=tree,
        env=os.environ | own,
        stdout=output,
        stderr=subprocess.STDOUT,
        start_new_session=True,
    ) as started:
        try:
            return started.wait(seconds)
        except subprocess.TimeoutExpired:
            os.killpg(started.pid, signal.SIGKILL)
            return TOO_LONG


def main() -> int:
    """Returns the exit status."""
    asked = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    asked.add_argument("--jobs", type=int, default=1, help="how many mutants at a time")
    asked.add_argument("--only", default="", help="those whose name or file holds these words")
    asked.add_argument("--seconds", type=float, default=600.0, help="after which a mutant counts as killed")
    options = asked.parse_args()
    mutants = [one for one in read() if options.only in f"{one.file}: {one.name}"]
    with tempfile.TemporaryDirectory() as made:
        trees: queue.Queue[Path] = queue.Queue()
        for number in range(options.jobs):
            tree = Path(made) / f"{number}"
            shutil.copytree(ROOT, tree, symlinks=True, ignore=LEFT_OUT)
            trees.put(tree)
        if status := run_tests(tree, sorted({test for one in mutants for test in one.tests}), 3600.0, output=None):
            print(f"the tests fail on the whole product, or cannot be run: pytest ended with status {status}")
            return 1

        def tried(mutant: Mutant) -> str:
            tree = trees.get()
            try:
                found = verdict(tree, mutant, options.seconds)
            finally:
                trees.put(tree)
            print(f"{found:<10}{mutant.file}: {mutant.name}", flush=True)
            return found.partition(" ")[0]

        with ThreadPoolExecutor(options.jobs) as pool:
            count = Counter(pool.map(tried, mutants))
    print(f"{len(mutants)} mutants: {', '.join(f'{count[word]} {word}' for word in ('killed', 'survived', 'stale'))}")
    return int(count["survived"] > MOST_SURVIVORS or count["stale"] > 0)


if __name__ == "__main__":
    sys.exit(main())
