"""Demonstrations and then comparisons: how many labels a pendulum takes that an expert has shown four times.

    python benchmarks/demos_labels.py [--seeds 5] [--first 100] [--out runs/demos-labels] [--short]

A clone of four episodes (control/pendulum-demos), and control/pendulum from there with 60 comparisons in six rounds;
beside it the same from a random start. `labels_to_200` is how many comparisons had been asked for when the return was
at least -200 and stayed there, the median over seeds; null where half of them never were. Finished runs are taken up.
The last line is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from prefrl.evaluate.summary import read_metrics

GOAL = -200.0
FEW = ("loop.labels=60", "loop.rounds=6")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--out", type=Path, default=Path("runs/demos-labels"))
    parser.add_argument("--short", action="store_true", help="one seed")
    options = parser.parse_args()
    found: dict[str, list[list[dict[str, float]]]] = {"shown": [], "random": []}
    for seed in range(options.first, options.first + (1 if options.short else options.seeds)):
        clone = run(options.out / f"clone-{seed}", ["control/pendulum-demos", f"seed={seed}"])
        start = f"learner.start={json.dumps(str(clone.resolve()))}"
        for name, settings in (("shown", [start]), ("random", [])):
            folder = run(options.out / f"{name}-{seed}", ["control/pendulum", f"seed={seed}", *FEW, *settings])
            found[name].append(read_metrics(folder))
            golds = [round(one["evaluate/gold"], 1) for one in found[name][-1]]
            print(f"{name} {seed}: {golds}, labels {labels_to(found[name][-1])}", flush=True)
    said = {name: median([labels_to(one) for one in runs]) for name, runs in found.items()}
    golds = {name: [round(one[-1]["evaluate/gold"], 1) for one in runs] for name, runs in found.items()}
    means = {name: round(statistics.mean(values), 1) for name, values in golds.items()}
    print(
        json.dumps(
            {"name": "demos_labels: Pendulum-v1, four demonstrations and 60 comparisons", "unit": "labels"}
            | {"labels_to_200": said["shown"], "without": said["random"], "gold": means, "golds": golds}
            | {"clone": [round(one[0]["evaluate/gold"], 1) for one in found["shown"]], "short": options.short}
        )
    )


def run(folder: Path, settings: Sequence[str]) -> Path:
    """A run, which is made, or taken up where it stopped."""
    command = [sys.executable, "-m", "prefrl", "run", *settings, "--out", str(folder)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return folder


def labels_to(rounds: Sequence[dict[str, Any]]) -> float | None:
    """Comparisons asked for until the return reached the goal for good."""
    late = [i for i, one in enumerate(rounds) if one["evaluate/gold"] < GOAL]
    first = late[-1] + 1 if late else 0
    return None if first == len(rounds) else rounds[first]["label/asked"]


def median(counts: Sequence[float | None]) -> float | None:
    found = statistics.median(float("inf") if count is None else count for count in counts)
    return None if found == float("inf") else found


if __name__ == "__main__":
    main()
