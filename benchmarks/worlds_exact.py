"""A policy from comparisons, against the best one there is: control/gridworld, where both are known exactly.

    python benchmarks/worlds_exact.py [--seeds 5] [--first 100] [--out runs/worlds-exact] [--short]

`regret` is how far the return of the policy's mode lies below the best one's, discounted by 0.95 and without an end, as
a share of the span between the best and the worst policy: no episode is played for it. `gold` is its return over an
episode of 60 steps, exact as well. Finished runs are taken up. The last line is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import statistics
import subprocess
import sys
from pathlib import Path

import numpy as np

from prefrl import load_policy
from prefrl.envs import exact
from prefrl.envs.tabular import GridworldSettings, table
from prefrl.types import Floats


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--out", type=Path, default=Path("runs/worlds-exact"))
    parser.add_argument("--short", action="store_true", help="one seed")
    options = parser.parse_args()
    settings = GridworldSettings()
    mdp, horizon = settings.world().mdp, settings.horizon
    best, _ = exact.policy_iteration(mdp)
    found = []
    for seed in range(options.first, options.first + (1 if options.short else options.seeds)):
        acts = mode_of(trained(options.out / f"seed-{seed}", seed), len(best))
        found.append((exact.regret(mdp, acts), exact.objective(mdp, acts, horizon)))
        print(f"seed {seed}: regret {found[-1][0]:.4f}, gold {found[-1][1]:.2f}", flush=True)
    regrets, golds = ([round(x, 4) for x in values] for values in zip(*found, strict=True))
    print(
        json.dumps(
            {"name": "worlds_exact: gridworld, 100 comparisons", "unit": "share of the span"}
            | {"regret": round(statistics.mean(regrets), 4), "regrets": regrets, "golds": golds}
            | {"best_gold": round(exact.objective(mdp, best, horizon), 4), "short": options.short}
        )
    )


def trained(folder: Path, seed: int) -> Path:
    command = [sys.executable, "-m", "prefrl", "run", "control/gridworld", f"seed={seed}", "--out", str(folder)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return folder


def mode_of(folder: Path, states: int) -> Floats:
    """(S, A): what the policy of a run does in each state, without chance."""
    policy = load_policy(folder)

    def act(observations: Floats) -> Floats:
        chosen, _ = policy.predict(observations)
        return np.eye(4)[np.asarray(chosen).astype(int).ravel()]

    return table(act, states)


if __name__ == "__main__":
    main()
