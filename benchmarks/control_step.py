"""Steps per second of the fast environments, against stable-baselines3's DummyVecEnv and gymnasium's SyncVectorEnv.

    python benchmarks/control_step.py [--env HalfCheetah-v5] [--peer sb3 | gymnasium] [--windows 7] [--short]

16 environments each and the same random actions; windows take turns in one process, with one thread, and what counts
is CPU time. `ratio` is ours / peer: above 1, prefrl steps faster. The last line is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from typing import Any

import gymnasium
import numpy as np
from gymnasium.vector import SyncVectorEnv
from stable_baselines3.common.vec_env import DummyVecEnv

from prefrl.envs.fast.wrapped import make
from prefrl.envs.sb3 import FastVecEnv
from prefrl.envs.vector import FastVectorEnv

ENVIRONMENTS = 16


def _pair(name: str, peer: str) -> tuple[Any, Any]:
    single = [lambda: make(name)] * ENVIRONMENTS
    if peer == "sb3":
        return FastVecEnv(name, ENVIRONMENTS), DummyVecEnv(single)
    return FastVectorEnv(name, ENVIRONMENTS), SyncVectorEnv(single)


def _rate(envs: Any, actions: np.ndarray) -> float:
    begun = time.process_time()
    for row in actions:
        envs.step(row)
    return len(actions) * ENVIRONMENTS / (time.process_time() - begun)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--peer", choices=["sb3", "gymnasium"], default="sb3")
    parser.add_argument("--windows", type=int, default=7)
    parser.add_argument("--short", action="store_true", help="three small windows a side")
    options = parser.parse_args()
    windows, steps = (3, 60) if options.short else (options.windows, 300)
    sides = _pair(options.env, options.peer)
    space = gymnasium.vector.utils.batch_space(make(options.env).action_space, ENVIRONMENTS)
    space.seed(0)
    for envs in sides:
        envs.reset()
    rates: tuple[list[float], list[float]] = ([], [])
    for _ in range(windows):
        actions = np.stack([space.sample() for _ in range(steps)])
        for envs, found in zip(sides, rates, strict=True):
            found.append(_rate(envs, actions))
    ratios = [ours / peer for ours, peer in zip(*rates, strict=True)]
    found = {
        "name": f"control_step {options.env} against {options.peer}",
        "unit": "steps per CPU second",
        "ours": round(statistics.median(rates[0])),
        "peer": round(statistics.median(rates[1])),
        "ratio": round(statistics.median(ratios), 2),
        "spread": [round(min(ratios), 2), round(max(ratios), 2)],
        "equal_work": True,
        "short": options.short,
    }
    print(json.dumps(found))


if __name__ == "__main__":
    main()
