"""What is exact about a run is measured, and kept round by round."""

import json
from pathlib import Path

import pytest

from prefrl import Config, Run


def test_a_run_on_a_grid_keeps_its_regret_and_its_maps(tmp_path: Path) -> None:
    small = ["loop.rounds=2", "loop.labels=20", "learner.steps_per_round=1600", "loop.pool=2"]
    with Run(Config.load("control/gridworld", small), tmp_path / "run") as run:
        for _ in run:
            pass
    found = json.loads((tmp_path / "run" / "exact.json").read_text())
    regrets = [one["regret"] for one in found["rounds"]]
    assert [one["round"] for one in found["rounds"]] == [0, 1, 2]
    assert regrets[-1] < regrets[0] <= 1
    assert sum(found["visits"]) == pytest.approx(1)
    assert sorted(set(found["gold"])) == [-1, 0, 1]
    assert len(found["learned"]) == len(found["cells"]) == 21
    assert {tuple(move) for move in found["moves"]} <= {(-1, 0), (0, 1), (1, 0), (0, -1)}
