"""What came of a run, in one flat account."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from prefrl.protocols import Clocked, Task
from prefrl.types import Json

PURPOSES = ("learn", "query", "evaluate")
STAGES = ("sample", "label", "fit", "improve", "evaluate")


class Origin(NamedTuple):
    """What was asked for, and what computed it."""

    source: str | None
    """A preset, or the name of a file of settings; None where a program made the settings."""
    overrides: Sequence[str]
    """As `dotted.key=value`."""
    made_with: Sequence[Json]
    """Of each process that had a part in the run, in their order; those that computed with the same are one."""

    def after(self, earlier: Json) -> Origin:
        """That of a run which another process began, by the summary that it left."""
        there = earlier.get("made_with") or [{"versions": earlier.get("versions", {})}]
        made = [*there, *(one for one in self.made_with if one != there[-1])]
        if self.source is None:
            return Origin(earlier.get("source"), earlier.get("overrides", ()), made)
        return self._replace(made_with=made)


def read_summary(folder: Path) -> Json:
    """What a run left in `summary.json` so far; empty where it left none that can be read."""
    path = folder / "summary.json"
    try:
        found = json.loads(path.read_text()) if path.exists() else {}
    except ValueError:
        found = {}
    return found if isinstance(found, dict) else {}


def read_metrics(folder: Path) -> list[Json]:
    """The rows of `metrics.jsonl`, one a round."""
    path = folder / "metrics.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def pace(task: Task) -> float | None:
    """Steps a second of the world that a task stands for; None where there is none outside."""
    return task.steps_per_second if isinstance(task, Clocked) else None


def judged(metrics: Mapping[str, Any]) -> bool:
    """Whether a model was asked in place of people, which takes none of their time."""
    return "label/pairs" in metrics


def summarise(rows: list[Json], task: Task, seed: int, origin: Origin, people: float = 0.0) -> Json:
    """One flat account of a run from its metrics; None where something was not measured.

    `people`: seconds that they took for their answers, if a page measured it.
    """
    first, last = (rows[0], rows[-1]) if rows else ({}, {})
    gold = [row["evaluate/gold"] for row in rows if row.get("evaluate/gold") is not None]
    seconds = {stage: sum(row.get(f"seconds/{stage}") or 0.0 for row in rows) for stage in STAGES}
    counted = ("asked", "answered", "skipped", *(["demonstrations"] if "label/demonstrations" in last else []))
    dreamt = ["imagined"] if "steps/imagined" in last else []
    accuracies = [row["fit/accuracy_held_out"] for row in rows if row.get("fit/accuracy_held_out") is not None]
    return {
        "task": task.name,
        "kind": task.kind,
        "seed": seed,
        "rounds": last.get("round", 0),
        "gold_before": first.get("evaluate/gold"),
        "gold_after": last.get("evaluate/gold"),
        "gold_best": max(gold, default=None),
        "labels": {name: int(last.get(f"label/{name}", 0)) for name in counted},
        "steps": {name: int(last.get(f"steps/{name}", 0)) for name in (*PURPOSES, *dreamt)},
        "reward_accuracy": accuracies[-1] if accuracies else None,
        "kl": last.get("evaluate/kl"),
        "fluency_before": first.get("evaluate/fluency"),
        "fluency_after": last.get("evaluate/fluency"),
        "steps_per_second": pace(task),
        "people_seconds": people or (0.0 if judged(last) else None),
        "seconds": seconds | {"total": sum(seconds.values())},
        "source": origin.source,
        "overrides": list(origin.overrides),
        "versions": origin.made_with[-1]["versions"],
        "made_with": list(origin.made_with),
    }
