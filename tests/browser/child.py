"""The command line's own server, in a process that can be killed."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeAlias

from playwright.sync_api import Page


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])


class Child:
    """A `prefrl` command that serves the page; `link` is what it prints."""

    def __init__(self, *command: str, log: Path) -> None:
        self.log = log
        with log.open("w") as out:
            self.process = subprocess.Popen(
                [sys.executable, "-m", "prefrl", *command],
                stdout=out,
                stderr=subprocess.STDOUT,
                env=os.environ | {"OMP_NUM_THREADS": "1", "COLUMNS": "200"},
            )

    def link(self, page: Page, seconds: int = 60) -> str:
        """Wait until it is printed. `page` keeps Playwright's events flowing in the meantime."""
        for _ in range(10 * seconds):
            found = [line for line in self.log.read_text().splitlines() if line.startswith("label here: ")]
            if found:
                return found[-1].removeprefix("label here: ").strip()
            assert self.process.poll() is None, self.log.read_text()
            page.wait_for_timeout(100)
        raise AssertionError(f"no link in {seconds} s: {self.log.read_text()}")

    def finish(self, seconds: float = 60) -> int:
        """Wait for its end."""
        return self.process.wait(seconds)

    def kill(self) -> None:
        self.process.kill()
        self.process.wait(10)


Start: TypeAlias = Callable[..., Child]
"""A command, word by word -> what runs it."""


def serve_command(folder: Path, port: int, overrides: Sequence[str] = ()) -> list[str]:
    """On a page without a guideline, which would stand before the first question."""
    return ["label", str(folder), "--serve", "--port", str(port), 'labeler.guideline=""', *overrides]
