"""What a run costs outside a simulator, in words and in a report."""

import json
from pathlib import Path

from run_folders import folder_of_run

from prefrl import Config
from prefrl.evaluate.summary import Origin, pace, summarise
from prefrl.report.chapters import chapters
from prefrl.report.costs import Spent, account, costs
from prefrl.report.facts import gather
from prefrl.report.records import read


def test_the_world_takes_its_time_and_people_theirs() -> None:
    found = costs(Spent(steps=72_000, rate=20.0, answers=100, people=None, machine=9.0))
    assert [(one.who, one.seconds) for one in found] == [("the world", 3600.0), ("people", 500.0), ("the machine", 9.0)]
    told = account(found)
    assert told.startswith(
        "The world: 1 h 0 min (72,000 steps at 20.0 a second). People: 8 min 20 s (100 answers at 5 s"
    )
    assert told.endswith("The bottleneck is the world.")


def test_what_a_page_measured_of_people_is_taken_for_what_it_is() -> None:
    found = costs(Spent(steps=1, rate=None, answers=100, people=900.0, machine=9.0))
    assert [(one.who, one.seconds) for one in found] == [("people", 900.0), ("the machine", 9.0)]
    assert "as the page timed them" in account(found)
    assert account(found).endswith("The bottleneck is people.")


def test_a_machine_that_works_alone_is_no_bottleneck() -> None:
    (judged,) = costs(Spent(steps=1, rate=None, answers=100, people=0.0, machine=9.0))
    assert judged.who == "the machine"
    (alone,) = costs(Spent(steps=1, rate=None, answers=0, people=None, machine=9.0))
    assert "bottleneck" not in account([alone])


def outside(folder: Path, **more: object) -> str:
    """How a report reads the costs of a run with such a summary; empty where it draws none."""
    made = folder_of_run(folder, [-5.0, -1.0], {"seed": 0})
    path = made / "summary.json"
    seconds = {"label": 60.0, "improve": 30.0, "total": 90.0}
    path.write_text(json.dumps(json.loads(path.read_text()) | {"seconds": seconds} | more))
    record = read(made)
    cards = [card for chapter in chapters(record, gather(record)) for card in chapter.cards]
    return next((card.reading for card in cards if card.title == "Out in the world"), "")


def test_a_report_leaves_waiting_for_people_out_of_the_machine(tmp_path: Path) -> None:
    assert "The machine: 30 s" in outside(tmp_path / "people", steps_per_second=10.0, people_seconds=55.0)
    simulated = outside(tmp_path / "oracle", steps_per_second=10.0, people_seconds=None)
    assert "The world: 1 min 55 s (1,150 steps" in simulated
    assert "The machine: 1 min 30 s" in simulated
    assert "bottleneck is people" in simulated


def test_the_answers_of_a_model_take_nobodys_time(tmp_path: Path) -> None:
    task, origin = Config.load("control/toy").build_task(), Origin(None, (), [{"versions": {}}])
    said = [
        summarise([row], task, 0, origin)["people_seconds"] for row in ({"round": 0, "label/pairs": 4.0}, {"round": 0})
    ]
    assert said == [0.0, None]
    assert "People:" not in outside(tmp_path / "judge", steps_per_second=10.0, people_seconds=0.0)


def test_what_is_known_of_no_world_is_not_made_up(tmp_path: Path) -> None:
    assert "world:" not in outside(tmp_path / "old")
    assert outside(tmp_path / "nothing", labels={"asked": 0, "answered": 0, "skipped": 0}) == ""


def test_only_a_world_outside_has_a_pace() -> None:
    paces = {name: pace(Config.load(name).build_task()) for name in ("control/pendulum", "control/toy", "text/toy")}
    assert paces == {"control/pendulum": 20.0, "control/toy": None, "text/toy": None}
