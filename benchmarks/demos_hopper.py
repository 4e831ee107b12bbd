"""A hopper from five demonstrations and 200 labels: the clone, and control/hopper-demos-and-labels from there.

    python benchmarks/demos_hopper.py [--seeds 3] [--first 100] [--out runs/demos-hopper] [--short]

The expert is a policy of our own, trained on the true reward for 1.5M steps with episodes that end at a fall (as in
`control_ppo.py --returns`, seed 3); it shows five episodes without noise, which every seed clones. Returns are gold of
20 episodes of 1,000 steps, in which a fall ends nothing. `steps` are the learner's own, for learning and for queries.
Finished runs, and the expert, are taken up. The last line is one JSON object.
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

import torch
from control_ppo import BATCH, Ours

from prefrl.evaluate.summary import read_summary

PRESET, EXPERT, EXPERT_STEPS, EPISODES = "control/hopper-demos-and-labels", 3, 1_500_000, 5
CLONE = ("learner.kind=clone", "learner.std=0.2", "learner.cloning_epochs=100", "loop.labels=0", "loop.rounds=1")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--out", type=Path, default=Path("runs/demos-hopper"))
    parser.add_argument("--short", action="store_true", help="one seed, and an expert of 200,000 steps")
    options = parser.parse_args()
    out = options.out / "short" if options.short else options.out
    shown, seeds = demonstrations(out, 200_000 if options.short else EXPERT_STEPS), range(options.first, sys.maxsize)
    found: dict[str, list[dict[str, Any]]] = {"clone": [], "labels": []}
    for seed in seeds[: 1 if options.short else options.seeds]:
        clone = run(out / f"clone-{seed}", [f"seed={seed}", *CLONE, f"learner.data={said(shown)}"])
        start = f"learner.start={said(clone)}"
        better = run(out / f"labels-{seed}", [f"seed={seed}", start])
        found["clone"].append(read_summary(clone))
        found["labels"].append(read_summary(better))
    returns = {name: [round(one["gold_after"]) for one in runs] for name, runs in found.items()}
    spent = [one["steps"]["learn"] + one["steps"]["query"] for one in found["labels"]]
    print(
        json.dumps(
            {
                "name": f"demos_hopper: {EPISODES} demonstrations, then 200 labels",
                "unit": "true return",
                "ours": round(statistics.mean(returns["labels"])),
                **returns,
                "labels_asked": [one["labels"]["asked"] for one in found["labels"]],
                "steps": spent,
                "seeds": [options.first, options.first + len(spent) - 1],
                "short": options.short,
            }
        )
    )


def demonstrations(out: Path, steps: int) -> Path:
    """The folder of what the expert shows."""
    expert, shown = out / "expert.zip", out / "shown"
    if not expert.exists():
        out.mkdir(parents=True, exist_ok=True)
        torch.set_num_threads(1)
        side = Ours("Hopper-v5", EXPERT, steer=True)
        side.learn(steps // BATCH)
        print(f"the expert's return where episodes end at a fall: {side.gold():.0f}", flush=True)
        side._learner.save(expert)
    if not shown.exists():
        prefrl(["demonstrate", PRESET, "--expert", str(expert), "--episodes", str(EPISODES), "--out", str(shown)])
    return shown


def run(folder: Path, settings: Sequence[str]) -> Path:
    """A finished run, taken up where it stopped."""
    prefrl(["run", PRESET, *settings, "--out", str(folder)])
    return folder


def prefrl(command: Sequence[str]) -> None:
    subprocess.run([sys.executable, "-m", "prefrl", *command], check=True, stdout=subprocess.DEVNULL)


def said(path: Path) -> str:
    return json.dumps(str(path.resolve()))


if __name__ == "__main__":
    main()
