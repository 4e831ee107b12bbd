"""Gold and fluency over the KL to the start: every learner of text on one task, and best-of-n, in one figure.

    python benchmarks/text_frontier.py [--seeds 2] [--first 100] [--out runs/frontier] [--to docs/curves/text_frontier]
        [--short]

The task is the rubric of reviews, which fewer than one in a hundred of the start's responses meet, with 300 comparisons
in four rounds. Learners that write have 30 batches of 128 responses in each. A point is an evaluation after a round,
the mean over seeds. Best-of-n is by the reward model of the first RLOO run, as in text_best_of_n.py. Finished runs are
taken up. Writes TO.csv and TO.svg; the last line is one JSON object: for each learner where it ended.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from text_best_of_n import AT_ONCE, Size, curves_of

from prefrl.evaluate.best_of_n import kl_bound
from prefrl.evaluate.summary import read_metrics
from prefrl.rundir import open_saved
from prefrl.stages import policy_of, reward_of

TASK = ("task.gold=rubric", "loop.labels=300", "loop.rounds=4")
WRITES = (*TASK, "learner.updates=30", "learner.schedule=linear")
LEARNERS: dict[str, tuple[str, tuple[str, ...]]] = {
    "RLOO": ("text/reviews-rubric", ()),
    "RLOO, worst of three": ("text/reviews-rubric", ("reward.combine.by=worst",)),
    "PPO": ("text/reviews-ppo", (*WRITES, "learner.beta=0.2", "learner.critic.network=shared")),
    "online DPO": ("text/reviews-online-dpo", (*WRITES, "learner.beta=0.2")),
    "RAFT": ("text/reviews-raft", (*WRITES, "learner.beta=0.2")),
    "DPO": ("text/reviews-dpo", TASK),
    "KTO": ("text/reviews-dpo", (*TASK, "learner.kind=kto", "learner.epochs=4", "learner.evaluation_prompts=256")),
    "SFT": ("text/reviews-dpo", (*TASK, "learner.kind=sft", "learner.epochs=4", "learner.evaluation_prompts=256")),
}
SHORT = ("loop.rounds=1", "loop.labels=40", "learner.evaluation_prompts=32")
MEASURES = {"gold": "gold: share of the rubric", "fluency": "fluency: share of whole reviews"}
POOL = Size(prompts=64, pool=256)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--first", type=int, default=100, help="the first seed")
    parser.add_argument("--out", type=Path, default=Path("runs/frontier"))
    parser.add_argument("--to", type=Path, default=Path("docs/curves/text_frontier"))
    parser.add_argument("--short", action="store_true", help="a small run of each")
    options = parser.parse_args()
    seeds = [options.first] if options.short else range(options.first, options.first + options.seeds)
    rows: list[dict[str, Any]] = []
    for seed in seeds:
        for name in LEARNERS:
            rows += rounds_of(name, seed, options.out, options.short)
            print(json.dumps(rows[-1]), flush=True)
    first = folder_of("RLOO", options.first, options.out)
    rows += best_of_n(first, options.first, Size(8, 16) if options.short else POOL)
    options.to.parent.mkdir(parents=True, exist_ok=True)
    with options.to.with_suffix(".csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    draw(rows).savefig(options.to.with_suffix(".svg"))
    ends = {name: ends_of(rows, name) for name in LEARNERS}
    print(json.dumps({"name": "text_frontier", "unit": "gold, KL", "ends": ends, "short": options.short}))


def rounds_of(name: str, seed: int, out: Path, short: bool) -> list[dict[str, Any]]:
    """A row for each round of a run, which is made, or taken up where it stopped."""
    preset, settings = LEARNERS[name]
    folder = folder_of(name, seed, out)
    small = (*SHORT, *(["learner.updates=2"] if preset != "text/reviews-dpo" else ())) if short else ()
    command = [sys.executable, "-m", "prefrl", "run", preset, f"seed={seed}", *settings, *small, "--out", str(folder)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return [row(name, seed, m["round"], *(m[f"evaluate/{x}"] for x in ("kl", *MEASURES))) for m in read_metrics(folder)]


def folder_of(name: str, seed: int, out: Path) -> Path:
    return out / f"{name.lower().replace(', ', '-').replace(' ', '-')}-{seed}"


def row(name: str, seed: int, number: float, kl: float, gold: float, fluency: float) -> dict[str, Any]:
    found = {"learner": name, "seed": seed, "round_or_n": int(number)}
    return found | {"kl": round(kl, 4), "gold": round(gold, 4), "fluency": round(fluency, 4)}


def best_of_n(folder: Path, seed: int, size: Size) -> list[dict[str, Any]]:
    """A row for each n that is a power of two, at the bound of its KL."""
    policy, task = policy_of(folder, at_start=True), open_saved(folder).config.build_task()
    prompts, rng = task.evaluation_prompts(size.prompts, np.random.default_rng([seed, 1])), np.random.default_rng(seed)
    base = []
    for at in range(0, len(prompts), AT_ONCE):
        drawn = policy.respond(prompts[at : at + AT_ONCE], size.pool, rng, policy.sampling(size.pool, temperature=1.0))
        base += drawn.candidates(task.tokenizer)
    curves = curves_of(base, reward_of(folder, task), task, size)
    counts = [2**i for i in range(size.pool.bit_length())]
    return [row("best-of-n", seed, n, float(kl_bound(n)), *(float(curves[x][n - 1]) for x in MEASURES)) for n in counts]


def ends_of(rows: list[dict[str, Any]], name: str) -> dict[str, float]:
    """Means over seeds of the last round's."""
    last = max(r["round_or_n"] for r in rows if r["learner"] == name)
    found = [r for r in rows if r["learner"] == name and r["round_or_n"] == last]
    return {x: round(float(np.mean([r[x] for r in found])), 3) for x in ("kl", *MEASURES)}


def draw(rows: list[dict[str, Any]]) -> Figure:
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    axes: list[Axes] = list(figure.subplots(1, len(MEASURES)))
    for (measure, label), ax in zip(MEASURES.items(), axes, strict=True):
        ax.set(xlabel="KL to the start, nats a response", ylabel=label, ylim=(0, 1))
        ax.grid(color="0.9")
        ax.spines[["top", "right"]].set_visible(False)
        for name in ("best-of-n", *LEARNERS):
            kl, value = over_rounds(rows, name, measure)
            style = {"color": "0.3", "linestyle": "--", "linewidth": 2} if name == "best-of-n" else {"marker": "o"}
            ax.plot(kl, value, label=name, markersize=4, **style)
    axes[1].legend(frameon=False, ncols=2, loc="lower left")
    return figure


def over_rounds(rows: list[dict[str, Any]], name: str, measure: str) -> tuple[list[float], list[float]]:
    """KL and measure after each round, means over seeds."""
    own = [r for r in rows if r["learner"] == name]
    numbers = sorted({r["round_or_n"] for r in own})
    means = [[float(np.mean([r[x] for r in own if r["round_or_n"] == n])) for n in numbers] for x in ("kl", measure)]
    return means[0], means[1]


if __name__ == "__main__":
    main()
