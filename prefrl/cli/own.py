"""Code of one's own, named in the command: files and modules that bring environments or kinds.

A config file cannot name code, so one from a stranger cannot run any.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence


def load(names: Iterable[str]) -> None:
    """Import modules by name, and Python files by path, and what the process that started this one had loaded."""
    names = list(names)
    if names or "PREFRL_PLUGINS" in os.environ:  # else --help would load what it does not need
        from prefrl.components import load_plugins

        load_plugins(names)


def by_name(overrides: Sequence[str]) -> list[str]:
    """`task.env=module:Id` imports the module, and leaves the id alone, which is what is saved."""
    said = []
    for override in overrides:
        key, _, value = override.partition("=")
        module, colon, env = value.partition(":")
        if key == "task.env" and colon:
            load([module])
            override = f"{key}={env}"
        said.append(override)
    return said
