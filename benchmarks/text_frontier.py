"""Gold beside another measure over the KL to the start: every learner of text, and best-of-n, in one figure.

    python benchmarks/text_frontier.py [--task rubric|imdb] [--seeds 2] [--first 100] [--out runs/frontier] [--to FILE]
        [--learners RLOO PPO ...] [--short]

`rubric`: the rubric of reviews, which fewer than one in a hundred of the start's responses meet, with 300 comparisons
in four rounds. Learners that write have 30 batches of 128 responses in each. The other measure is fluency.

`imdb`: film reviews by SmolLM2, with VADER as the reward: the measures are that proxy and the gold. Learners are the
preset with another algorithm: 36 batches of 48 responses in six rounds, and adapters of rank 2 in the queries and
values. `wide` are adapters of rank 16 in all linear layers, 24 batches in eight rounds and a lower price of a nat.

A point is an evaluation after a round, the mean over seeds. Best-of-n is by the reward of the first RLOO run, as in
text_best_of_n.py. Finished runs are taken up. With `--learners` only those run, and what FILE.csv has of others and of
other seeds is kept. Writes FILE.csv and FILE.svg (docs/curves/text_frontier, and
text_frontier_imdb); the last line is one JSON object: for each learner where it ended.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from text_best_of_n import AT_ONCE, Size, curves_of, measures

from prefrl.evaluate.best_of_n import kl_bound
from prefrl.evaluate.summary import read_metrics
from prefrl.rundir import open_saved
from prefrl.stages import policy_of, reward_of

BEST = "best-of-n"
Runs = dict[str, tuple[str, tuple[str, ...]]]
"""A preset and its settings, by the name of the learner."""

RUBRIC = ("task.gold=rubric", "loop.labels=300", "loop.rounds=4")
WRITES = (*RUBRIC, "learner.updates=30", "learner.schedule=linear")
ON_RUBRIC: Runs = {
    "RLOO": ("text/reviews-rubric", ()),
    "RLOO, worst of three": ("text/reviews-rubric", ("reward.combine.by=worst",)),
    "GRPO": ("text/reviews-rubric", ("learner.algorithm=grpo",)),
    "REINFORCE": ("text/reviews-rubric", ("learner.algorithm=reinforce",)),
    "PPO": ("text/reviews-ppo", (*WRITES, "learner.beta=0.2", "learner.critic.network=shared")),
    "online DPO": ("text/reviews-online-dpo", (*WRITES, "learner.beta=0.2")),
    "RAFT": ("text/reviews-raft", (*WRITES, "learner.beta=0.2")),
    "DPO": ("text/reviews-dpo", RUBRIC),
    "KTO": ("text/reviews-dpo", (*RUBRIC, "learner.kind=kto", "learner.epochs=4", "learner.evaluation_prompts=256")),
    "SFT": ("text/reviews-dpo", (*RUBRIC, "learner.kind=sft", "learner.epochs=4", "learner.evaluation_prompts=256")),
}
FILMS = ("learner.evaluation_prompts=64",)
WIDE = (
    "loop.rounds=8", "learner.updates=3", "learner.beta=0.01", "learner.learning_rate=4e-4",
    "learner.policy.train=lora", "learner.policy.lora_rank=16", "learner.policy.lora_targets=all-linear",
    "learner.evaluation_prompts=96",
)  # fmt: skip
ON_FILMS: Runs = {
    "RLOO": ("text/imdb", FILMS),
    "GRPO": ("text/imdb", (*FILMS, "learner.algorithm=grpo")),
    "REINFORCE": ("text/imdb", (*FILMS, "learner.algorithm=reinforce")),
    "PPO": ("text/imdb", (*FILMS, "learner.algorithm=ppo", "learner.epochs=2")),
    "RLOO, wide": ("text/imdb", WIDE),
    "online DPO, wide": ("text/imdb", (*WIDE, "learner.kind=online_dpo", "learner.prompts=24", "learner.soft=true")),
    "RAFT, wide": ("text/imdb", (*WIDE, "learner.kind=raft", "learner.prompts=6", "learner.minibatch=6")),
}


@dataclass(frozen=True)
class World:
    runs: Runs
    measures: dict[str, str]
    """What an evaluation measures, and its label."""
    pool: Size
    short: tuple[str, ...]


WORLDS = {
    "rubric": World(
        ON_RUBRIC,
        {"gold": "gold: share of the rubric", "fluency": "fluency: share of whole reviews"},
        Size(prompts=64, pool=256),
        ("loop.rounds=1", "loop.labels=40", "learner.evaluation_prompts=32"),
    ),
    "imdb": World(
        ON_FILMS,
        {"learned": "proxy: VADER's score", "gold": "gold: probability of a positive review"},
        Size(prompts=32, pool=32),
        ("loop.rounds=1", "learner.evaluation_prompts=8", "learner.prompts=2"),
    ),
}

NAMES = list(dict.fromkeys([*ON_RUBRIC, *ON_FILMS, BEST]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", choices=tuple(WORLDS), default="rubric")
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--learners", nargs="+", choices=NAMES, help="only these; what the file has of others is kept")
    parser.add_argument("--first", type=int, default=100, help="the first seed")
    parser.add_argument("--out", type=Path, help="runs/frontier, or runs/frontier-imdb")
    parser.add_argument("--to", type=Path, help="docs/curves/text_frontier, or text_frontier_imdb")
    parser.add_argument("--short", action="store_true", help="a small run of each")
    options = parser.parse_args()
    world, tail = WORLDS[options.task], "" if options.task == "rubric" else f"_{options.task}"
    out = options.out or Path(f"runs/frontier{tail.replace('_', '-')}")
    to = options.to or Path(f"docs/curves/text_frontier{tail}")
    seeds = [options.first] if options.short else range(options.first, options.first + options.seeds)
    asked = options.learners or [*world.runs, BEST]
    rows = [] if options.learners is None else kept(to.with_suffix(".csv"), asked, seeds)
    for seed in seeds:
        for name in (name for name in asked if name != BEST):
            rows += rounds_of(world, name, seed, out, options.short)
            print(json.dumps(rows[-1]), flush=True)
    if BEST in asked:
        rows += best_of_n(world, folder_of("RLOO", options.first, out), options.first, options.short)
    to.parent.mkdir(parents=True, exist_ok=True)
    with to.with_suffix(".csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)
    draw(world, rows).savefig(to.with_suffix(".svg"))
    ends = {name: ends_of(world, rows, name) for name in asked if name != BEST}
    found = {"name": f"text_frontier: {options.task}", "unit": "gold, KL"}
    print(json.dumps(found | {"ends": ends, "short": options.short}))


def kept(file: Path, learners: Collection[str], seeds: Collection[int]) -> list[dict[str, Any]]:
    """The rows of a file that are not to be made anew; none without a file."""
    if not file.exists():
        return []
    with file.open(newline="") as opened:
        rows = list(csv.DictReader(opened))
    found = [{x: value if x == "learner" else json.loads(value) for x, value in one.items()} for one in rows]
    return [one for one in found if one["learner"] not in learners or one["seed"] not in seeds]


def rounds_of(world: World, name: str, seed: int, out: Path, short: bool) -> list[dict[str, Any]]:
    """A row for each round of a run, which is made, or taken up where it stopped."""
    preset, settings = world.runs[name]
    folder = folder_of(name, seed, out)
    small = (*world.short, *(["learner.updates=2"] if preset != "text/reviews-dpo" else ())) if short else ()
    command = [sys.executable, "-m", "prefrl", "run", preset, f"seed={seed}", *settings, *small, "--out", str(folder)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    names = ("kl", *world.measures)
    found = [{x: m[f"evaluate/{x}"] for x in names} | {"round": m["round"]} for m in read_metrics(folder)]
    return [row(name, seed, m.pop("round"), m) for m in found]


def folder_of(name: str, seed: int, out: Path) -> Path:
    return out / f"{name.lower().replace(', ', '-').replace(' ', '-')}-{seed}"


def row(name: str, seed: int, number: float, values: dict[str, float]) -> dict[str, Any]:
    found = {"learner": name, "seed": seed, "round_or_n": int(number)}
    return found | {x: round(float(value), 4) for x, value in values.items()}


def best_of_n(world: World, folder: Path, seed: int, short: bool) -> list[dict[str, Any]]:
    """A row for each n that is a power of two, at the bound of its KL."""
    policy, task = policy_of(folder, at_start=True), open_saved(folder).config.build_task()
    size = Size(8, 16) if short else world.pool
    prompts, rng = task.evaluation_prompts(size.prompts, np.random.default_rng([seed, 1])), np.random.default_rng(seed)
    base = []
    for at in range(0, len(prompts), AT_ONCE):
        drawn = policy.respond(prompts[at : at + AT_ONCE], size.pool, rng, policy.sampling(size.pool, temperature=1.0))
        base += drawn.candidates(task.tokenizer)
    judged = reward_of(folder, task).score(base)
    curves = curves_of(judged, measures(base, task) | {"learned": judged}, size.pool)
    counts = [2**i for i in range(size.pool.bit_length())]
    values = [{"kl": kl_bound(n)} | {x: curves[x][n - 1] for x in world.measures} for n in counts]
    return [row(BEST, seed, n, found) for n, found in zip(counts, values, strict=True)]


def ends_of(world: World, rows: list[dict[str, Any]], name: str) -> dict[str, float]:
    """Means over seeds of the last round's."""
    last = max(r["round_or_n"] for r in rows if r["learner"] == name)
    found = [r for r in rows if r["learner"] == name and r["round_or_n"] == last]
    return {x: round(float(np.mean([r[x] for r in found])), 3) for x in ("kl", *world.measures)}


def draw(world: World, rows: list[dict[str, Any]]) -> Figure:
    figure = Figure(figsize=(11, 4.6), layout="constrained")
    axes: list[Axes] = list(figure.subplots(1, len(world.measures)))
    for (measure, label), ax in zip(world.measures.items(), axes, strict=True):
        ax.set(xlabel="KL to the start, nats a response", ylabel=label, ylim=(0, 1))
        ax.grid(color="0.9")
        ax.spines[["top", "right"]].set_visible(False)
        for name in (name for name in (BEST, *world.runs) if any(r["learner"] == name for r in rows)):
            kl, value = over_rounds(rows, name, measure)
            style = {"color": "0.3", "linestyle": "--", "linewidth": 2} if name == BEST else {"marker": "o"}
            ax.plot(kl, value, label=name, markersize=4, **style)
    axes[1].legend(frameon=False, ncols=2, loc="lower left" if "fluency" in world.measures else "lower right")
    return figure


def over_rounds(rows: list[dict[str, Any]], name: str, measure: str) -> tuple[list[float], list[float]]:
    """KL and measure after each round, means over seeds."""
    own = [r for r in rows if r["learner"] == name]
    numbers = sorted({r["round_or_n"] for r in own})
    means = [[float(np.mean([r[x] for r in own if r["round_or_n"] == n])) for n in numbers] for x in ("kl", measure)]
    return means[0], means[1]


if __name__ == "__main__":
    main()
