"""Better than the best of what was ranked? T-REX on a pendulum, from middling episodes and their order.

    python benchmarks/demos_trex.py [--seeds 5] [--first 100] [--episodes 24] [--set KEY=VALUE] [--out runs/demos-trex]
        [--short]

The known expert plays with 60 to 100 % blind actions, and somebody orders the episodes, by their true return. All
that is kept is a file of observations, actions and ranks. `prefrl fit` on it, then `prefrl improve` from nothing.
`--set` changes the settings of both. Finished runs are taken up. The last line is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
from pathlib import Path
from typing import cast

import numpy as np

from prefrl.config import Config
from prefrl.evaluate.summary import read_summary
from prefrl.label.drex import DrexSettings
from prefrl.protocols import ControlTask

PRESET, LEAST = "control/pendulum-drex", 0.6
CUT = ("fitting.crop=0.85", "fitting.epochs=100")
"""Windows of 30 to 200 steps; and as many gradient steps as the preset's 1,000 pairs make, or more."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--episodes", type=int, default=24)
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting of fit and policy")
    parser.add_argument("--out", type=Path, default=Path("runs/demos-trex"))
    parser.add_argument("--short", action="store_true", help="one seed, six episodes, two rounds")
    options = parser.parse_args()
    count = 6 if options.short else options.episodes
    tail = "".join(f"-{one}" for one in options.set) + ("-short" if options.short else "")
    settings = [*CUT, *options.set, *(["loop.rounds=2"] if options.short else [])]
    ours, shown = list[float](), list[list[float]]()
    for seed in range(options.first, options.first + (1 if options.short else options.seeds)):
        folder = options.out / f"{count}{tail}-{seed}"
        folder.mkdir(parents=True, exist_ok=True)
        file, returns = ranked(folder, count, seed)
        shown.append([min(returns), statistics.mean(returns), max(returns)])
        ours.append(learned(folder, file, seed, settings))
        print(json.dumps({"seed": seed, "gold": round(ours[-1]), "best_shown": round(max(returns))}), flush=True)
    worst, mean, best = (round(statistics.mean(values)) for values in zip(*shown, strict=True))
    print(
        json.dumps(
            {
                "name": f"demos_trex: {count} ranked episodes{tail}",
                "unit": "true return",
                "ours": round(statistics.mean(ours)),
                "each": [round(x) for x in ours],
                "shown": {"worst": worst, "mean": mean, "best": best},
                "seeds": [options.first, options.first + len(ours) - 1],
                "short": options.short,
            }
        )
    )


def ranked(folder: Path, count: int, seed: int) -> tuple[Path, list[float]]:
    """The file of ranked episodes, and their true returns."""
    task = cast(ControlTask, Config.load(PRESET).build_task())
    episodes = DrexSettings().build(task).play(np.linspace(LEAST, 1, count), np.random.default_rng(seed))
    returns = [float(one.gold.sum()) for one in episodes if one.gold is not None]
    np.savez(
        folder / "ranked.npz",
        observations=np.stack([one.observations for one in episodes]),
        actions=np.stack([one.actions for one in episodes]),
        ranks=np.argsort(np.argsort([-x for x in returns])),
    )
    return folder / "ranked.npz", returns


def learned(folder: Path, file: Path, seed: int, settings: list[str]) -> float:
    """The true return of a policy that learned from a reward that was fitted on the file."""
    reward, policy = folder / "reward", folder / "policy"
    if not reward.exists():
        prefrl(["fit", str(file), "--config", PRESET, f"seed={seed}", *settings, "--out", str(reward)])
    prefrl(["improve", PRESET, "--reward", str(reward), f"seed={seed}", *settings, "--out", str(policy)])
    found = read_summary(policy)
    assert not found["labels"]["asked"], "nothing but the ranks is to be learned from"
    return float(found["gold_after"])


def prefrl(command: list[str]) -> None:
    subprocess.run([sys.executable, "-m", "prefrl", *command], check=True, stdout=subprocess.DEVNULL)


if __name__ == "__main__":
    main()
