import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from prefrl.exchange.ports import export, import_judgements
from prefrl.judgements import Comparison
from prefrl.store import Store
from prefrl.types import Query, Segment

pytest.importorskip("minari")


@pytest.fixture
def folder(store: Store[Segment], make_query: Callable[..., Query[Segment]], tmp_path: Path) -> Path:
    """A data set of two episodes with one answer."""
    store.ask([query := make_query()])
    store.answer([Comparison(query.id, 1.0, "ann")])
    export(store, tmp_path / "set", "minari")
    return tmp_path / "set"


def refused(folder: Path, message: str) -> None:
    with Store[Segment](folder.parent / "copy") as copy:
        with pytest.raises(ValueError, match=message):
            import_judgements(folder, copy)
        assert copy.sequence == 0


def test_an_environment_that_a_data_set_names_is_never_made(folder: Path) -> None:
    metadata = json.loads((folder / "metadata.json").read_text())
    spec = {"id": "x-v0", "entry_point": "os:abort", "kwargs": {}}
    changed = {name: value for name, value in metadata.items() if not name.endswith("_space")}
    (folder / "metadata.json").write_text(json.dumps(changed | {"env_spec": json.dumps(spec)}))
    refused(folder, "observations and actions are each a Box")


@pytest.mark.parametrize("text", ["[]", "{", '{"observation_space": "3", "action_space": "[]"}'])
def test_metadata_of_something_else_is_refused(folder: Path, text: str) -> None:
    (folder / "metadata.json").write_text(text)
    refused(folder, "metadata.json is no JSON|each a Box")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"episodes": [0, 7]}, "row 1: expected the number of an episode, from 0 to 1, got 7"),
        ({"episodes": [0, 0]}, "row 1: a query may not compare a candidate with itself"),
        ({"episodes": 3}, "row 1: expected .episodes.: list"),
        ({"preference": 2}, "row 1: a preference must lie in"),
    ],
)
def test_labels_that_fit_no_episodes_are_named_with_their_row(
    folder: Path, change: dict[str, Any], message: str
) -> None:
    row = json.loads((folder / "labels.jsonl").read_text())
    (folder / "labels.jsonl").write_text(json.dumps(row | change))
    refused(folder, message)
