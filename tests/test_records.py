"""The page of results and the records that its tables are made from."""

import json
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest

from prefrl.sweeps.plan import SweepPlan

ROOT = Path(__file__).parent.parent
NAMES = sorted(path.stem for path in (ROOT / "docs/records").glob("*.json"))


@pytest.fixture(scope="module")
def records() -> ModuleType:
    """`docs/records.py`."""
    spec = spec_from_file_location("records", ROOT / "docs/records.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def groups(name: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads((ROOT / f"docs/records/{name}.json").read_text())["groups"]
    return found


def test_the_tables_of_results_are_those_of_the_records(records: ModuleType) -> None:
    page = records.PAGE.read_text()
    assert records.in_step(page) == page, "run: python docs/records.py"
    assert sorted(records.names(page)) == NAMES, "each record has one table"


def test_a_number_that_was_changed_by_hand_is_noticed(records: ModuleType) -> None:
    page = records.PAGE.read_text()
    table = records.BLOCK.search(page)[0]
    changed = page.replace(table, table.replace("**", "**1", 1))
    assert changed != page
    assert records.in_step(changed) == page


@pytest.mark.parametrize("name", NAMES)
def test_a_record_holds_every_run_of_its_sweep_and_no_other(name: str) -> None:
    plan = SweepPlan.load(ROOT / f"benchmarks/sweeps/{name}.yaml")
    planned = {(member.source, member.overrides) for member in plan.members()}
    assert {
        (group["source"], (*group["overrides"], f"seed={run['seed']}"))
        for group in groups(name)
        for run in group["runs"]
    } == planned


@pytest.mark.parametrize("name", NAMES)
def test_a_record_is_of_committed_code_and_says_no_folder_of_a_machine(name: str) -> None:
    for group in groups(name):
        assert group["made_with"]
        assert all(made["commit"] and made["changed"] is False for made in group["made_with"])
        assert not any(Path(run["folder"]).is_absolute() for run in group["runs"])
