"""Planning in a learned world by the learned reward, without a policy: the true return of what is planned.

    python benchmarks/worlds_planner.py [--preset control/pendulum-planner] [--seeds 5] [--first 100] [--short]
        [--settings KEY=VALUE ...]

Each seed runs the preset; then 20 episodes are planned, with the last world and the last reward, and scored by the true
reward. `gold` is the mean over seeds and `worst` the lowest; `real_steps` are those that were asked about and learned
from, and `imagined_steps` those that plans were tried in; `cpu_s` is the most CPU seconds of any seed, evaluations
included, and `evaluation_cpu_s` those of the 20 episodes. The last line is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

EPISODES = 20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--preset", default="control/pendulum-planner")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--short", action="store_true", help="one seed")
    parser.add_argument("--settings", nargs="*", default=[], help="settings beside the preset's")
    options = parser.parse_args()
    runs = []
    for seed in range(options.first, options.first + (1 if options.short else options.seeds)):
        runs.append(one_run(options.preset, seed, options.settings))
        print(f"seed {seed}: {runs[-1]}", flush=True)
    print(json.dumps(said(options.preset, options.settings, runs) | {"first": options.first, "short": options.short}))


def one_run(preset: str, seed: int, settings: Sequence[str]) -> dict[str, Any]:
    import torch

    from prefrl.config import Config
    from prefrl.improve.planner import Planner, PlannerSettings
    from prefrl.seeding import streams
    from prefrl.store import Store
    from prefrl.types import Segment

    torch.set_num_threads(1)
    config, begin = Config.load(preset, [f"seed={seed}", "learner.device=cpu", *settings]), time.process_time()
    with tempfile.TemporaryDirectory() as folder, Store[Segment](Path(folder) / "store") as store:
        loop = config.build(store)
        *_, last = loop.run()
    many = cast(PlannerSettings, config.learner).model_copy(update={"evaluation_episodes": EPISODES})
    planner: Planner = many.build(config.build_task(), streams(seed, 0).build)
    planner.load(loop.learner.state())
    measuring = time.process_time()
    found = planner.evaluate(loop.reward, streams(seed, 0).evaluate).metrics
    metrics, now = last.metrics, time.process_time()
    steps = {"real_steps": int(metrics["steps/learn"]), "imagined_steps": int(metrics["steps/imagined"])}
    costs = {"cpu_s": round(now - begin, 1), "evaluation_cpu_s": round(now - measuring, 1)}
    return {"gold": round(found["gold"], 1), "labels": int(metrics["label/asked"]), **steps, **costs}


def said(preset: str, settings: Sequence[str], runs: Sequence[dict[str, Any]]) -> dict[str, Any]:
    golds = [run["gold"] for run in runs]
    mean = round(statistics.mean(golds), 1)
    most = ("real_steps", "imagined_steps", "cpu_s", "evaluation_cpu_s", "labels")
    return {
        "name": " ".join([f"worlds_planner: {preset}", *settings]),
        "unit": "true return",
        "ours": mean,
        "peer": None,
        "ratio": None,
        "spread": [min(golds), max(golds)],
        "equal_work": True,
        "gold": mean,
        "worst": min(golds),
        **{name: max(run[name] for run in runs) for name in most},
        "golds": golds,
    }


if __name__ == "__main__":
    main()
