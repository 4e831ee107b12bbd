"""A learned world beside the learned reward: the true return of Dyna's policy, and what it cost in real steps.

    python benchmarks/worlds_dyna.py [--preset control/pendulum-dyna] [--seeds 10] [--first 100] [--short]
        [--settings KEY=VALUE ...]

Each seed runs the preset; then 20 episodes of the last policy's mode are scored by the true reward. `gold` is the mean
over seeds and `worst` the lowest of them; `real_steps` are those that a policy took to be asked about and learned from,
the most of any seed, and `imagined_steps` those in the learned world; `cpu_s` is the most CPU seconds of any seed, for
the whole run without its evaluations' report. The last line is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

EPISODES = 20


def main() -> None:
    options, runs = over_seeds(__doc__, "control/pendulum-dyna", 10, one_run)
    print(json.dumps(said(options.preset, runs) | {"first": options.first, "short": options.short}))


def over_seeds(
    about: str | None, preset: str, seeds: int, one_run: Callable[[str, int, Sequence[str]], dict[str, Any]]
) -> tuple[argparse.Namespace, list[dict[str, Any]]]:
    """The options, and what each seed came to: a line for each as it ends."""
    parser = argparse.ArgumentParser(description=about, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default=preset)
    parser.add_argument("--seeds", type=int, default=seeds)
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--short", action="store_true", help="one seed")
    parser.add_argument("--settings", nargs="*", default=[], help="settings beside the preset's")
    options = parser.parse_args()
    runs = []
    for seed in range(options.first, options.first + (1 if options.short else options.seeds)):
        runs.append(one_run(options.preset, seed, options.settings))
        print(f"seed {seed}: {runs[-1]}", flush=True)
    return options, runs


def one_run(preset: str, seed: int, settings: Sequence[str]) -> dict[str, Any]:
    import torch

    from prefrl.config import Config
    from prefrl.store import Store
    from prefrl.types import Segment

    torch.set_num_threads(1)
    own = [f"seed={seed}", "learner.device=cpu", f"learner.evaluation_episodes={EPISODES}"]
    config, begin = Config.load(preset, [*own, *settings]), time.process_time()
    golds, spent = [], []
    with tempfile.TemporaryDirectory() as folder, Store[Segment](Path(folder) / "store") as store:
        for done in config.build(store).run():
            metrics = done.metrics
            golds.append(round(metrics["evaluate/gold"], 1))
            spent.append(int(metrics["steps/learn"] + metrics["steps/query"]))
    asked, imagined = int(metrics["label/asked"]), int(metrics.get("steps/imagined", 0))
    cpu = round(time.process_time() - begin, 1)
    costs = {"labels": asked, "real_steps": spent[-1], "imagined_steps": imagined, "cpu_s": cpu}
    return {"gold": golds[-1], **costs, "curve": golds}


def said(preset: str, runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    golds = [run["gold"] for run in runs]
    mean = round(statistics.mean(golds), 1)
    return {
        "name": f"worlds_dyna: {preset}",
        "unit": "true return",
        "ours": mean,
        "peer": None,
        "ratio": None,
        "spread": [min(golds), max(golds)],
        "equal_work": True,
        "gold": mean,
        "worst": min(golds),
        "real_steps": max(run["real_steps"] for run in runs),
        "imagined_steps": max(run["imagined_steps"] for run in runs),
        "cpu_s": max(run["cpu_s"] for run in runs),
        "labels": max(run["labels"] for run in runs),
        "golds": golds,
    }


if __name__ == "__main__":
    main()
