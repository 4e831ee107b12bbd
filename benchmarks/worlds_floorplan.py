"""Floorplans: a policy against greedy placement and simulated annealing, and learned from comparisons.

    python benchmarks/worlds_floorplan.py --net n10 [--seeds 5] [--first 100] [--out runs/worlds-floorplan] [--short]
    python benchmarks/worlds_floorplan.py --net n30

The learner of control/floorplan on a GSRC netlist (shared/data/floorplan), three times: on the true wire length; on a
hidden objective, 1 x wire length + 0.5 x congestion, each in units of a random plan's, as its reward; and on the reward
that is fitted from 200 comparisons by that objective (n10 alone). Lengths and times are of one thread.

`mean_over_greedy` is the wire length of the plans that the trained policy draws, over that of greedy placement on the
wire mask, 64 plans each; `mode_over_greedy` is that of its mode. `best_over_annealing` is the best plan of the whole
run over the best of 16 chains of annealing on the same grid, and `time_ratio` the CPU time of ours over theirs.
`gain_kept` is how far below a random plan the hidden objective is after learning from comparisons, as a share of what
learning from itself gives; `gain_kept_over_greedy` is measured from greedy plans on. `legal` is the share of all steps
of all learning that were legal. Finished seeds are taken up. The last line is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch

from prefrl.config import Config
from prefrl.envs.chips import Chip
from prefrl.envs.floorplan import FloorplanTask
from prefrl.envs.plans import CELLS, CONGESTION, WIRE, Floorplan, greedy_plans, random_plans
from prefrl.improve import control
from prefrl.policies.acting import Actor, played
from prefrl.policies.rollout import Rollout, learned_rewards, whole_episodes
from prefrl.protocols import StepRewardModel
from prefrl.store import Store
from prefrl.types import Bools, Floats, Integers, Segment

DATA = Path(__file__).resolve().parents[2] / "shared" / "data" / "floorplan"
ROUNDS = {"n10": 20, "n30": 30}
HIDDEN = (1.0, 0.5)
PLANS, CHAINS, MOVES = 64, 16, 30_000
HOT, COLD = 0.03, 0.0003
"""Temperatures of annealing, as shares of a random plan's wire length."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--net", choices=[*ROUNDS], default="n10")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--out", type=Path, default=Path("runs/worlds-floorplan"))
    parser.add_argument("--short", action="store_true", help="one seed, and a fifth of the learning and annealing")
    options = parser.parse_args()
    torch.set_num_threads(1)
    found = []
    for seed in range(options.first, options.first + (1 if options.short else options.seeds)):
        kept = options.out / f"{options.net}{'-short' if options.short else ''}-{seed}.json"
        if not kept.exists():
            row = one_seed(options.net, seed, 5 if options.short else 1)
            kept.parent.mkdir(parents=True, exist_ok=True)
            kept.write_text(json.dumps(row))
        found.append(json.loads(kept.read_text()))
        print(seed, found[-1], flush=True)
    print(json.dumps(summed(options.net, found) | {"short": options.short}))


def summed(net: str, rows: Sequence[dict[str, float]]) -> dict[str, Any]:
    means = {name: round(statistics.mean(row[name] for row in rows), 4) for name in rows[0]}
    name, ratios = f"worlds_floorplan: {net}", [row["mean_over_greedy"] for row in rows]
    shared = {"unit": "wire length over greedy", "ours": means["mean_over_greedy"], "peer": 1.0}
    spread = {"ratio": means["mean_over_greedy"], "spread": [min(ratios), max(ratios)], "equal_work": False}
    return {"name": name} | shared | spread | means | {"seeds": len(rows)}


def one_seed(net: str, seed: int, less: int) -> dict[str, float]:
    """All that is measured with one seed."""
    rounds = max(2, ROUNDS[net] // less)
    config = settings(net, seed, rounds, (1.0, 0.0))
    begun = time.process_time()
    actor, truth = on_truth(config, rounds)
    ours = time.process_time() - begun
    task = config.task.build()  # type: ignore[attr-defined]
    begun = time.process_time()
    annealed = float(annealing(task.world, MOVES // less, seed).min())
    theirs = time.process_time() - begun
    greedy = greedy_plans(task.world, PLANS, np.random.default_rng(seed))[:, [WIRE, CONGESTION]].mean(0)
    row = {
        "mean_over_greedy": float(drawn(task, actor, seed)[:, 0].mean() / greedy[0]),
        "mode_over_greedy": float(drawn(task, actor, None)[:, 0].mean() / greedy[0]),
        "best_over_greedy": float(truth.best / greedy[0]),
        "best_over_annealing": float(truth.best / annealed),
        "annealing_over_greedy": float(annealed / greedy[0]),
        "seconds": ours,
        "time_ratio": ours / theirs,
        "legal": truth.legal,
    }
    return row | (kept_of_the_gain(net, seed, rounds, greedy) if net == "n10" else {})


def kept_of_the_gain(net: str, seed: int, rounds: int, greedy: Floats) -> dict[str, float]:
    """The hidden objective after learning from itself, and from 200 comparisons by it."""
    config = settings(net, seed, rounds, HIDDEN)
    task = config.task.build()  # type: ignore[attr-defined]
    true = drawn(task, on_truth(config, rounds)[0], seed) @ HIDDEN
    begun = time.process_time()
    learned = drawn(task, on_comparisons(config), seed) @ HIDDEN
    spent = time.process_time() - begun
    usual = random_plans(task.world, PLANS, np.random.default_rng(seed))[:, [WIRE, CONGESTION]] @ HIDDEN
    gains = [(start - learned.mean()) / (start - true.mean()) for start in (usual.mean(), greedy @ HIDDEN)]
    values = {"hidden_true": true, "hidden_learned": learned, "hidden_random": usual, "hidden_greedy": greedy @ HIDDEN}
    ratios = {"gain_kept": float(gains[0]), "gain_kept_over_greedy": float(gains[1]), "seconds_comparisons": spent}
    return ratios | {name: float(np.mean(value)) for name, value in values.items()}


def settings(net: str, seed: int, rounds: int, weights: tuple[float, float]) -> Config:
    """Those of control/floorplan, for another netlist."""
    macros = int(net[1:])
    told = [
        f"task.netlist={json.dumps(str(DATA / f'{net}.hardblocks'))}",
        f"task.wire_weight={weights[0]}",
        f"task.congestion_weight={weights[1]}",
        f"learner.steps_per_round={64 * 4 * (macros + 1)}",
        f"learner.rollout_steps={macros + 1}",
        f"loop.rounds={rounds}",
        "loop.labels=200",
        f"seed={seed}",
    ]
    return Config.load("control/floorplan", told)


class Truth:
    """The gold as the reward; it keeps the best plan's, and counts what was legal."""

    def __init__(self, weights: Floats) -> None:
        self.best, self.legal = np.inf, 1.0
        self._weights = weights

    def __call__(self, reward: StepRewardModel, rollout: Rollout) -> Floats:
        assert rollout.legal is not None
        self.legal = min(self.legal, float((rollout.choices * rollout.legal).sum() / rollout.choices.sum()))
        whole = rollout.final_observations[rollout.ends][:, 2:4]
        self.best = min(self.best, float((whole @ self._weights).min()))
        return rollout.gold * rollout.gold.shape[1]


def on_truth(config: Config, rounds: int) -> tuple[Actor, Truth]:
    """What the learner learns where the gold is its reward."""
    task: Any = config.task
    built, rng = task.build(), np.random.default_rng(config.seed)
    learner: Any = config.learner.build(built, rng)  # type: ignore[attr-defined]
    reward = config.reward.build(built, rng)  # type: ignore[attr-defined]
    truth = Truth(np.array([task.wire_weight, task.congestion_weight]))
    control.learned_rewards = truth
    try:
        for number in range(rounds):
            learner.pace(number / rounds, (number + 1) / rounds)
            learner.improve(reward, None, rng)
    finally:
        control.learned_rewards = learned_rewards
    return learner.actor(), truth


def on_comparisons(config: Config) -> Actor:
    """What the whole loop learns, which sees answers and no gold."""
    with tempfile.TemporaryDirectory() as folder, Store[Segment](Path(folder)) as store:
        loop = config.build(store)
        for _ in loop.run():
            pass
        learner: Any = loop.learner
        actor: Actor = learner.actor()
        return actor


def drawn(task: FloorplanTask, actor: Actor, seed: int | None) -> Floats:
    """(n, 2) wire length and congestion of whole plans, drawn from a policy; one plan, its mode, without a seed."""
    rng = None if seed is None else np.random.default_rng(seed)
    rollout = whole_episodes(task, played(actor, rng), 1 if seed is None else PLANS, np.random.default_rng(0))
    return rollout.final_observations[:, -1, 2:4].astype(np.float64)


# --- simulated annealing ----------------------------------------------------------------------------------------


def annealing(world: Floorplan, moves: int, seed: int) -> Floats:
    """(CHAINS,) the least wire length that each chain met with, in units of a random plan's.

    A move shifts a macro, at first by up to the whole chip and ever less far, or swaps the corners of two; one after
    which macros overlap is not made. Kirkpatrick et al. 1983, on the same grid as the policy's; the temperature falls
    geometrically. All chains are stepped side by side.
    """
    rng, chip = np.random.default_rng(seed), world.chip
    corners = chip.corners(random_plans(world, CHAINS, rng)[:, CELLS:].astype(np.int64))
    lengths = wire(chip, corners)
    best, usual, every = lengths.copy(), lengths.mean(), np.arange(CHAINS)
    for move in range(moves):
        done = move / moves
        trial = moved(chip, corners, max(1, round(chip.grid * (1 - done))), rng)
        fits = whole(chip, trial)
        after = np.full(CHAINS, np.inf)
        if fits.any():
            after[fits] = wire(chip, trial[fits])
        taken = every[np.log(rng.random(CHAINS)) < (lengths - after) / (usual * HOT * (COLD / HOT) ** done)]
        corners[taken], lengths[taken] = trial[taken], after[taken]
        best = np.minimum(best, lengths)
    return best / world.units.wire


def moved(chip: Chip, corners: Integers, reach: int, rng: np.random.Generator) -> Integers:
    """(n, M, 2): one move of each chain."""
    trial, every = corners.copy(), np.arange(len(corners))
    first = rng.integers(chip.macros, size=len(corners))
    second = (first + rng.integers(1, chip.macros, size=len(corners))) % chip.macros
    trial[every, first] += rng.integers(-reach, reach + 1, size=(len(corners), 2))
    swaps = rng.random(len(corners)) < 0.3
    trial[every[swaps], first[swaps]] = corners[every[swaps], second[swaps]]
    trial[every[swaps], second[swaps]] = corners[every[swaps], first[swaps]]
    return trial


def whole(chip: Chip, corners: Integers) -> Bools:
    """(n,) whether all macros lie inside, and none on another."""
    low, high = corners, corners + chip.spans
    inside = ((low >= 0) & (high <= chip.grid)).all((1, 2))
    apart = ((high[:, :, None] <= low[:, None]) | (low[:, :, None] >= high[:, None])).any(-1)  # (n, M, M)
    found: Bools = inside & (apart | np.eye(chip.macros, dtype=bool)).all((1, 2))
    return found


def wire(chip: Chip, corners: Integers) -> Floats:
    return chip.wire(chip.boxes(corners[..., 1] * chip.grid + corners[..., 0]))


if __name__ == "__main__":
    main()
