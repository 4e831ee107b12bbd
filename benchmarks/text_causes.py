"""Why a policy gradient lies below best-of-n on short reviews: one cause at a time, at equal KL, by the same reward.

    python benchmarks/text_causes.py [--seeds 5] [--first 0] [--only CAUSE ...] [--out runs/causes] [--to FILE]
        [--short]

Each cause changes one thing in `text/reviews`. What a run's policy says, and the best of n of the start by that run's
newest reward, are compared as in text_best_of_n.py. Beside both stands what is best at this KL: the start tilted by
exp(score / beta), by weights on the pool. So `gold_gain` is what the learner loses to a choice among n responses, and
`optimum_gain` what it loses to the optimum of its own objective. Seeds from 0 on: presets are chosen by this.

Runs that are there are taken up, and their rows kept. Writes FILE.csv and FILE.svg (docs/curves/text_causes); the last
line is one JSON object: for each change the mean over seeds.
"""

from __future__ import annotations

import argparse
import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from text_best_of_n import SHORT, Size, compared, finished

TASK, BASE = "text/reviews", "as it is"
CAUSES: dict[str, dict[str, tuple[str, ...]]] = {
    "the reward's errors": {
        "40 labels": ("loop.labels=40",),
        BASE: (),
        "600 labels": ("loop.labels=600",),
        "worst of three heads": ("reward.combine.by=worst",),
    },
    "what is maximised": {
        BASE: (),
        "win rate": ("learner.score=win_rate", "learner.beta=0.12"),
        "log of the rank": ("learner.score=log_quantile", "learner.beta=0.14"),
        "the same, 25 updates": ("learner.score=log_quantile", "learner.beta=0.14", "learner.updates=25"),
    },
    "the learning rate": {
        "2e-4": ("learner.learning_rate=2e-4",),
        BASE: (),
        "1e-3": ("learner.learning_rate=1e-3",),
        "falling": ("learner.schedule=linear",),
    },
    "updates in a round": {
        BASE: (),
        "25": ("learner.updates=25",),
        "75": ("learner.updates=75",),
        "75, falling rate": ("learner.updates=75", "learner.schedule=linear"),
    },
    "where the KL stands": {
        BASE: (),
        "off the advantage": ("learner.kl_in=advantage",),
        "of each token": ("learner.kl_in=token",),
    },
    "a stale reward": {
        "1 round of 24": ("loop.rounds=1", "learner.updates=24"),
        BASE: (),
        "6 rounds of 4": ("loop.rounds=6", "learner.updates=4"),
    },
    "responses in a batch": {
        "32": ("learner.prompts=4",),
        BASE: (),
        "512": ("learner.prompts=64",),
    },
}
COLUMNS = ("cause", "change", "seed", "kl", "gold", "best_gold", "optimum_gold", "fluency", "best_fluency")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=0, help="the first seed")
    parser.add_argument("--only", nargs="+", choices=tuple(CAUSES), default=list(CAUSES), metavar="CAUSE")
    parser.add_argument("--out", type=Path, default=Path("runs/causes"))
    parser.add_argument("--to", type=Path, help="docs/curves/text_causes, or beside the runs where they are small")
    parser.add_argument("--short", action="store_true", help="a small run of two changes")
    options = parser.parse_args()
    size = SHORT if options.short else Size(prompts=64, pool=64)
    to = options.to or (options.out / "short" if options.short else Path("docs/curves/text_causes"))
    seeds = range(options.first, options.first + (1 if options.short else options.seeds))
    asked = options.only[:1] if options.short else options.only
    table, rows = to.with_suffix(".csv"), read(to.with_suffix(".csv"))
    for seed in seeds:
        for cause in asked:
            for change in list(CAUSES[cause])[: 2 if options.short else None]:
                if any((r["cause"], r["change"], r["seed"]) == (cause, change, seed) for r in rows):
                    continue
                known = next((r for r in rows if change == BASE == r["change"] and r["seed"] == seed), None)
                found = known or measured(cause, change, seed, size, options.out)
                rows.append(found | {"cause": cause})
                write(rows, table)
                print(json.dumps(rows[-1]), flush=True)
    draw(rows).savefig(to.with_suffix(".svg"), metadata={"Date": None}, facecolor="white")
    print(json.dumps({"name": f"text_causes: {TASK}", "unit": "gold", "gains": gains(rows), "short": options.short}))


def measured(cause: str, change: str, seed: int, size: Size, out: Path) -> dict[str, Any]:
    """A row: a run, which is made or taken up, against best-of-n and the optimum."""
    settings = (*CAUSES[cause][change], *size.settings)
    of = f"{cause} {change}".replace(" ", "-")
    folder = finished(TASK, "rloo", seed, Size(size.prompts, size.pool, settings), out / of)
    found = compared(folder, seed, size)
    return {"cause": cause, "change": change, "seed": seed} | {x: round(found[x], 4) for x in COLUMNS[3:]}


def read(file: Path) -> list[dict[str, Any]]:
    if not file.exists():
        return []
    with file.open(newline="") as opened:
        found = list(csv.DictReader(opened))
    return [{x: value if x in COLUMNS[:2] else json.loads(value) for x, value in one.items()} for one in found]


def write(rows: list[dict[str, Any]], file: Path) -> None:
    file.parent.mkdir(parents=True, exist_ok=True)
    with file.open("w", newline="") as opened:
        writer = csv.DictWriter(opened, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def gains(rows: list[dict[str, Any]]) -> dict[str, dict[str, float]]:
    """Means over seeds of each change."""
    found = {}
    for cause, change in dict.fromkeys((r["cause"], r["change"]) for r in rows):
        own = [r for r in rows if (r["cause"], r["change"]) == (cause, change)]
        means = {x: float(np.mean([r[x] for r in own])) for x in COLUMNS[3:]}
        found[f"{cause}: {change}"] = {
            "kl": round(means["kl"], 2),
            "gold_gain": round(means["gold"] - means["best_gold"], 3),
            "optimum_gain": round(means["gold"] - means["optimum_gold"], 3),
            "fluency_gain": round(means["fluency"] - means["best_fluency"], 3),
            "seeds": len(own),
        }
    return found


def draw(rows: list[dict[str, Any]]) -> Figure:
    """A panel for each cause, a line for each change: small dots are seeds, large ones and bars their means."""
    causes = [cause for cause in CAUSES if any(r["cause"] == cause for r in rows)]
    figure = Figure(figsize=(11, 2.3 * -(-len(causes) // 2)), layout="constrained")
    axes = figure.subplots(-(-len(causes) // 2), 2, sharex=True, squeeze=False).ravel()
    for ax, cause in zip(axes, causes, strict=False):
        own = [r for r in rows if r["cause"] == cause]
        labels = [change for change in CAUSES[cause] if any(r["change"] == change for r in own)]
        for measure, colour, shift in (("gold", "#1f5fa8", 0.12), ("fluency", "0.6", -0.12)):
            for y, change in enumerate(reversed(labels)):
                gaps = [r[measure] - r[f"best_{measure}"] for r in own if r["change"] == change]
                ax.plot(gaps, [y + shift] * len(gaps), ".", color=colour, markersize=5, alpha=0.5)
                ax.plot(np.mean(gaps), y + shift, "o", color=colour, label=measure if y == 0 else None)
                if measure == "gold":
                    best = [r["optimum_gold"] - r["best_gold"] for r in own if r["change"] == change]
                    label = "gold of the optimum for raw scores" if y == 0 else None
                    ax.plot(np.mean(best), y + shift, "|", color="0.2", markersize=11, markeredgewidth=2, label=label)
        kls = {c: np.mean([r["kl"] for r in own if r["change"] == c]) for c in labels}
        ax.set_yticks(range(len(labels)), [f"{c}\n{kls[c]:.2f} nats" for c in reversed(labels)])
        ax.set(ylim=(-0.5, len(labels) - 0.5))
        ax.set_title(cause, loc="left", fontsize=10)
        ax.axvline(0, color="0.3", linewidth=1, linestyle="--")
        ax.grid(axis="x", color="0.93")
        ax.spines[["top", "right"]].set_visible(False)
        ax.set_xlabel("less best-of-n, at equal KL", fontsize=8)
        ax.tick_params(labelsize=8, labelbottom=True)
    for ax in axes[len(causes) :]:
        ax.set_axis_off()
    figure.legend(*axes[0].get_legend_handles_labels(), frameon=False, loc="lower right")
    return figure


if __name__ == "__main__":
    main()
