"""Learning without the simulator: policies from a file of judged segments alone, then measured in the environment.

    python benchmarks/control_offline.py [--short]
    python benchmarks/control_offline.py --humans FOLDER

For each seed a run of `control/pendulum` is stopped after four rounds, and the 500 comparisons of its segments become
an .npz of pairs. From that file alone a clone, CPL and IQL learn; each is then evaluated over 20 episodes. Returns are
normalised: 0 is the run's starting policy, 1 its last one. With --humans: how the policies and rewards learned from
people's labels of Hopper and Walker2d agree with held-out pairs, and what the policies are worth in the simulator.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from prefrl import Config
from prefrl.exchange.layout import Which
from prefrl.exchange.ports import import_judgements
from prefrl.judgements import implied_pairs
from prefrl.store import Store
from prefrl.types import Segment

METHODS = {
    "clone": ["learner.kind=cpl", "learner.epochs=0"],
    "cpl": ["learner.kind=cpl", "learner.epochs=30"],
    "iql": ["learner.kind=iql", "learner.discount=0.97", "learner.critic_steps=3000", "learner.policy_steps=3000"],
}
HUMANS = ("hopper", "walker2d")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--short", action="store_true", help="one seed: about two minutes")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=100, help="the first seed")
    parser.add_argument("--humans", type=Path, help="a folder with NAME-medium-expert-v2.npz")
    options = parser.parse_args()
    seeds = range(options.first, options.first + (1 if options.short else options.seeds))
    done = humans(options.humans, seeds) if options.humans else pendulum(seeds)
    print(json.dumps(done | {"short": options.short}))


def pendulum(seeds: range) -> dict[str, Any]:
    """Normalised returns of each method, and their intervals."""
    found: dict[str, list[float]] = {name: [] for name in METHODS}
    for seed in seeds:
        with tempfile.TemporaryDirectory() as scratch:
            file = Path(scratch) / "pairs.npz"
            start, end = record(seed, file)
            row = {"start": start, "last": end}
            for name, learner in METHODS.items():
                row[name] = learned("control/pendulum", learner, seed, file)["evaluate/gold"]
                found[name].append((row[name] - start) / (end - start))
        print(seed, {name: round(value) for name, value in row.items()}, flush=True)
    ours = {name: interval(values) for name, values in found.items()}
    return {"name": "control_offline: Pendulum-v1 from 500 judged pairs alone", "unit": "normalised return"} | ours


def record(seed: int, file: Path) -> tuple[float, float]:
    """Write the judged pairs of a short run; the returns that it began and ended with."""
    config = Config.load("control/pendulum", ["loop.rounds=4", "loop.labels=500", f"seed={seed}"])
    with tempfile.TemporaryDirectory() as folder, Store[Segment](Path(folder)) as store:
        gold = [round.metrics["evaluate/gold"] for round in config.build(store).run()]
        judged = store.judged()
    sides = [[one.query.candidates[i] for one in judged] for i in (0, 1)]
    arrays = {
        f"train_{name}_{i}": np.stack([one.observations if name == "obs" else one.actions for one in side])
        for i, side in enumerate(sides, 1)
        for name in ("obs", "action")
    }
    labels = [1 - preference for one in judged for *_, preference in implied_pairs(one.judgement, 2)]
    np.savez(file, train_label_oracle=np.array(labels), **arrays)
    return gold[0], gold[-1]


def learned(preset: str, learner: list[str], seed: int, file: Path, split: str = "", more: tuple[str, ...] = ()) -> Any:
    """The last round's metrics of a learner that has the file alone."""
    plain = [*learner, "loop.labels=0", "loop.rounds=1", f"seed={seed}", *more]
    with tempfile.TemporaryDirectory() as folder, Store[Segment](Path(folder)) as store:
        import_judgements(file, store, Which((), split))
        return list(Config.load(preset, plain).build(store).run())[-1].metrics


def humans(folder: Path, seeds: range) -> dict[str, Any]:
    """Agreement with held-out judgements of people, and returns in the simulator, of each method."""
    found: dict[str, Any] = {}
    for env in HUMANS:
        file = folder / f"{env}-medium-expert-v2.npz"
        for name, learner in METHODS.items():
            rows = [
                learned(
                    f"control/{env}-human", learner, seed, file, more=("learner.held_out=0.3", "fitting.held_out=0.3")
                )
                for seed in seeds
            ]
            keys = ("evaluate/agreement", "fit/accuracy_held_out", "evaluate/gold")
            found[f"{env}/{name}"] = {key: interval([row[key] for row in rows]) for key in keys}
            print(env, name, found[f"{env}/{name}"], flush=True)
    return {"name": "control_offline: people's labels", "unit": "share, return"} | found


def interval(values: list[float]) -> list[float]:
    """Mean, and a 95 % bootstrap interval over seeds."""
    draws = np.random.default_rng(0).choice(values, (2000, len(values))).mean(1)
    return [round(float(x), 3) for x in (np.mean(values), *np.percentile(draws, [2.5, 97.5]))]


if __name__ == "__main__":
    main()
