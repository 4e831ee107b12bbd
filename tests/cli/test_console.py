"""What a terminal shows at the end of a run."""

from io import StringIO

from rich.console import Console

from prefrl.cli.console import round_line, summary_table
from prefrl.types import Json, Round


def shown(**more: object) -> str:
    base: Json = dict.fromkeys(("gold_before", "gold_after", "gold_best", "reward_accuracy", "kl"))
    base |= {"task": "mine", "kind": "text", "seed": 0, "fluency_before": None, "fluency_after": None}
    base |= {"labels": {"asked": 3}, "steps": {"learn": 1000}, "seconds": {"fit": 2.0}}
    console = Console(file=StringIO(), width=100)
    console.print(summary_table(base | more))
    return " ".join(console.file.getvalue().split())  # type: ignore[attr-defined]


def test_what_a_task_cannot_tell_is_no_row_of_dashes() -> None:
    told = shown()
    assert "gold the task has none: the report says how else it did" in told
    assert "reward accuracy, held out not measured" in told
    assert "fluency" not in told
    assert "kl" not in told


def test_what_was_measured_is_shown_before_and_after() -> None:
    told = shown(gold_before=0.0, gold_after=0.5, gold_best=0.75, kl=0.0, fluency_before=0.7, fluency_after=0.6)
    assert "gold 0 → 0.5 (best 0.75)" in told
    assert "kl to the start, nats 0" in told
    assert "fluency 0.7 → 0.6" in told


def test_a_round_without_a_gold_has_none_in_its_line() -> None:
    assert "gold" not in round_line(Round(1, {"evaluate/learned": 1.0})).plain
    assert "gold       0.5" in round_line(Round(1, {"evaluate/gold": 0.5})).plain
