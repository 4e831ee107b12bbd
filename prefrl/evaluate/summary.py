"""What came of a run, in one flat account."""

from __future__ import annotations

import json
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

from prefrl.protocols import Task
from prefrl.types import Json

PACKAGES = ("prefrl", "torch", "numpy", "transformers", "gymnasium", "mujoco", "stable-baselines3")
STAGES = ("sample", "label", "fit", "improve", "evaluate")


def read_metrics(folder: Path) -> list[Json]:
    """The rows of `metrics.jsonl`, one a round."""
    path = folder / "metrics.jsonl"
    return [json.loads(line) for line in path.read_text().splitlines()] if path.exists() else []


def summarise(rows: list[Json], task: Task, seed: int) -> Json:
    """One flat account of a run from its metrics; None where something was not measured."""
    first, last = (rows[0], rows[-1]) if rows else ({}, {})
    gold = [row["evaluate/gold"] for row in rows if row.get("evaluate/gold") is not None]
    seconds = {stage: sum(row.get(f"seconds/{stage}") or 0.0 for row in rows) for stage in STAGES}
    accuracies = [row["fit/accuracy_held_out"] for row in rows if row.get("fit/accuracy_held_out") is not None]
    return {
        "task": task.name,
        "kind": task.kind,
        "seed": seed,
        "rounds": last.get("round", 0),
        "gold_before": first.get("evaluate/gold"),
        "gold_after": last.get("evaluate/gold"),
        "gold_best": max(gold, default=None),
        "labels": {name: int(last.get(f"label/{name}", 0)) for name in ("asked", "answered", "skipped")},
        "steps": {name: int(last.get(f"steps/{name}", 0)) for name in ("learn", "query", "evaluate")},
        "reward_accuracy": accuracies[-1] if accuracies else None,
        "kl": last.get("evaluate/kl"),
        "fluency_before": first.get("evaluate/fluency"),
        "fluency_after": last.get("evaluate/fluency"),
        "seconds": seconds | {"total": sum(seconds.values())},
        "versions": _versions(),
    }


def _versions() -> dict[str, str]:
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
