"""The budget of the tests: what is counted, what is refused, and a list that may only shrink."""

from __future__ import annotations

import os
from pathlib import Path

import budget
import pytest
from budget import FLUSHES, LIMIT, TOTAL, Cost, Meter, flushed, listed, overspent

from prefrl.store import Store
from prefrl.types import Query, Response

AT_MOST = 5
"""Tests that may be listed. This number may only be lowered."""
SAMPLE = """
import os
import subprocess
import sys
import time

import pytest

BURN = "import time\\nwhile time.process_time() < 0.3: pass"

def burn(seconds):
    begin = time.process_time()
    while time.process_time() - begin < seconds:
        pass

@pytest.fixture(scope="module")
def dear():
    burn(0.3)

@pytest.fixture
def own():
    burn(0.3)

def test_shared(dear):
    pass

def test_own(own):
    pass

def test_child():
    subprocess.run([sys.executable, "-c", BURN], check=True)

def test_flushing(tmp_path):
    with (tmp_path / "file").open("wb") as file:
        for _ in range(1001):
            os.fsync(file.fileno())
"""


def test_the_list_of_exempt_tests_only_shrinks() -> None:
    assert len(listed()) <= AT_MOST


def test_a_test_pays_for_its_own_fixtures_and_processes_and_not_for_shared_ones(
    pytester: pytest.Pytester, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("PYTEST_XDIST_WORKER", raising=False)
    monkeypatch.setattr(os, "fsync", lambda handle: None)  # it is counted; nothing has to be written
    pytester.makepyfile(SAMPLE)
    pytester.makeconftest("")
    result = pytester.runpytest_inprocess("-p", "budget", "-p", "no:randomly", "--costs", "costs.txt")
    result.assert_outcomes(passed=4)
    assert result.ret == pytest.ExitCode.TESTS_FAILED
    result.stdout.fnmatch_lines(["OVER BUDGET *test_flushing: 1001 flushes to the disk, at most 1000"])
    rows = [line.split("\t") for line in (pytester.path / "costs.txt").read_text().splitlines()]
    seconds = {test.partition("::")[2]: float(cpu) for cpu, _, test in rows}
    assert seconds["test_shared"] < 0.2
    assert seconds["test_own"] >= 0.3
    assert seconds["test_child"] >= 0.3


def test_commits_that_change_a_database_are_flushes(tmp_path: Path) -> None:
    meter = Meter()
    with meter.counting(), Store[Response](tmp_path) as store:
        before = meter.now().flushes
        store.ask([Query((Response("p", "a"), Response("p", "b")))])
        asked = meter.now().flushes - before
        store.counts()
        assert asked >= 1
        assert meter.now().flushes == before + asked


def test_what_is_over_its_budget_is_named() -> None:
    costs = {"a": Cost(LIMIT + 0.1, FLUSHES), "b": Cost(0.1, FLUSHES + 1), "c": Cost(LIMIT / 4, 0)}
    assert flushed(costs) == [f"b: {FLUSHES + 1} flushes to the disk, at most {FLUSHES}"]
    assert overspent(costs, 0.0, ["a"], 1.0) == []
    assert overspent(costs, 0.0, [], 2.0) == []  # on a slow machine
    assert overspent(costs, 0.0, [], 1.0) == [f"a: {LIMIT + 0.1:.1f} CPU seconds, at most {LIMIT:.1f}"]
    assert overspent(costs, TOTAL, ["a"], 1.0)[-1].startswith("all tests: ")
    for exempt in ("c", "gone"):
        assert f"take it off {budget.LIST.name}" in overspent(costs, 0.0, ["a", exempt], 1.0)[0]
