"""Planning in a learned world by the learned reward, without a policy: the true return of what is planned.

    python benchmarks/worlds_planner.py [--preset control/pendulum-planner] [--seeds 5] [--first 100] [--short]
        [--settings KEY=VALUE ...]

Each seed runs the preset; then 20 episodes are planned, with the last world and the last reward, and scored by the true
reward. `gold` is the mean over seeds and `worst` the lowest; `real_steps` are those that were asked about and learned
from, and `imagined_steps` those that plans were tried in; `cpu_s` is the most CPU seconds of any seed, evaluations
included, and `evaluation_cpu_s` those of the 20 episodes. With `--preset control/gridworld-planner` also `agreement`,
in what share of the states the tree search takes an action of value iteration's on the same learned world and reward,
and `regret`, as a share of the span of true returns. The last line is one JSON object.
"""

from __future__ import annotations

import json
import statistics
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
from worlds_dyna import over_seeds

EPISODES = 20


def main() -> None:
    options, runs = over_seeds(__doc__, "control/pendulum-planner", 5, one_run)
    print(json.dumps(said(options.preset, options.settings, runs) | {"first": options.first, "short": options.short}))


def one_run(preset: str, seed: int, settings: Sequence[str]) -> dict[str, Any]:
    import torch

    from prefrl.config import Config
    from prefrl.improve.planner import PlannerSettings
    from prefrl.improve.tree import TreePlanner
    from prefrl.policies.rollout import step_rewards
    from prefrl.seeding import streams
    from prefrl.store import Store
    from prefrl.types import Segment

    torch.set_num_threads(1)
    config, begin = Config.load(preset, [f"seed={seed}", "learner.device=cpu", *settings]), time.process_time()
    with tempfile.TemporaryDirectory() as folder, Store[Segment](Path(folder) / "store") as store:
        loop = config.build(store)
        *_, last = loop.run()
    if isinstance(loop.learner, TreePlanner):
        return of_tree(loop.learner, last.metrics, step_rewards(loop.reward), time.process_time() - begin)
    many = cast(PlannerSettings, config.learner).model_copy(update={"evaluation_episodes": EPISODES})
    planner = many.build(config.build_task(), streams(seed, 0).build)
    planner.load(loop.learner.state())
    measuring = time.process_time()
    found = planner.evaluate(loop.reward, streams(seed, 0).evaluate).metrics
    metrics, now = last.metrics, time.process_time()
    steps = {"real_steps": int(metrics["steps/learn"]), "imagined_steps": int(metrics["steps/imagined"])}
    costs = {"cpu_s": round(now - begin, 1), "evaluation_cpu_s": round(now - measuring, 1)}
    return {"gold": round(found["gold"], 1), "labels": int(metrics["label/asked"]), **steps, **costs}


def of_tree(planner: Any, metrics: dict[str, float], reward: Any, cpu: float) -> dict[str, Any]:
    """What a tree search came to, and in what share of the states it takes an action of value iteration's on the world
    as it was learned, by the learned reward; its values are those of the last search."""
    from prefrl.envs import exact
    from prefrl.envs.tabular import GridworldSettings

    best = exact.value_iteration(planner.learned(reward))
    taken = best[np.arange(len(best)), planner.values.argmax(1)]
    true = GridworldSettings().world().mdp
    steps = {"real_steps": int(metrics["steps/learn"]), "imagined_steps": int(metrics["steps/imagined"])}
    said = {"gold": round(metrics["evaluate/gold"], 2), "labels": int(metrics["label/asked"]), "cpu_s": round(cpu, 1)}
    agreement = round(float((taken >= best.max(1) - 1e-6).mean()), 3)
    regret = round(exact.regret(true, exact.greedy(planner.values)), 4)
    return {**said, **steps, "evaluation_cpu_s": 0.0, "agreement": agreement, "regret": regret}


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
        **{name: [run[name] for run in runs] for name in ("agreement", "regret") if name in runs[0]},
    }


if __name__ == "__main__":
    main()
