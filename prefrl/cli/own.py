"""Code of one's own, named in the command: files and modules that bring environments or kinds.

A config file names no code, so that one from elsewhere runs nothing.
"""

from __future__ import annotations

import importlib
import importlib.util
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

LOADED: list[str] = []
"""What was loaded, in order; processes that this one starts are to load it too."""


def load(names: Iterable[str]) -> None:
    """Import modules by name, and Python files by path. Raises `ConfigError` for what is not there."""
    for name in names:
        if name not in LOADED:
            _load_file(Path(name).resolve()) if name.endswith(".py") else _load_module(name)
            LOADED.append(name)


def _load_file(path: Path) -> None:
    spec = importlib.util.spec_from_file_location(path.stem, path) if path.is_file() else None
    if spec is None or spec.loader is None:
        raise _error(f"{path}: no such Python file")
    if path.stem in sys.modules:
        raise _error(f"{path}: a module {path.stem!r} is loaded already; give the file another name")
    module = importlib.util.module_from_spec(spec)
    sys.modules[path.stem] = module
    spec.loader.exec_module(module)


def _load_module(name: str) -> None:
    try:
        importlib.import_module(name)
    except ModuleNotFoundError as error:
        if error.name and not name.startswith(error.name):
            raise  # something that the module itself needs
        raise _error(f"{name}: no such module; a file is named with its .py") from None


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


def options() -> list[str]:
    """What a command needs so that another process knows the same."""
    return [word for name in LOADED for word in ("--plugin", name)]


def _error(text: str) -> ValueError:
    from prefrl.components import ConfigError

    return ConfigError(text)
