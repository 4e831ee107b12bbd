"""Better than its demonstrator? D-REX, from rankings that nobody gave.

    python benchmarks/demos_drex.py [--task pendulum|halfcheetah|hopper] [--seeds 5] [--first 100]
        [--set KEY=VALUE] [--out runs/demos-drex] [--short]

`pendulum`: four clean episodes of the known expert are cloned, and the clone is the policy that plays with ever more
blind actions; the learner begins from nothing. The others: it is a PPO of our own after 200,000 steps on the true
reward (seed 3), the same for every seed, and the learner begins from it. Returns are gold, and no fall ends an episode.
`--set` changes the runs, as in `--set reward.features=inputs`. Finished runs are taken up. The last line is one JSON
object.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import cast

import numpy as np
import torch
from control_ppo import BATCH, Ours
from demos_hopper import said

from prefrl.config import Config
from prefrl.evaluate.summary import read_summary
from prefrl.label.drex import DrexSettings
from prefrl.protocols import ControlTask

HALF_TRAINED, STEPS = 3, 200_000
BODIES = {"halfcheetah": "HalfCheetah-v5", "hopper": "Hopper-v5"}
BY_NOISE = (
    "labeler.kind=drex", "labeler.episodes=5", "labeler.pairs=2000", "loop.labels=0",
    "reward.features=observations", "fitting.weight_decay=3",
)  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", choices=("pendulum", *BODIES), default="pendulum")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting of the runs")
    parser.add_argument("--out", type=Path, default=Path("runs/demos-drex"))
    parser.add_argument("--short", action="store_true", help="one seed, two rounds, and a policy of 8,192 steps")
    options = parser.parse_args()
    tail = "".join(f"-{one}" for one in options.set) + ("-short" if options.short else "")
    settings = [*options.set, *(["loop.rounds=2", "labeler.pairs=100"] if options.short else [])]
    seeds = range(options.first, options.first + (1 if options.short else options.seeds))
    own, theirs, accuracy = list[float](), list[float](), list[float]()
    for seed in seeds:
        policy, gold = demonstrator(options.task, seed, options.out, options.short)
        started = [f"control/{options.task}", *BY_NOISE, f"learner.start={said(policy)}"]
        preset = ["control/pendulum-drex"] if options.task == "pendulum" else started
        folder = options.out / f"{options.task}{tail}-{seed}"
        run(folder, [*preset, f"seed={seed}", f"labeler.policy={said(policy)}", *settings])
        own.append(read_summary(folder)["gold_after"])
        theirs.append(gold)
        accuracy.append(read_summary(folder)["reward_accuracy"])
        print(json.dumps({"seed": seed, "gold": round(own[-1]), "demonstrator": round(gold)}), flush=True)
    print(
        json.dumps(
            {
                "name": f"demos_drex: {options.task}{tail}",
                "unit": "true return",
                "ours": round(statistics.mean(own)),
                "demonstrator": round(statistics.mean(theirs)),
                "each": [round(x) for x in own],
                "of_the_demonstrator": [round(x) for x in theirs],
                "accuracy_held_out": [x and round(x, 2) for x in accuracy],
                "seeds": [seeds[0], seeds[-1]],
                "short": options.short,
            }
        )
    )


def demonstrator(task: str, seed: int, out: Path, short: bool) -> tuple[Path, float]:
    """The policy that plays, and its return."""
    if task == "pendulum":
        folder = out / f"clone-{seed}"
        run(folder, ["control/pendulum-demos", f"seed={seed}", "labeler.noise=0"])
        return folder, read_summary(folder)["gold_after"]
    steps = 2 * BATCH if short else STEPS
    policy = out / f"{task}-{steps}.zip"
    if not policy.exists():
        out.mkdir(parents=True, exist_ok=True)
        torch.set_num_threads(1)
        side = Ours(BODIES[task], HALF_TRAINED, steer=True)
        side.learn(steps // BATCH)
        side._learner.save(policy)
    world = cast(ControlTask, Config.load(f"control/{task}").build_task())
    episodes = DrexSettings(policy=policy).build(world).play(np.zeros(20), np.random.default_rng(seed))
    return policy, statistics.mean(float(one.gold.sum()) for one in episodes if one.gold is not None)


def run(folder: Path, command: Sequence[str]) -> None:
    subprocess.run(
        [sys.executable, "-m", "prefrl", "run", *command, "--out", str(folder)], check=True, stdout=subprocess.DEVNULL
    )


if __name__ == "__main__":
    main()
