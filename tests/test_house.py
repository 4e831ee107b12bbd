"""The shape of the house: no circle of imports, lazy and TYPE_CHECKING ones included, and few files at the root."""

from __future__ import annotations

import ast
import os
import re
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def modules() -> dict[str, Path]:
    """Name -> file, of everything in the package, also behind its links."""
    found = {}
    for folder, _, files in os.walk(ROOT / "prefrl", followlinks=True):
        for path in (Path(folder) / name for name in files if name.endswith(".py")):
            name = ".".join(path.relative_to(ROOT).with_suffix("").parts)
            found[name.removesuffix(".__init__")] = path
    return found


def imported(path: Path, known: dict[str, Path]) -> Iterator[str]:
    """What a file imports of the package, wherever in it the import stands."""
    for node in ast.walk(ast.parse(path.read_text("utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names if alias.name in known)
        elif isinstance(node, ast.ImportFrom) and node.module in known:
            inner = (f"{node.module}.{alias.name}" for alias in node.names)
            yield from (name if name in known else str(node.module) for name in inner)


def test_no_imports_go_in_a_circle() -> None:
    known = modules()
    assert len(known) > 100
    graph = {name: set(imported(path, known)) - {name} for name, path in known.items()}
    try:
        TopologicalSorter(graph).prepare()
    except CycleError as error:
        pytest.fail(" -> ".join(reversed(error.args[1])))


def test_nothing_that_computes_names_a_device() -> None:
    """Tensors are made where the policy or the reward model is; `prefrl/seeding.py` alone says where that is."""
    rooms = ("fit", "policies", "improve", "reward_models")
    files = [path for room in rooms for path in (ROOT / "prefrl" / room).glob("*.py")]
    assert len(files) > 30
    named = re.compile(r"""["'](cpu|cuda)|\.(cpu|cuda)\(\)|\.numpy\(\)""")
    found = [f"{path.parent.name}/{path.name}" for path in files if named.search(path.read_text("utf-8"))]
    assert found == []


def test_few_files_lie_flat_at_the_root_of_the_package() -> None:
    assert len(list((ROOT / "prefrl").glob("*.py"))) <= 16
