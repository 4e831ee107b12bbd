"""Where a run's numbers come from: the code, the libraries, the processor. No name of a machine or person, no path."""

from __future__ import annotations

import os
import platform
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import torch

from prefrl.distributed import world
from prefrl.types import Json

PACKAGES = ("prefrl", "torch", "numpy", "transformers", "gymnasium", "mujoco", "stable-baselines3")
PACKAGE = Path(__file__).parents[1]
PATIENCE = 10.0
"""Seconds that git is given; without an answer the commit is not known."""


def made_with(threads: int | None) -> Json:
    """What this process computes with; None where something is not known. `threads`: None for what torch takes."""
    commit, changed = checkout(PACKAGE)
    return {
        "commit": commit,
        "changed": changed,
        "processor": _processor(),
        "instructions": torch.backends.cpu.get_cpu_capability(),
        "gpu": _gpu(),
        "cores": os.cpu_count(),
        "threads": threads or torch.get_num_threads(),
        "ranks": world().size,
        "versions": _versions(),
    }


def checkout(package: Path) -> tuple[str | None, bool | None]:
    """(commit, whether the package's own files differ from it); None where they are in no git checkout.

    What is outside the package, documents say, changes no result and is not looked at.
    """
    root = package.parent
    if not (root / ".git").exists():
        return None, None
    parts = sorted({package, *(path.resolve() for path in package.iterdir() if path.is_symlink())})
    # The folder by name: within a hook of git the environment says another one.
    command = ["git", "--no-optional-locks", "--git-dir=.git", "--work-tree=.", "status", "--porcelain=v2", "--branch"]
    try:
        done = subprocess.run(
            [*command, "--", *(os.path.relpath(part, root) for part in parts)],
            cwd=root,
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=PATIENCE,
            check=False,
        )
    except (OSError, subprocess.SubprocessError):
        return None, None
    return (None, None) if done.returncode else _read(done.stdout.splitlines(), package.name)


def _read(lines: list[str], package: str) -> tuple[str | None, bool | None]:
    commits = [line.split()[-1] for line in lines if line.startswith("# branch.oid ")]
    if not commits or commits[0].startswith("(") or f"? {package}/" in lines:
        return None, None  # no commit yet, or a checkout of something else in which the package merely lies
    return commits[0], any(not line.startswith("#") for line in lines)


def _processor() -> str | None:
    """The model, as the system names it."""
    if sys.platform == "linux":
        try:
            lines = Path("/proc/cpuinfo").read_text(errors="replace").splitlines()
        except OSError:
            lines = []
        named = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
        if named:
            return named[0]
    return platform.processor() or platform.machine() or None


def _gpu() -> str | None:
    """Only where something computes on it already: asking would start its driver."""
    begun = torch.cuda.is_initialized()  # type: ignore[no-untyped-call]
    return torch.cuda.get_device_name() if begun else None


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
