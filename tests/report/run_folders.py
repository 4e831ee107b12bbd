"""Folders of runs that never ran: what a report and a comparison read of them."""

import json
from pathlib import Path
from typing import Any

import yaml


def folder_of_run(
    folder: Path,
    gold: list[float | None],
    settings: dict[str, Any],
    task: str = "Pendulum-v1",
    rounds: int | None = None,
) -> Path:
    """A run with one evaluation a round; unfinished where it was to have more `rounds`."""
    folder.mkdir(parents=True)
    lines = [{"round": at, "evaluate/gold": value, "label/answered": 10 * at} for at, value in enumerate(gold)]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    wanted = len(gold) - 1 if rounds is None else rounds
    (folder / "config.yaml").write_text(yaml.safe_dump(settings | {"loop": {"rounds": wanted}}))
    summary = {
        "task": task,
        "kind": "segments",
        "seed": settings["seed"],
        "rounds": len(gold) - 1,
        "gold_before": gold[0],
        "gold_after": gold[-1],
        "gold_best": gold[-1],
        "labels": {"asked": 40, "answered": 40, "skipped": 0},
        "steps": {"learn": 1000, "query": 100, "evaluate": 50},
        "seconds": {"sample": 1.0, "total": 2.0},
        "versions": {"prefrl": "0.1"},
    }
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder
