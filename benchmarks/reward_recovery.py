"""Is a planted reward found again? 2,000 comparisons of segments, all right or 30 % of them wrong.

    python benchmarks/reward_recovery.py [--short] [--seeds N]

A linear reward and one of a network are planted; an ensemble of three MLPs is fitted by the settings below, the same
for all rewards. `ours` is the smallest correlation with the planted scores on 2,000 fresh segments over all seeds
and both rewards, with right labels, and `with_mistakes` the same with 30 % wrong ones. There is no peer: `peer` holds
the targets, 0.99 and 0.95. A network whose units saturate is harder; what becomes of it is reported beside them.
"""

from __future__ import annotations

import argparse
import json

import numpy as np
import torch
from planted import Planted, agreement, compare, model

from prefrl.fit.settings import FittingSettings
from prefrl.fit.trainer import fit_judged

MISTAKES = 0.3
FORMS = ("linear", "network", "steep network")
RIGHT = FittingSettings(epochs=200, learning_rate=3e-3, held_out=0.05, bootstrap=False)
"""Right answers cannot be fitted too well: no early stop."""
NOISY = FittingSettings(
    epochs=100, patience=20, learning_rate=3e-3, held_out=0.1, bootstrap=False, error_rate=2 * MISTAKES
)
"""Wrong is half of blind, so an error rate of twice the mistakes."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--short", action="store_true", help="one seed: under two minutes")
    parser.add_argument("--seeds", type=int, default=3)
    options = parser.parse_args()
    torch.set_num_threads(1)
    every: dict[tuple[str, float], list[float]] = {(form, m): [] for form in FORMS for m in (0.0, MISTAKES)}
    for seed in range(1 if options.short else options.seeds):
        for (form, mistakes), correlations in every.items():
            correlations.append(round(run(form, mistakes, seed), 4))
            print(f"{form} reward, {mistakes:.0%} mistakes, seed {seed}: {correlations[-1]}", flush=True)
    found = {m: every["linear", m] + every["network", m] for m in (0.0, MISTAKES)}
    print(
        json.dumps(
            {
                "name": "reward_recovery: correlation with a planted reward, 2,000 comparisons",
                "unit": "correlation",
                "ours": min(found[0.0]),
                "peer": 0.99,
                "ratio": round(min(found[0.0]) / 0.99, 4),
                "spread": found[0.0],
                "with_mistakes": min(found[MISTAKES]),
                "with_mistakes_target": 0.95,
                "with_mistakes_spread": found[MISTAKES],
                "steep": every["steep network", 0.0],
                "steep_with_mistakes": every["steep network", MISTAKES],
                "equal_work": True,
                "short": options.short,
            }
        )
    )


def run(form: str, mistakes: float, seed: int) -> float:
    rng = np.random.default_rng(seed)
    planted = Planted(form, rng)
    judged = compare(planted, 2000, mistakes, "", rng)
    reward = model(3, rng)
    fit_judged(reward, judged, NOISY if mistakes else RIGHT, rng)
    return agreement(reward, planted, rng)[0]


if __name__ == "__main__":
    main()
