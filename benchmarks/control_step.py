"""Steps per second of the fast environments, against stable-baselines3's DummyVecEnv and gymnasium's SyncVectorEnv.

    python benchmarks/control_step.py [--env HalfCheetah-v5] [--peer sb3 | gymnasium] [--windows 7] [--short]
    python benchmarks/control_step.py --threads 2 [--env HalfCheetah-v5] [--environments 16]

16 environments each and the same random actions; windows take turns in one process, with one thread, and what counts
is CPU time. `ratio` is ours / peer: above 1, prefrl steps faster. The last line is one JSON object.

With `--threads` ours on so many threads is compared with ours on one, in steps per second on the clock. Each call is
timed for itself, a few after a pause; the quickest 2 % count, which beside other work are those that nothing cut short.
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

PAUSE, BURST = 0.004, 6
"""Seconds for which a burst of so many calls is waited with: a scheduler lets run who has slept."""


def _pair(options: argparse.Namespace) -> tuple[Any, Any]:
    name, count = options.env, options.environments
    if options.threads > 1:
        return FastVectorEnv(name, count, threads=options.threads), FastVectorEnv(name, count)
    single = [lambda: make(name)] * count
    if options.peer == "sb3":
        return FastVecEnv(name, count), DummyVecEnv(single)
    return FastVectorEnv(name, count), SyncVectorEnv(single)


def _rate(envs: Any, actions: np.ndarray) -> float:
    begun = time.process_time()
    for row in actions:
        envs.step(row)
    return actions.shape[0] * actions.shape[1] / (time.process_time() - begun)


def _quickest(envs: Any, actions: np.ndarray) -> float:
    seconds = []
    for number, row in enumerate(actions):
        if number % BURST == 0:
            time.sleep(PAUSE)
        begun = time.perf_counter()
        envs.step(row)
        seconds.append(time.perf_counter() - begun)
    return actions.shape[1] / float(np.quantile(seconds, 0.02))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--peer", choices=["sb3", "gymnasium"], default="sb3")
    parser.add_argument("--environments", type=int, default=16)
    parser.add_argument("--threads", type=int, default=1, help="more than 1: ours on so many against ours on one")
    parser.add_argument("--windows", type=int, default=7)
    parser.add_argument("--short", action="store_true", help="three small windows a side")
    options = parser.parse_args()
    threads = options.threads
    windows, steps = (3, 60) if options.short else (options.windows, 300)
    sides, measure = _pair(options), _rate if threads == 1 else _quickest
    space = gymnasium.vector.utils.batch_space(make(options.env).action_space, options.environments)
    space.seed(0)
    for envs in sides:
        envs.reset()
    rates: tuple[list[float], list[float]] = ([], [])
    for _ in range(windows):
        actions = np.stack([space.sample() for _ in range(steps)])
        for envs, found in zip(sides, rates, strict=True):
            found.append(measure(envs, actions))
    ratios = [ours / peer for ours, peer in zip(*rates, strict=True)]
    found = {
        "name": f"control_step {options.env} against {options.peer if threads == 1 else 'one thread'}",
        "unit": "steps per CPU second" if threads == 1 else f"steps per second, {threads} threads",
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
