"""What comparisons are worth: a learner on the reward fitted on them, against the same learner on the true reward.

    python benchmarks/control_labels.py [--envs HalfCheetah-v5 Hopper-v5 Walker2d-v5 Swimmer-v5] [--seeds 5]
    python benchmarks/control_labels.py --envs HalfCheetah-v5 --wrong 0.1      (a tenth of the answers turned round)

Both sides are the environment's preset, with as many steps and the same seeds; episodes have a fixed horizon. One asks
an oracle for so many comparisons, the other is given the true reward of each step, shifted to mean 0 and scaled to std
1 as fitted rewards are. Afterwards 20 episodes of the last policy's mode are scored by the true reward.

Runs are kept in OUT, taken up where they stopped, and their curves written to OUT/curves.csv. `ratio` is ours / peer of
the interquartile means over seeds; the last line is one JSON object.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from control_ppo import EPISODES, interval
from scipy.stats import trim_mean

from prefrl.config import Config
from prefrl.improve import control
from prefrl.improve.control import ControlLearner
from prefrl.policies.rollout import Rollout, whole_episodes
from prefrl.protocols import ControlTask, RewardModel, StepRewardModel, Store
from prefrl.types import Floats, Segment

ENVS = ["HalfCheetah-v5", "Hopper-v5", "Walker2d-v5", "Swimmer-v5"]


class TrueReward:
    """The simulator's, with mean 0 and std 1 over all that was seen: with a fixed horizon a shift changes nothing."""

    def __init__(self) -> None:
        self._count, self._sum, self._squares = 0, 0.0, 0.0

    def __call__(self, reward: StepRewardModel, rollout: Rollout) -> Floats:
        gold = rollout.gold
        self._count += gold.size
        self._sum += float(gold.sum())
        self._squares += float((gold**2).sum())
        mean = self._sum / self._count
        return (gold - mean) / (np.sqrt(self._squares / self._count - mean**2) + 1e-8)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--envs", nargs="+", default=ENVS)
    parser.add_argument("--labels", type=int, default=700)
    parser.add_argument("--wrong", type=float, default=0.0, help="the share of answers that are turned round")
    parser.add_argument("--steps", type=int, default=1_000_000, help="of learning, about: whole rounds of the preset")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=100, help="the first seed")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="settings of both sides")
    parser.add_argument("--out", type=Path, default=Path("runs/control-labels"))
    parser.add_argument("--short", action="store_true", help="one seed of the first environment, few steps and labels")
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.short:
        options.envs, options.seeds, options.steps, options.labels = options.envs[:1], 1, 100_000, 100
    found = {env: measure(env, options) for env in options.envs}
    ratios = {env: round(one["ours"] / one["peer"], 3) for env, one in found.items()}
    answers = f"{options.labels} comparisons" + (f", {options.wrong:.0%} of them wrong" if options.wrong else "")
    print(
        json.dumps(
            {
                "name": f"control_labels: {answers}, against the true reward, {options.steps} steps",
                "unit": "true return, interquartile mean",
                **{side: {env: one[side] for env, one in found.items()} for side in ("ours", "peer")},
                "ratio": min(ratios.values()),
                "ratios": ratios,
                "spread": {env: one["spread"] for env, one in found.items()},
                "returns": {env: one["returns"] for env, one in found.items()},
                "seeds": list(range(options.first, options.first + options.seeds)),
                "equal_work": True,
                "short": options.short,
            }
        )
    )


def measure(env: str, options: argparse.Namespace) -> dict[str, Any]:
    """Both sides on all seeds."""
    sides = {"ours": from_labels, "peer": from_truth}
    returns: dict[str, list[float]] = {side: [] for side in sides}
    for seed in range(options.first, options.first + options.seeds):
        for side, learn in sides.items():
            curve = learn(env, seed, options)
            returns[side].append(curve[-1][1])
            print(f"{env} {side} {seed}: {curve[-1][1]:.1f}", flush=True)
            write(options.out / "curves.csv", (env, side, options.wrong, seed), curve)
    means = {side: round(float(trim_mean(values, 0.25)), 1) for side, values in returns.items()}
    return means | {"spread": {side: interval(values) for side, values in returns.items()}, "returns": returns}


def from_labels(env: str, seed: int, options: argparse.Namespace) -> list[tuple[int, float]]:
    """(steps of learning, true return) after each round of a run."""
    config = configured(env, seed, options)
    name = "-".join([env, str(config.loop.rounds), str(options.labels), str(options.wrong), *options.set, str(seed)])
    folder = options.out / name.replace("/", "-")
    file = options.out / f"{folder.name}.yaml"
    options.out.mkdir(parents=True, exist_ok=True)
    file.write_text(config.dump())
    command = [sys.executable, "-m", "prefrl", "run", str(file), "--out", str(folder)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    return [(int(row["steps/learn"]), float(row["evaluate/gold"])) for row in rows]


def from_truth(env: str, seed: int, options: argparse.Namespace) -> list[tuple[int, float]]:
    """The same of the learner alone, on the true reward."""
    config = configured(env, seed, options)
    name = "-".join([env, str(config.loop.rounds), "true", *options.set, str(seed)]).replace("/", "-")
    kept = options.out / f"{name}.json"
    if not kept.exists():
        options.out.mkdir(parents=True, exist_ok=True)
        kept.write_text(json.dumps(list(_from_truth(config, seed))))
    return [(int(steps), float(gold)) for steps, gold in json.loads(kept.read_text())]


def _from_truth(config: Config, seed: int) -> Iterator[tuple[int, float]]:
    # In place of the scores of a reward model.
    control.learned_rewards = TrueReward()  # type: ignore[assignment]
    control.step_rewards = lambda reward: cast(StepRewardModel, reward)
    task, rng = cast(ControlTask, config.build_task()), np.random.default_rng(seed)
    learner = cast(ControlLearner, config.build_learner(task, rng))
    yield 0, gold(task, learner)
    for number in range(1, config.loop.rounds + 1):
        learner.pace((number - 1) / config.loop.rounds, number / config.loop.rounds)
        learner.improve(cast(RewardModel[Segment], None), cast(Store[Segment], None), rng)
        yield learner.steps.learn, gold(task, learner)


def gold(task: ControlTask, learner: ControlLearner) -> float:
    """The mean true return of the policy's mode."""
    act = learner._act(None)
    return float(whole_episodes(task, act, EPISODES, np.random.default_rng(9)).gold.sum(1).mean())


def configured(env: str, seed: int, options: argparse.Namespace) -> Config:
    """The environment's preset, with so many labels and steps."""
    preset = f"control/{env.split('-')[0].lower()}"
    each = Config.load(preset, options.set).learner.work()
    asked = [f"loop.labels={options.labels}", f"loop.rounds={max(2, round(options.steps / each))}"]
    wrong = [f"labeler.mistake_rate={options.wrong}"] if options.wrong else []
    return Config.load(preset, [*options.set, *asked, *wrong, f"seed={seed}", "learner.device=cpu"])


def write(file: Path, names: tuple[object, ...], curve: list[tuple[int, float]]) -> None:
    """Add a curve to the table; what is there of the same names is replaced."""
    head, own = ["env", "side", "wrong", "seed", "steps", "gold"], [str(name) for name in names]
    rows = list(csv.reader(file.open()))[1:] if file.exists() else []
    rows = [row for row in rows if row[:4] != own] + [[*own, str(steps), f"{gold:.2f}"] for steps, gold in curve]
    with file.open("w", newline="") as table:
        csv.writer(table).writerows([head, *rows])


if __name__ == "__main__":
    main()
