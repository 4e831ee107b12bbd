"""Folders of runs that never ran: what a report and a comparison read of them."""

import json
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from linear_reward import LinearReward, segment

from prefrl.evaluate.card import ReportCard
from prefrl.evaluate.grade import Subject, grade
from prefrl.judgements import Comparison, Judged
from prefrl.types import Query

WILD = "</bdi></td><script>alert(1)</script>\u202e\x1b{{ 7*7 }}"


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
        "source": "control/pendulum",
        "overrides": ["loop.pool=3", f"seed={settings['seed']}"],
        "versions": {"prefrl": "0.1"},
        "made_with": [{"commit": "c0ffee", "changed": False, "versions": {"prefrl": "0.1"}}],
    }
    (folder / "summary.json").write_text(json.dumps(summary))
    return folder


@cache
def wild_card() -> ReportCard:
    """A reward model's card after three rounds, with names that no page may believe."""
    rng, found = np.random.default_rng(0), []
    for i in range(40):
        query = Query((segment(rng, 2 * i, steps=5), segment(rng, 2 * i + 1, steps=7)))
        found.append(Judged(query, Comparison(query.id, float(rng.random() < 0.7), WILD if i % 2 else "ann")))
    probes = [{"round": i, "scores": rng.normal(size=8).tolist()} for i in (1, 2, 3)]
    subject = Subject(LinearReward((1.0, -1.0, 0.5), (1.0, 0.0, 0.0)), found, model=WILD, data=WILD, held_out=True)
    return grade(Subject(**{**vars(subject), "round": 3, "probes": probes}), rng)
