"""Does the fit find out whom to believe? Three good labelers (5 % wrong) and two who answer at random.

    python benchmarks/reward_labelers.py [--short] [--seeds N]

Each labeler compares 400 pairs of their own: nobody sees a pair that somebody else sees. The reward is that of a
steep network. Three fits of the same model by the same settings: on everybody with `fitting.reliability=learned`, on
everybody with all labelers alike, and on the good labelers alone. `ours` is the mean accuracy on fresh pairs of the
first, `peer` that of the last; `ratio` compares them. `worst_error` is the largest distance from an estimated to a
true error rate; the target is 0.05, and 0.02 for the accuracy.
"""

from __future__ import annotations

import argparse
import json

import numpy as np
import torch
from planted import Planted, agreement, compare, model

from prefrl.fit.settings import FittingSettings
from prefrl.fit.trainer import fit_judged

RATES = {"ann": 0.05, "bob": 0.05, "cem": 0.05, "dee": 0.5, "eli": 0.5}
SETTINGS = FittingSettings(epochs=60, patience=10, weight_decay="adaptive")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--short", action="store_true", help="one seed: under two minutes")
    parser.add_argument("--seeds", type=int, default=5)
    options = parser.parse_args()
    torch.set_num_threads(1)
    runs = []
    for seed in range(1 if options.short else options.seeds):
        runs.append(run(seed))
        print(f"seed {seed}: {runs[-1]}", flush=True)
    mean = {key: float(np.mean([r[key] for r in runs])) for key in ("learned", "alike", "good")}
    print(
        json.dumps(
            {
                "name": "reward_labelers: three good labelers and two at random, 400 pairs each",
                "unit": "accuracy on fresh pairs",
                "ours": round(mean["learned"], 4),
                "peer": round(mean["good"], 4),
                "ratio": round(mean["learned"] / mean["good"], 4),
                "spread": [round(r["learned"] - r["good"], 4) for r in runs],
                "alike": round(mean["alike"], 4),
                "worst_error": round(max(r["worst"] for r in runs), 4),
                "mean_error": round(float(np.mean([r["worst"] for r in runs])), 4),
                "equal_work": True,
                "short": options.short,
            }
        )
    )


def run(seed: int) -> dict[str, float]:
    rng = np.random.default_rng(seed)
    planted = Planted("steep network", rng)
    judged = [one for name, rate in RATES.items() for one in compare(planted, 400, rate, name, rng)]
    wrong = {name: np.mean([_wrong(one, planted) for one in judged if one.judgement.labeler == name]) for name in RATES}
    good = [one for one in judged if RATES[one.judgement.labeler] < 0.5]
    ways = {"learned": (judged, "learned"), "alike": (judged, "alike"), "good": (good, "alike")}
    found = {}
    for name, (some, reliability) in ways.items():
        reward = model(3, np.random.default_rng(seed))
        settings = SETTINGS.model_copy(update={"reliability": reliability})
        fitted = fit_judged(reward, some, settings, np.random.default_rng(seed))
        found[name] = agreement(reward, planted, np.random.default_rng(1000 + seed))[1]
        if name == "learned":
            found |= {n: fitted.metrics[f"error_rate/{n}"] for n in RATES}
            found["worst"] = max(abs(fitted.metrics[f"error_rate/{n}"] - wrong[n]) for n in RATES)
    return {name: round(float(value), 4) for name, value in found.items()}


def _wrong(one, planted: Planted) -> bool:
    first, second = (planted.score(c) for c in one.query.candidates)
    return bool(one.judgement.preference != float(first > second))


if __name__ == "__main__":
    main()
