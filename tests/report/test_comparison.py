"""Runs side by side: which belong together, what they are called, and what is said of them."""

import json
from pathlib import Path
from typing import Any

import pytest
from run_folders import folder_of_run

from prefrl.report.comparison import compare, markdown, write_comparison

Folder = Path


def settings(seed: int, rate: float = 0.1, **learner: Any) -> dict[str, Any]:
    free = {"labeler": {"port": seed}, "track": ["wandb"][:seed]}  # neither makes another group
    return {"seed": seed, "learner": {"kind": "control", "learning_rate": rate, **learner}} | free


@pytest.fixture
def two_rates(tmp_path: Path) -> Path:
    for seed in range(4):
        folder_of_run(tmp_path / "all" / f"slow-{seed}", [-10.0, -8.0, -6.0 - seed], settings(seed, 0.1))
        folder_of_run(tmp_path / "all" / f"fast-{seed}", [-10.0, -5.0, -1.0 - 0.1 * seed], settings(seed, 0.5))
    return tmp_path / "all"


def test_runs_that_differ_in_their_seeds_are_one_group_named_by_what_differs(two_rates: Path) -> None:
    (contest,), left_out = compare([two_rates])
    assert [(group.name, len(group.runs)) for group in contest.groups] == [
        ("learning_rate=0.5", 4),
        ("learning_rate=0.1", 4),
    ]
    assert contest.groups[0].scores.tolist() == [-1.0, -1.1, -1.2, -1.3]
    assert not left_out
    assert contest.improvement(*contest.groups).value == 1.0


def test_who_always_loses_has_no_chance_and_the_page_says_so(two_rates: Path, tmp_path: Path) -> None:
    write_comparison([two_rates], tmp_path / "page.html")
    assert "0.00 (0.00 to 0.00)" in (tmp_path / "page.html").read_text()


def test_a_second_run_with_the_same_settings_and_seed_does_not_count(two_rates: Path) -> None:
    again = folder_of_run(two_rates / "slow-again", [-10.0, -8.0, -6.0], settings(0, 0.1))
    (contest,), others = compare([two_rates])
    assert [len(group.runs) for group in contest.groups] == [4, 4]
    assert others == [f"{again}: another run has the same settings and seed"]


def test_a_run_whose_last_gold_is_lost_is_named_and_gold_stays_the_measure(two_rates: Path) -> None:
    lost = folder_of_run(two_rates / "slow-9", [-10.0, -8.0, None], settings(9, 0.1))
    (contest,), left_out = compare([two_rates])
    assert contest.by_gold
    assert [len(group.scores) for group in contest.groups] == [4, 4]
    assert left_out == [f"{lost}: it has no score, its last gold is not a number"]


def test_of_two_kinds_only_the_kind_is_named(tmp_path: Path) -> None:
    folder_of_run(tmp_path / "a", [0.0, 1.0], {"seed": 0, "learner": {"kind": "dpo", "beta": 0.1}})
    folder_of_run(tmp_path / "b", [0.0, 1.0], {"seed": 0, "learner": {"kind": "kto", "rate": 0.2}})
    (contest,), _ = compare([tmp_path / "a", tmp_path / "b"])
    assert [group.name for group in contest.groups] == ["learner.kind=dpo", "learner.kind=kto"]


def test_where_much_differs_or_nothing_the_folder_gives_the_name(tmp_path: Path) -> None:
    many = {"a": 1, "b": 2, "c": 3, "d": 4}
    folder_of_run(tmp_path / "plain" / "seed-3", [0.0, 1.0], settings(3))
    (alone,), _ = compare([tmp_path])
    assert alone.groups[0].name == "plain"
    folder_of_run(tmp_path / "changed" / "seed-3", [0.0, 1.0], settings(3, **many))
    (contest,), _ = compare([tmp_path])
    assert [group.name for group in contest.groups] == ["changed", "plain"]


def test_tasks_stand_apart_and_runs_that_go_on_are_left_out_by_name(two_rates: Path, tmp_path: Path) -> None:
    folder_of_run(tmp_path / "other", [0.0, 1.0], settings(0), task="Hopper-v5")
    going = folder_of_run(tmp_path / "going", [0.0, 1.0], settings(0), rounds=5)
    found, left_out = compare([two_rates, tmp_path / "other", going])
    assert [contest.task for contest in found] == ["Pendulum-v1", "Hopper-v5"]
    assert left_out == [f"{going}: not finished, round 1 of 5"]
    with pytest.raises(ValueError, match="none of the runs is finished"):
        compare([going])


def test_a_folder_without_runs_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="holds no run"):
        compare([tmp_path])
    with pytest.raises(ValueError, match="no such folder"):
        compare([tmp_path / "nowhere"])


def test_a_page_a_table_and_numbers_are_written_by_the_files_name(two_rates: Path, tmp_path: Path) -> None:
    write_comparison([two_rates], tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text()
    assert page.count("<svg") == 3
    assert "A, learning_rate=0.5, is ahead" in page
    assert "NaN" not in page
    write_comparison([two_rates], tmp_path / "table.md")
    table = (tmp_path / "table.md").read_text()
    assert "**Pendulum-v1**, seeds 0 to 3; prefrl 0.1" in table
    assert "| learning_rate=0.5 | 4 | −10.0 | −1.15 (" in table
    write_comparison([two_rates], tmp_path / "n.json")
    numbers = json.loads((tmp_path / "n.json").read_text())
    assert numbers["groups"][1]["interquartile_mean"] == pytest.approx(-7.5)
    assert [run["seed"] for run in numbers["groups"][0]["runs"]] == [0, 1, 2, 3]
    assert numbers["groups"][0]["command"] == "prefrl run control/pendulum --seeds 4 loop.pool=3 seed=0"
    assert numbers["groups"][0]["settings"]["learner.learning_rate"] == 0.5
    assert [made["commit"] for made in numbers["groups"][0]["made_with"]] == ["c0ffee"]
    with pytest.raises(ValueError, match="ends in"):
        write_comparison([two_rates], tmp_path / "table.txt")


def test_seeds_that_do_not_follow_one_another_and_runs_of_unknown_making_have_no_single_command(tmp_path: Path) -> None:
    for seed in (0, 2):
        folder_of_run(tmp_path / "runs" / f"{seed}", [0.0, 1.0], settings(seed))
    write_comparison([tmp_path / "runs"], tmp_path / "n.json")
    (group,) = json.loads((tmp_path / "n.json").read_text())["groups"]
    assert group["command"] == "prefrl run control/pendulum loop.pool=3 seed=SEED"
    for path in tmp_path.glob("runs/*/summary.json"):
        old = json.loads(path.read_text())
        path.write_text(json.dumps({k: v for k, v in old.items() if k not in ("source", "overrides", "made_with")}))
    write_comparison([tmp_path / "runs"], tmp_path / "n.json")
    (group,) = json.loads((tmp_path / "n.json").read_text())["groups"]
    assert (group["source"], group["command"], group["made_with"]) == (None, None, [])


def test_what_a_folder_is_called_is_no_markup(tmp_path: Path) -> None:
    folder_of_run(tmp_path / "<b>|x", [0.0, 1.0], settings(0), task="<i>")
    write_comparison([tmp_path], tmp_path / "page.html")
    assert "<b>" not in (tmp_path / "page.html").read_text()
    assert "<b>\\|x" in markdown(*compare([tmp_path]))


def test_without_gold_and_wins_there_is_nothing_to_compare_by(tmp_path: Path) -> None:
    folder_of_run(tmp_path / "a", [None, None], settings(0))
    (contest,), _ = compare([tmp_path])
    assert not contest.by_gold
    assert contest.groups[0].score.value is None
    write_comparison([tmp_path], tmp_path / "page.html")
