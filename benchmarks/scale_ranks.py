"""A run of text/reviews on several ranks against the same run on one: what it costs, and whether it is the same.

    python benchmarks/scale_ranks.py [--ranks 2] [--seed 0] [--short]

Each run is the command `prefrl run`, one thread a process, one run after another. `ratio` is the CPU seconds of all
ranks together over those of one rank: 1 would mean that nothing is done twice. `worst_relative_difference` is that of
the parameters of policy or reward after a fit and one update (|a - b| / |a|, norms); `ledger_equal` says whether the
whole runs asked, answered and spent the same, to the last token, in every round.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import load_file

ONE_UPDATE = [
    "loop.rounds=1",
    "loop.labels=40",
    "learner.updates=1",
    "learner.evaluation_prompts=8",
    "fitting.epochs=1",
]
SHORT = ["loop.rounds=2", "loop.labels=60", "learner.updates=4"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--ranks", type=int, default=2)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--short", action="store_true", help="two rounds")
    options = parser.parse_args()
    sizes, seed = (1, options.ranks), f"seed={options.seed}"
    with tempfile.TemporaryDirectory() as folder:
        found = {size: run(size, Path(folder) / f"whole-{size}", [seed, *SHORT * options.short]) for size in sizes}
        for size in sizes:
            run(size, Path(folder) / f"one-{size}", [seed, *ONE_UPDATE])
        apart = worst(*(Path(folder) / f"one-{size}" for size in sizes))
        rounds = {size: ledger(Path(folder) / f"whole-{size}") for size in sizes}
    one, several = (found[size] for size in sizes)
    row = {
        "name": f"scale_ranks: text/reviews on {options.ranks} ranks",
        "unit": "CPU s",
        "ours": round(several["cpu"], 1),
        "peer": round(one["cpu"], 1),
        "ratio": round(several["cpu"] / one["cpu"], 3),
        "seconds": {"one": round(one["wall"], 1), "several": round(several["wall"], 1)},
        "worst_relative_difference": apart,
        "ledger_equal": rounds[1] == rounds[options.ranks],
        "short": options.short,
    }
    print(json.dumps(row))


def run(ranks: int, folder: Path, settings: list[str]) -> dict[str, float]:
    """CPU seconds of all its processes, and seconds on the clock."""
    before, begin = used(), time.perf_counter()
    command = [sys.executable, "-m", "prefrl", "run", "text/reviews", *settings, "--ranks", str(ranks)]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    subprocess.run([*command, "--out", str(folder)], check=True, env=environment, stdout=subprocess.DEVNULL)
    return {"cpu": used() - before, "wall": time.perf_counter() - begin}


def used() -> float:
    spent = resource.getrusage(resource.RUSAGE_CHILDREN)
    return spent.ru_utime + spent.ru_stime


def ledger(folder: Path) -> list[dict[str, Any]]:
    """What each round of a run asked and spent."""
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [{name: row[name] for name in row if name.startswith(("label/", "steps/"))} for row in rows]


def worst(one: Path, other: Path) -> float:
    """|a - b| / |a| of the policy's parameters in the last checkpoints of two runs, and of the reward's: the larger."""
    apart = []
    for part in ("learner", "reward"):
        files = [max((run / "checkpoints").iterdir()) / f"{part}.safetensors" for run in (one, other)]
        a, b = (load_file(file) for file in files)
        names = [name for name in a if a[name].is_floating_point() and "optimizer" not in name]
        flat = [torch.cat([found[name].flatten() for name in names]) for found in (a, b)]
        apart.append(float((flat[0] - flat[1]).norm() / flat[0].norm()))
    return max(apart)


if __name__ == "__main__":
    main()
