"""Fitting a reward model on segments: ours against imitation's trainer, on the same pairs.

    python benchmarks/reward_fit.py [--short] [--peers .venv-peers-control/bin/python]

500 pairs of segments of 100 steps (HalfCheetah's sizes: 17 observations, 6 actions), one epoch in minibatches of 32
pairs, AdamW, the same network (32x32, 64x64, 256x256x256; ReLU, imitation's default), one thread. imitation's
`BasicRewardTrainer` with its `CrossEntropyRewardLoss` gets the pairs in its own dataset, ready made; ours gets
judgements, and everything from them on counts: batching, stacking, the split's graph, the epoch, normalisation and
the measured losses. Sides take turns in one process group; CPU seconds, medians of the repetitions. `ratio` is
peer / ours at width 32. `ensemble` is our time for three members at width 64 over that for one, in turns as well.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

WIDTHS = {"32": (32, 32), "64": (64, 64), "256": (256, 256, 256)}
TARGETS = {"32": 10.0, "64": 5.0, "256": 1.2}
PAIRS, STEPS, OBSERVATION, ACTION, MINIBATCH, RATE = 500, 100, 17, 6, 32, 1e-3
ONE_THREAD = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--short", action="store_true", help="few repetitions: under two minutes")
    parser.add_argument("--repetitions", type=int, default=15)
    parser.add_argument("--peers", default=".venv-peers-control/bin/python", help="Python that has imitation")
    parser.add_argument("--worker", choices=["ours", "peer"], help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        serve(options.worker)
        return
    if not Path(options.peers).exists():
        sys.exit(f"no {options.peers}: run `make peers`, or install benchmarks/peers-control.txt and say --peers")
    print(json.dumps(compare(options.peers, 3 if options.short else options.repetitions) | {"short": options.short}))


def compare(peers: str, repetitions: int) -> dict[str, Any]:
    """Both sides in turn, each in a process that lives throughout."""
    sides = {"ours": start("ours", sys.executable), "peer": start("peer", os.path.abspath(peers))}
    times: dict[str, dict[str, list[float]]] = {name: {} for name in sides}
    for repetition in range(repetitions + 1):
        for name, side in sides.items():
            for width in [*WIDTHS, *(["64x3"] if name == "ours" else [])]:
                seconds = ask(side, width)
                if repetition:  # the first one warms up
                    times[name].setdefault(width, []).append(seconds)
        print(f"repetition {repetition} of {repetitions}", flush=True)
    for side in sides.values():
        side.terminate()
    median = {name: {w: statistics.median(v) for w, v in of.items()} for name, of in times.items()}
    ratios = {width: round(median["peer"][width] / median["ours"][width], 2) for width in WIDTHS}
    return {
        "name": f"reward_fit: {PAIRS} pairs of {STEPS} steps, one epoch",
        "unit": "CPU s",
        "ours": round(median["ours"]["32"], 4),
        "peer": round(median["peer"]["32"], 4),
        "ratio": ratios["32"],
        "spread": {name: [round(min(of["32"]), 4), round(max(of["32"]), 4)] for name, of in times.items()},
        "ratios": ratios,
        "targets": TARGETS,
        "seconds": {name: {w: round(v, 4) for w, v in of.items()} for name, of in median.items()},
        "ensemble": round(median["ours"]["64x3"] / median["ours"]["64"], 2),
        "ensemble_target": 1.6,
        "equal_work": True,
    }


def start(name: str, python: str) -> subprocess.Popen[str]:
    command = [python, str(Path(__file__).resolve()), "--worker", name]
    pipes: Any = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    return subprocess.Popen(command, env={**os.environ, **ONE_THREAD}, **pipes)


def ask(side: subprocess.Popen[str], width: str) -> float:
    assert side.stdin is not None
    assert side.stdout is not None
    side.stdin.write(width + "\n")
    side.stdin.flush()
    for line in side.stdout:
        if line.startswith("RESULT "):
            return float(line.split()[1])
    sys.exit("a worker ended early")


def serve(name: str) -> None:
    """Time one fit for each line that asks for it."""
    import torch

    torch.set_num_threads(1)
    run = {"ours": ours, "peer": peer}[name]()
    for line in sys.stdin:
        print("RESULT", run(line.strip()), flush=True)


def arrays() -> Any:
    import numpy as np

    rng = np.random.default_rng(0)
    observations = rng.normal(size=(2 * PAIRS, STEPS, OBSERVATION)).astype(np.float32)
    actions = rng.normal(size=(2 * PAIRS, STEPS, ACTION)).astype(np.float32)
    return observations, actions, (rng.random(PAIRS) < 0.5).astype(np.float32)


def ours() -> Any:
    import numpy as np

    from prefrl.fit.settings import FittingSettings
    from prefrl.fit.trainer import fit_judged
    from prefrl.judgements import Comparison, Judged
    from prefrl.reward_models.mlp import MLPSettings
    from prefrl.types import Query, Segment

    class Task:
        name, kind, segment_steps, action_bounds = "timed", "control", STEPS, None
        observation_size, action_size = OBSERVATION, ACTION

    observations, actions, preference = arrays()
    segments = [Segment(observations[i], actions[i], str(i), 0) for i in range(2 * PAIRS)]
    queries = [Query((segments[2 * i], segments[2 * i + 1])) for i in range(PAIRS)]
    judged = [Judged(q, Comparison(q.id, float(p))) for q, p in zip(queries, preference, strict=True)]
    fitting = FittingSettings(epochs=1, batch_size=MINIBATCH, learning_rate=RATE, held_out=0.0)

    def run(width: str) -> float:
        hidden, _, members = width.partition("x")
        task: Any = Task()
        settings = MLPSettings(members=int(members or 1), hidden=WIDTHS[hidden], activation="relu")
        reward = settings.build(task, np.random.default_rng(0))
        begin = time.process_time()
        fit_judged(reward, judged, fitting, np.random.default_rng(0))
        return time.process_time() - begin

    return run


def peer() -> Any:
    import gymnasium
    import numpy as np
    import torch
    from imitation.algorithms import preference_comparisons as pc
    from imitation.data.types import TrajectoryWithRew
    from imitation.rewards.reward_nets import BasicRewardNet

    box = gymnasium.spaces.Box
    observation_space, action_space = box(-9, 9, (OBSERVATION,)), box(-9, 9, (ACTION,))
    observations, actions, preference = arrays()

    def fragment(i: int) -> TrajectoryWithRew:
        seen = np.concatenate([observations[i], observations[i][-1:]])
        return TrajectoryWithRew(seen, actions[i], None, True, np.zeros(STEPS, np.float32))

    dataset = pc.PreferenceDataset()
    dataset.push([(fragment(2 * i), fragment(2 * i + 1)) for i in range(PAIRS)], preference)

    def run(width: str) -> float:
        torch.manual_seed(0)
        net = BasicRewardNet(observation_space, action_space, use_next_state=False, hid_sizes=WIDTHS[width])
        loss = pc.CrossEntropyRewardLoss()
        trainer = pc.BasicRewardTrainer(
            pc.PreferenceModel(net), loss, rng=np.random.default_rng(0), epochs=1, batch_size=MINIBATCH, lr=RATE
        )
        begin = time.process_time()
        trainer.train(dataset)
        return time.process_time() - begin

    return run


if __name__ == "__main__":
    main()
