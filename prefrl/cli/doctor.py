"""`prefrl doctor`: what is installed, what is missing, and what to do about it."""

from __future__ import annotations

import os
import platform
import sqlite3
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec

from rich.table import Table

from prefrl.cli.console import table
from prefrl.components import EXTRAS

CORE = ("prefrl", "torch", "numpy", "pydantic", "SQLAlchemy", "safetensors")
DISTRIBUTIONS = {"stable_baselines3": "stable-baselines3"}


def diagnose() -> Table:
    """A row for each thing that a run may need."""
    rows = [("Python", f"{platform.python_version()} on {platform.platform()}, {os.cpu_count()} cores", "")]
    rows += [(name, version(name), "") for name in CORE]
    rows += [_optional(module, extra) for module, extra in EXTRAS.items()]
    rows += [_sqlite(), _device(), _graphics()]
    return table("prefrl doctor", ("what", "found", "what to do"), rows)


def _optional(module: str, extra: str) -> tuple[str, str, str]:
    name = DISTRIBUTIONS.get(module, module)
    try:
        return name, version(name), ""
    except PackageNotFoundError:
        return name, "missing", f"pip install 'prefrl[{extra}]'"


def _sqlite() -> tuple[str, str, str]:
    """SQLite before 3.51.3 can damage a WAL when two connections write at once; prefrl lets only one process write."""
    old = sqlite3.sqlite_version_info < (3, 51, 3)
    advice = "never write to store.db with another program while a run goes on" if old else ""
    return "SQLite", sqlite3.sqlite_version, advice


def _device() -> tuple[str, str, str]:
    import torch

    found = torch.cuda.get_device_name(0) if torch.cuda.is_available() else "no GPU"
    return "torch device", f"{found}, {torch.get_num_threads()} CPU threads", ""


def _graphics() -> tuple[str, str, str]:
    """Can MuJoCo's clips be drawn here?"""
    if find_spec("mujoco") is None:
        return "MuJoCo graphics", "not checked", "pip install 'prefrl[control]'"
    from prefrl.envs.render import graphics

    found = graphics()
    return "MuJoCo graphics", found or "none", "" if found else "apt install libegl1 libgl1-mesa-dri"
