"""Clones that remember: Pendulum as its expert shows it, without the speeds by which the expert decides.

    python benchmarks/demos_memory.py [--kinds mlp gru transformer] [--seeds 5] [--first 100] [--episodes 20]
        [--noise 0.5] [--epochs 200] [--short]

The expert sees the whole state; what is cloned are its actions beside the angle alone. One observation does not say
what to do, two and more do. Every kind has the same episodes, as many passes and the learner's other defaults. Scores
are the true returns of 20 episodes of the clone's mode: their mean over seeds, with all of them. The last line is one
JSON object.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from pathlib import Path
from statistics import mean
from typing import Any, cast

import numpy as np
import torch

from prefrl.envs.control import ControlSettings
from prefrl.improve.clone import CloneSettings
from prefrl.label.expert import ExpertSettings
from prefrl.policies.acting import played
from prefrl.policies.rollout import whole_episodes
from prefrl.store import Store
from prefrl.types import Segment

KINDS = ("mlp", "gru", "transformer")
WHOLE = ControlSettings(env="Pendulum-v1").build()
ANGLE = ControlSettings(env="Pendulum-v1", hide=(2,)).build()
STD, PLAYED = 0.2, 20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", choices=KINDS, default=list(KINDS))
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--episodes", type=int, default=20, help="that the expert shows")
    parser.add_argument("--noise", type=float, default=0.5, help="of what it executes, in half the action bounds")
    parser.add_argument("--epochs", type=int, default=200, help="passes over what is shown")
    parser.add_argument("--short", action="store_true", help="one seed, few episodes and passes")
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.short:
        options.seeds, options.episodes, options.epochs = 1, 2, 2
    found: dict[str, list[float]] = {kind: [] for kind in options.kinds}
    seconds = dict.fromkeys(options.kinds, 0.0)
    for seed in range(options.first, options.first + options.seeds):
        with tempfile.TemporaryDirectory() as folder:
            data = shown(seed, options.episodes, options.noise, Path(folder) / "angles.npz")
            for kind in options.kinds:
                begun = time.process_time()
                found[kind].append(cloned(kind, data, seed, options.epochs))
                seconds[kind] += time.process_time() - begun
                print(kind, seed, round(found[kind][-1]), flush=True)
    scores = {kind: {"return": round(mean(each)), "each": [round(x) for x in each]} for kind, each in found.items()}
    cpu = {kind: round(spent / options.seeds, 1) for kind, spent in seconds.items()}
    print(
        json.dumps({"name": "demos_memory", "unit": "return", "scores": scores, "cpu_s": cpu, "short": options.short})
    )


def shown(seed: int, episodes: int, noise: float, file: Path) -> Path:
    """The expert's episodes, without the speeds."""
    expert = ExpertSettings(episodes=episodes, noise=noise).build(WHOLE)
    with Store[Segment](file.parent / "store") as store:
        expert.show(cast(Any, store), np.random.default_rng(seed))
        segments = [one.like for one in store.demonstrations()]
    angles = np.stack([one.observations[:, :2] for one in segments])
    np.savez(file, observations=angles, actions=np.stack([one.actions for one in segments]))
    return file


def cloned(kind: str, data: Path, seed: int, epochs: int) -> float:
    """What a clone earns in the mean."""
    policy = None if kind == "mlp" else {"kind": kind}
    settings = {"policy": policy, "data": data, "std": STD, "cloning_epochs": epochs, "device": "cpu"}
    learner = CloneSettings.model_validate(settings).build(ANGLE, np.random.default_rng(seed))
    nobody = cast(Any, None)  # a clone looks at no reward, and all that it learns from is in the file
    learner.improve(nobody, nobody, np.random.default_rng([seed, 1]))
    rollout = whole_episodes(ANGLE, played(learner.actor(), None), PLAYED, np.random.default_rng([seed, 2]))
    return float(rollout.gold.sum(1).mean())


if __name__ == "__main__":
    main()
