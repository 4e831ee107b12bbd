"""A reward of few comparisons, optimised farther and farther: does gold turn back, and does a cautious ensemble help?

    python benchmarks/text_caution.py [--by worst|lower] [--seeds 5] [--first 100] [--labels 60] [--rounds 4] [--short]

For each seed five heads are fitted once, on comparisons of what the start writes to the rubric of reviews, and then
`prefrl improve` learns from them for some rounds at a price of 0.02 a nat: once from their mean, once from the cautious
combination. Nothing is asked on the way, so the reward knows less and less of what the policy says. Runs lie in
runs/caution/, where those that are there are taken up.

`turned_back`: of the mean, the best round's gold less the last one's. `learned_rose`: what the learned score did
between the two. `gold_gain`, `fluency_gain`: cautious less mean at equal KL, `nats`, the farthest that both of a seed's
runs come to; the mean over seeds with a 95 % bootstrap interval over them (from five seeds; the range below that). The
last line is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np
from text_best_of_n import FEW, interval

from prefrl.evaluate.summary import read_metrics
from prefrl.types import Floats

PRESET = "text/reviews-rubric"
MEASURED = ("gold", "fluency", "learned", "kl")
SHORT = ("learner.updates=2", "learner.evaluation_prompts=32")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--by", choices=("worst", "lower"), default="worst")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=100, help="the first seed")
    parser.add_argument("--labels", type=int, default=60, help="comparisons of the start")
    parser.add_argument("--rounds", type=int, default=4, help="of 25 updates each")
    parser.add_argument("--out", type=Path, default=Path("runs/caution"))
    parser.add_argument("--short", action="store_true", help="two small runs of one seed")
    options = parser.parse_args()
    rows = [compared(seed, options) for seed in range(options.first, options.first + (options.seeds, 1)[options.short])]
    print(
        json.dumps({"name": f"text_caution: {options.by} of five, {PRESET}"} | account(rows) | {"short": options.short})
    )


def compared(seed: int, options: Any) -> dict[str, Any]:
    """Both runs of a seed, round by round, and what caution changed where both have come as far."""
    end = "-short" if options.short else ""
    fitted = options.out / f"reward-{options.labels}-{seed}{end}"
    few = [f"seed={seed}", "reward.members=5", "loop.rounds=1", f"loop.labels={options.labels}", "learner.updates=1"]
    go("run", PRESET, *few, *SHORT[1:], "--out", str(fitted))
    curves = {}
    for by in ("mean", options.by):
        far = [f"seed={seed}", f"reward.combine.by={by}", f"loop.rounds={options.rounds}", "learner.updates=25"]
        far += ["learner.beta=0.02", "learner.schedule=constant", *(SHORT if options.short else ())]
        folder = options.out / f"{by}-{options.labels}-{options.rounds}-{seed}{end}"
        go("improve", PRESET, "--reward", str(fitted), *far, "--out", str(folder))
        curves[by] = np.array([[row[f"evaluate/{name}"] for name in MEASURED] for row in read_metrics(folder)])
    row = {"seed": seed, **measured(curves["mean"], curves[options.by])}
    print(json.dumps(row | {by: curve.round(2).tolist() for by, curve in curves.items()}), flush=True)
    return row


def go(*arguments: str) -> None:
    subprocess.run([sys.executable, "-m", "prefrl", *arguments], check=True, stdout=subprocess.DEVNULL)


def measured(plain: Floats, cautious: Floats) -> dict[str, float]:
    """Each (rounds + 1, 4), the columns of `MEASURED`."""
    best = int(plain[:, 0].argmax())
    nats = min(plain[:, 3].max(), cautious[:, 3].max())
    found = {"nats": nats, "turned_back": plain[best, 0] - plain[-1, 0], "learned_rose": plain[-1, 2] - plain[best, 2]}
    for column, name in enumerate(("gold", "fluency")):
        found[f"{name}_gain"] = at(cautious, nats, column) - at(plain, nats, column)
        found[f"{name}_mean"] = at(plain, nats, column)
    return {name: float(value) for name, value in found.items()}


def at(curve: Floats, nats: float, column: int) -> float:
    """A run's value where it first was so far from its start, between rounds on a straight line."""
    far = np.maximum.accumulate(curve[:, 3])
    return float(np.interp(nats, far, curve[:, column]))


def account(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """`ours`, `peer`, `ratio` and `spread` are of gold at equal KL, the peer being the mean."""
    values = {name: np.array([row[name] for row in rows]) for name in rows[0] if name != "seed"}
    made: dict[str, Any] = {name: mean(values[name]) for name in ("nats", "turned_back", "learned_rose")}
    for name in ("gold_gain", "fluency_gain"):
        made |= {name: mean(values[name]), f"{name}_interval": interval(values[name])}
    peer = mean(values["gold_mean"])
    made |= {"ours": peer + made["gold_gain"], "peer": peer, "ratio": 1 + made["gold_gain"] / peer}
    made |= {"spread": made["gold_gain_interval"]}
    made = {name: np.round(x, 3).tolist() for name, x in made.items()}
    how = "bootstrap" if len(rows) >= FEW else "range"
    return made | {"unit": "gold", "intervals": how, "seeds": [row["seed"] for row in rows], "equal_work": True}


if __name__ == "__main__":
    main()
