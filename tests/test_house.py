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


def test_each_file_of_tests_has_a_name_of_its_own() -> None:
    """Without packages pytest can import one of a name, and where both are collected the other is an error."""
    names = [path.name for path in (ROOT / "tests").rglob("test_*.py")]
    assert sorted(names) == sorted(set(names))


def test_few_files_lie_flat_at_the_root_of_the_package() -> None:
    assert len(list((ROOT / "prefrl").glob("*.py"))) <= 16


# --- kinds ------------------------------------------------------------------------------------------------------------

ROWS = {"SEGMENTS", "RESPONSES", "PICTURES"}
"""In the table of `prefrl.kinds`."""
CANDIDATES = {"Segment", "Response", "Picture", *ROWS}
NAMES = {"control", "text", "pictures", "segment", "response", "picture"}
"""What they are called in settings, summaries and the log."""
JUDGEMENTS = {"Comparison", "Ranking", "Choice", "Rating", "Skip"}
EVENTS = {"comparison", "ranking", "choice", "rating"}


def named(node: ast.AST) -> set[str]:
    """The last part of every name within a piece of code."""
    parts = ast.walk(node)
    return {p.id if isinstance(p, ast.Name) else p.attr for p in parts if isinstance(p, ast.Name | ast.Attribute)}


def deciding(node: ast.AST) -> list[ast.AST]:
    """The parts of a node that decide by them: the classes of `isinstance`, a pattern, both sides of a comparison, the
    keys of a table, what `type()` is compared with."""
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in ("isinstance", "issubclass"):
        return [*node.args[1:]]
    if isinstance(node, ast.MatchClass):
        return [node.cls]
    if isinstance(node, ast.MatchValue):
        return [node.value]
    if isinstance(node, ast.Compare):
        return [node.left, *node.comparators]
    if isinstance(node, ast.Dict):
        return [key for key in node.keys if key is not None]
    return []


def constants(nodes: list[ast.AST]) -> set[str]:
    """Words that stand there by themselves, or in a tuple, list or set of words."""
    flat = [x for node in nodes for x in (node.elts if isinstance(node, ast.Tuple | ast.List | ast.Set) else [node])]
    return {x.value for x in flat if isinstance(x, ast.Constant) and isinstance(x.value, str)}


def branches(tree: ast.AST, classes: set[str], words: set[str]) -> bool:
    """Whether code does one thing or another by a class, or by a word that stands for one beside a `kind` or `type`."""
    for node in ast.walk(tree):
        parts = deciding(node)
        if any(named(part) & classes for part in parts) or (isinstance(node, ast.Name) and node.id in ROWS & classes):
            return True
        if isinstance(node, ast.Match) and _is_kind(node.subject) and constants([*map(_value, node.cases)]) & words:
            return True
        if isinstance(node, ast.Dict) and len(found := constants(parts)) > 1 and found <= words:
            return True
        if isinstance(node, ast.Compare) and constants(parts) & words and any(_is_kind(part) for part in parts):
            return True
        if isinstance(node, ast.Subscript) and ast.unparse(node.value) == "Literal" and named(node) == {"Literal"}:
            kinds = constants([node.slice])
            if len(kinds) > 1 and kinds <= words:
                return True
    return False


def _value(case: ast.match_case) -> ast.AST:
    return case.pattern.value if isinstance(case.pattern, ast.MatchValue) else case.pattern


def _is_kind(node: ast.AST) -> bool:
    """`task.kind`, `kind`, `summary["kind"]`, `body["type"]`, `summary.get("kind")`."""
    word = ast.unparse(node)
    return word.endswith((".kind", "['kind']", "['type']", "get('kind')", "get('type')")) or word in ("kind", "type")


def files_that_branch(classes: set[str], words: set[str]) -> list[str]:
    trees = {name: ast.parse(path.read_text("utf-8")) for name, path in modules().items()}
    return sorted(name for name, tree in trees.items() if branches(tree, classes, words))


def test_few_files_branch_on_the_kind_of_candidate() -> None:
    """A file branches on the kind of candidate where it decides by the class of one, or by the name of a kind: in an
    `isinstance`, a pattern, a comparison, the keys of a table, or a `Literal` that lists them; and where it names the
    row of one kind at all.

    The table's own file counts too. What does not count: asking the row for a value (`kind.shows == "clip"` holds for
    any kind that says so), `prefrl.kinds.only`, and `control` and `text` of `prefrl.protocols`, through which code that
    is at home in one kind refuses all others without doing anything else for them. Of templates and scripts of the page
    nothing is counted.
    """
    found = files_that_branch(CANDIDATES, NAMES)
    assert len(found) <= 5, found


def test_few_files_branch_on_the_kind_of_judgement() -> None:
    """As for candidates: by the class of an answer, or by the kind of its event.

    What does not count: making one, and whether there is a judgement at all (`reason`), which every answer says. A
    setting that lists them counts.
    """
    found = files_that_branch(JUDGEMENTS, EVENTS)
    assert len(found) <= 8, found


@pytest.mark.parametrize(
    ("code", "branching"),
    [
        ("isinstance(x, Segment)", True),
        ("isinstance(x, (str, types.Response))", True),
        ("type(x) is Segment", True),
        ("match x:\n    case Response(text=text): pass", True),
        ("match task.kind:\n    case 'text': pass", True),
        ("task.kind == 'text'", True),
        ("body['type'] != 'response'", True),
        ("summary.get('kind') in ('control', 'text')", True),
        ("kind_of(x) is SEGMENTS", True),
        ("find(name) or SEGMENTS", True),
        ("{Segment: 1, Response: 2}[type(x)]", True),
        ("{'control': 1, 'text': 2}[kind]", True),
        ("x: Literal['control', 'text']", True),
        ("x: Literal['text'] = 'text'", False),
        ("settings.by == 'text'", False),
        ("kind_of(x).shows == 'clip'", False),
        ("control(task, 'a learner')", False),
        ("def f(x: Segment) -> Response: return Response('p', 't')", False),
    ],
)
def test_what_counts_as_a_branch(code: str, branching: bool) -> None:
    assert branches(ast.parse(code), CANDIDATES, NAMES) == branching
