"""A server's clips with a drawer that does as it is told, for tests of what happens around the drawing."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeAlias

from prefrl.page.clips.queue import Clips, ClipSettings

FAKE = Path(__file__).parent / "page" / "clips" / "fake_drawer.py"
CONFIG = "task: {kind: point, segment_steps: 5, frame_size: 33}\n"
BYTES = 25
"""Of a clip by the fake drawer."""
Start: TypeAlias = Callable[..., Clips]


def candidate(number: int) -> str:
    return f"{number:04x}" * 16


def prepare(folder: Path) -> Path:
    """Make a folder that of a run with ten candidates, as far as clips are concerned."""
    (folder / "config.yaml").write_text(CONFIG)
    for id in map(candidate, range(10)):
        (folder / "blobs" / id[:2]).mkdir(parents=True, exist_ok=True)
        (folder / "blobs" / id[:2] / f"{id}.safetensors").touch()
    return folder


@contextmanager
def starting(folder: Path) -> Iterator[Start]:
    """Starts servers' clips with the fake drawer; all are closed in the end."""
    opened: list[Clips] = []

    def begin(orders: dict[int, list[str]] | None = None, begun: bool = True, **settings: float) -> Clips:
        said = {candidate(number)[:4]: what for number, what in (orders or {}).items()}
        (folder / "orders.json").write_text(json.dumps(said))
        chosen = ClipSettings.model_validate({"limit_seconds": 20, "first_limit_seconds": 20} | settings)
        opened.append(Clips(folder, chosen, [sys.executable, str(FAKE), str(folder)]))
        if begun:
            opened[-1].start()
        return opened[-1]

    try:
        yield begin
    finally:
        for one in opened:
            one.close()


def name(clips: Clips, number: int, format: int = 0) -> str:
    return clips.names(candidate(number))[format].removeprefix("/media/")


def get(clips: Clips, number: int, wait: float = 20.0) -> Path:
    return asyncio.run(clips.get(name(clips, number), wait))


def attempts(folder: Path) -> list[int]:
    """The candidates that the drawer was asked for, in order."""
    path = folder / "attempts"
    return [int(line.split()[0], 16) for line in path.read_text().splitlines()] if path.exists() else []


def processes(folder: Path) -> list[int]:
    return [int(line.split()[1]) for line in (folder / "attempts").read_text().splitlines()]


def until(condition: Callable[[], bool], seconds: float = 40.0) -> None:
    """Wait for something; fails where it does not come to pass, on a machine that does other things too."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not come to pass"
        time.sleep(0.01)


def alive(pid: int) -> bool:
    """Zombies do not count: where nobody collects orphans, they stay."""
    said = subprocess.run(["ps", "-o", "stat=", "-p", str(pid)], capture_output=True, text=True, check=False).stdout
    return said.strip()[:1] not in ("", "Z")
