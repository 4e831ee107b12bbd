"""Benchmarks that tests run, shortened, for what they find besides speed."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


def measured(name: str, *options: str, seconds: float) -> dict[str, Any]:
    """What a benchmark found: its last line."""
    program = [sys.executable, str(BENCHMARKS / f"{name}.py"), *options]
    done = subprocess.run(program, capture_output=True, text=True, timeout=seconds, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found
