"""A denoiser from comparisons of its pictures: pictures/digits, read by a classifier that had no part in it.

    python benchmarks/worlds_pictures.py [--seeds 5] [--first 100] [--short]
    python benchmarks/worlds_pictures.py --set learner.diversity=0 --set learner.beta=0.005       (without the remedy)

`hits` is the share of 1000 fresh pictures that are the caption's digit to a support vector machine that was fitted on
the half of the digits which the gold, and so the oracle, never saw. `kl` is in nats a picture, exact given its chain,
and `spread` is that of the hits alone, as a share of that of real digits: the root of the summed variance of all
pixels. `pictures` counts what was drawn to be asked about and to learn from, not for evaluation; `seconds` are those of
one CPU, without those of the starting denoiser, which is made once. The last line is one JSON object: means over seeds,
with `ours` and `ratio` for hits and what the starting denoiser's are in `peer`.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
from pathlib import Path
from time import process_time
from typing import Any, cast

import numpy as np

from prefrl.config import Config
from prefrl.envs.digits import DIGITS, Digits, deviation, flat
from prefrl.improve.pictures import PictureLearner
from prefrl.policies.denoiser import DenoiserPolicy
from prefrl.store import Store

MEASURED = 1000


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--set", action="append", default=[], help="dotted.key=value, several times")
    parser.add_argument("--preset", default="pictures/digits")
    parser.add_argument("--short", action="store_true", help="one seed")
    options = parser.parse_args()
    rows = []
    for seed in range(options.first, options.first + (1 if options.short else options.seeds)):
        rows.append(run(Config.load(options.preset, [*options.set, f"seed={seed}"])))
        print(f"seed {seed}: " + ", ".join(f"{name} {value:.4g}" for name, value in rows[-1].items()), flush=True)
    found = {name: round(statistics.mean(row[name] for row in rows), 4) for name in rows[0]}
    each = {name: [round(row[name], 4) for row in rows] for name in ("hits", "kl", "spread")}
    print(
        json.dumps(
            {"name": f"worlds_pictures: {options.preset} {' '.join(options.set)}".strip(), "unit": "share of hits"}
            | {"ours": found["hits"], "peer": found["start_hits"]}
            | {"ratio": round(found["hits"] / max(found["start_hits"], 1e-9), 3), "equal_work": False}
            | found
            | {"each": each, "seeds": len(rows), "short": options.short}
        )
    )


def run(config: Config) -> dict[str, float]:
    """One run, and what came of it."""
    with tempfile.TemporaryDirectory() as folder, Store[Any](Path(folder)) as store:
        loop = config.build(store)
        task, learner = cast(Digits, loop.task), cast(PictureLearner, loop.learner)
        before, begin = measure(task, learner.policy), process_time()
        rounds = list(loop.run())
        seconds = process_time() - begin
        after, spent = measure(task, learner.policy), learner.steps
        labels = rounds[-1].metrics["label/answered"]
    return after | {
        "labels": labels,
        "pictures": float(spent.learn + spent.query),
        "seconds": seconds,
        "ratio_error": max(one.metrics.get("improve/ratio_error", 0.0) for one in rounds),
        "start_hits": before["hits"],
        "start_spread": before["spread"],
    }


def measure(task: Digits, policy: DenoiserPolicy) -> dict[str, float]:
    """Of as many pictures of each digit's caption as make about `MEASURED` together: means over captions."""
    captions, reader = [one for one in task.captions if one in DIGITS], task.reader()
    hits, spreads, kls = [], [], []
    for caption in captions:
        chains = policy.draw([caption] * (MEASURED // len(captions)), np.random.default_rng(12345))
        pixels = flat(chains.candidates(task.captions))
        hit = reader.predict(pixels) == DIGITS[caption]
        real = task.pixels[task.digits == DIGITS[caption]].reshape(-1, pixels.shape[1]) / 255
        hits.append(float(hit.mean()))
        spreads.append(deviation(pixels[hit]) / deviation(real) if hit.sum() > 1 else 0.0)
        kls.append(float(policy.kl(chains).sum(1).mean()))
    return {"hits": statistics.mean(hits), "spread": statistics.mean(spreads), "kl": statistics.mean(kls)}


if __name__ == "__main__":
    main()
