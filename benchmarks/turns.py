"""Two processes that take turns: each does a piece of work when it is asked to, on one thread."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from typing import Any

ONE_THREAD = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "HF_HUB_OFFLINE": "1", "TOKENIZERS_PARALLELISM": "false"}


def start(command: list[str]) -> subprocess.Popen[str]:
    return subprocess.Popen(
        command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env={**os.environ, **ONE_THREAD}
    )


def ask(worker: subprocess.Popen[str]) -> dict[str, Any]:
    """Have one piece of work done; other lines that a library prints are passed over."""
    assert worker.stdin is not None
    assert worker.stdout is not None
    worker.stdin.write("go\n")
    worker.stdin.flush()
    for line in worker.stdout:
        if line.startswith("RESULT "):
            found: dict[str, Any] = json.loads(line[7:])
            return found
    raise RuntimeError(f"{worker.args!r} ended early")


def wait() -> float:
    """Wait for our turn; the time at which it begins."""
    if not sys.stdin.readline():
        sys.exit()
    return time.process_time()
