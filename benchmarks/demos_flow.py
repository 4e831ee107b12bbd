"""Two ways round a disc: clones of an expert who goes either way, and what gradients and comparisons make of them.

    python benchmarks/demos_flow.py [--methods gaussian flow tuned side] [--seeds 5] [--first 100] [--short]
        [--to docs/curves/flow_fork]

Twenty demonstrations of `task.kind=fork`. `gaussian` and `flow`: clones, with as many passes and layers as wide; of the
Gaussian the mode counts, which does better than what it draws, and of the flow what it draws. `tuned`: both after
50,000 steps of the same policy gradient on the true reward (the Gaussian's plans are one action). `side`: the flow
after 200 comparisons of whole episodes, which an oracle answers that wants the left side, and 50,000 steps. Scores are
the shares of 500 episodes that get to the goal; `left` are the shares of these that pass on the left. Writes TO.svg,
the clones' ways of the first seed; the last line is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from matplotlib.figure import Figure
from matplotlib.patches import Circle

from prefrl.config import Config
from prefrl.envs.toys import DISC, GOAL, GOAL_SIZE, ForkSettings
from prefrl.improve import control
from prefrl.improve.clone import CloneSettings
from prefrl.improve.control import ControlLearner, ControlLearnerSettings
from prefrl.improve.offline import Offline
from prefrl.label.expert import ExpertSettings
from prefrl.policies.acting import played
from prefrl.policies.rollout import Rollout, whole_episodes
from prefrl.protocols import StepRewardModel
from prefrl.store import Store
from prefrl.types import Segment

EPISODES, SHOWN, ROUNDS = 500, 20, 5
METHODS = ("gaussian", "flow", "tuned", "side")
HIDDEN, STD = (128, 128), 0.7
POLICIES: dict[str, dict[str, Any]] = {
    "gaussian": {"hidden": HIDDEN, "initial_std": STD},
    "flow": {"kind": "flow", "hidden": HIDDEN},
}
CLONES: dict[str, dict[str, Any]] = {"gaussian": {"hidden": HIDDEN, "std": STD}, "flow": {"policy": POLICIES["flow"]}}
LEARNER: dict[str, Any] = {
    "environments": 25,
    "steps_per_round": 10_000,
    "rollout_steps": 100,
    "epochs": 10,
    "minibatch": 128,
    "learning_rate": 3e-4,
    "clip": 0.1,
    "entropy": 0.0,
    "target_kl": None,
    "schedule": "constant",
    "rollback": None,
    "device": "cpu",
}
TASK = ForkSettings().build()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--methods", nargs="+", choices=METHODS, default=list(METHODS))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--to", type=Path, default=Path("docs/curves/flow_fork"))
    parser.add_argument("--short", action="store_true", help="one seed, clones alone; draws nothing")
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.short:
        options.seeds, options.methods = 1, ["gaussian", "flow"]
    seeds = list(range(options.first, options.first + options.seeds))
    found: dict[str, list[dict[str, float]]] = {}
    for seed in seeds:
        for name, scores in of_seed(seed, options).items():
            found.setdefault(name, []).append(scores)
            print(f"{name} {seed}: {scores}", flush=True)
    each = {name: [run["gold"] for run in runs] for name, runs in found.items()}
    print(
        json.dumps(
            {
                "name": f"demos_flow: the fork, {SHOWN} demonstrations",
                "unit": "share of episodes that reach the goal",
                "gold": {name: round(statistics.mean(golds), 3) for name, golds in each.items()},
                "golds": each,
                "left": {name: [run["left"] for run in runs] for name, runs in found.items()},
                "cpu": {name: round(statistics.median(r["cpu"] for r in runs), 1) for name, runs in found.items()},
                "seeds": seeds,
                "equal_work": True,
                "short": options.short,
            }
        )
    )


def of_seed(seed: int, options: argparse.Namespace) -> dict[str, dict[str, float]]:
    """Scores by what was done: clones, `tuned gaussian`, `tuned flow` and `side`."""
    kinds = ["gaussian", "flow"] if "tuned" in options.methods else [k for k in POLICIES if k in options.methods]
    clones: dict[str, Offline[Any]] = {}
    found: dict[str, dict[str, float]] = {}
    for kind in kinds:
        begin = time.process_time()
        clones[kind] = clone(kind, seed)
        found[kind] = scored(clones[kind], kind, seed, begin)
    if not options.short and seed == options.first and len(clones) == 2:
        draw(clones, seed, options.to)
    for kind in kinds if "tuned" in options.methods else ():
        begin = time.process_time()
        found[f"tuned {kind}"] = scored(tuned(clones[kind], kind, seed), kind, seed, begin)
    if "side" in options.methods:
        begin = time.process_time()
        found["side"] = scored(sided(clones["flow"], seed), "flow", seed, begin)
    return found


def clone(kind: str, seed: int) -> Offline[Any]:
    rng = np.random.default_rng(seed)
    with tempfile.TemporaryDirectory() as folder, Store[Segment](folder) as store:
        ExpertSettings(episodes=SHOWN).build(TASK).answer(store, rng)
        learner = CloneSettings.model_validate(CLONES[kind]).build(TASK, rng)
        learner.improve(cast(Any, None), store, rng)
    return learner


def from_clone(learner: ControlLearner, start: Offline[Any]) -> ControlLearner:
    """With the clone's policy, as `learner.start` takes it over from a run."""
    start.policy.freeze()
    learner.policy.load(start.policy.state())
    return learner


def tuned(start: Offline[Any], kind: str, seed: int) -> ControlLearner:
    """On the true reward, in place of the scores of a reward model."""
    kept = control.learned_rewards, control.step_rewards
    control.learned_rewards = lambda reward, rollout: rollout.gold
    control.step_rewards = lambda reward: cast(StepRewardModel, reward)
    settings, nothing = LEARNER | {"policy": POLICIES[kind]}, cast(Any, None)
    learner = ControlLearnerSettings.model_validate(settings).build(TASK, np.random.default_rng(seed))
    from_clone(learner, start)
    for number in range(ROUNDS):
        learner.pace(number / ROUNDS, (number + 1) / ROUNDS)
        learner.improve(nothing, nothing, np.random.default_rng([seed, number]))
    control.learned_rewards, control.step_rewards = kept
    return learner


def sided(start: Offline[Any], seed: int) -> ControlLearner:
    """The loop of control/fork-left, from the clone."""
    config = Config.load("control/fork-left", [f"seed={seed}", "learner.device=cpu"])
    with tempfile.TemporaryDirectory() as folder, Store[Segment](folder) as store:
        loop = config.build(store)
        learner = cast(ControlLearner, loop.learner)
        from_clone(learner, start)
        for _ in loop.run():
            pass
    return learner


def acted(learner: Offline[Any] | ControlLearner, kind: str, episodes: int, seed: int) -> Rollout:
    """The Gaussian's mode, and what the flow draws."""
    rng = None if kind == "gaussian" else np.random.default_rng([seed, 8])
    return whole_episodes(TASK, played(learner.actor(), rng), episodes, np.random.default_rng([seed, 9]))


def scored(learner: Offline[Any] | ControlLearner, kind: str, seed: int, begin: float) -> dict[str, float]:
    cpu = time.process_time() - begin
    rollout = acted(learner, kind, EPISODES, seed)
    there = rollout.gold.sum(1) > 0
    assert rollout.states is not None
    left = (rollout.states[there, -1, 3] < 0).mean() if there.any() else np.nan
    return {"gold": round(float(there.mean()), 3), "left": round(float(left), 3), "cpu": round(cpu, 1)}


def draw(clones: dict[str, Offline[Any]], seed: int, to: Path) -> None:
    figure = Figure(figsize=(7.0, 3.8), layout="constrained")
    for ax, (kind, title) in zip(
        figure.subplots(1, 2), {"gaussian": "Gaussian", "flow": "flow, plans of 4"}.items(), strict=True
    ):
        rollout = acted(clones[kind], kind, 40, seed)
        assert rollout.states is not None
        for states, gold in zip(rollout.states, rollout.gold.sum(1), strict=True):
            ax.plot(*states[:, :2].T, color="C0" if gold else "C3", lw=0.8, alpha=0.6)
        ax.add_patch(Circle((0, 0), DISC, color="0.8"))
        ax.add_patch(Circle(tuple(GOAL), GOAL_SIZE, color="C1", alpha=0.5))
        ax.set(title=title, aspect="equal", xlim=(-1.5, 1.5), ylim=(-1.1, 1.3), xticks=[], yticks=[])
    figure.savefig(to.with_suffix(".svg"))


if __name__ == "__main__":
    main()
