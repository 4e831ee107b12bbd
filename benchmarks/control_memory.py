"""What memory is worth: policies with and without one in a T-maze of 20 steps, on the true reward.

    python benchmarks/control_memory.py [--kinds gru transformer mlp] [--seeds 5] [--first 100]

A sign at the start says which arm at the end is right. Who remembers it gets 1, who does not 0.5 on average. All kinds
learn from as many steps with the same settings, but for the learning rate; afterwards 200 episodes of the policy's
mode are scored. `ours` is the lowest of the means of the kinds with a memory, `peer` that of mlp; the last line is one
JSON object.
"""

from __future__ import annotations

import argparse
import json
import time
from typing import Any, cast

import numpy as np
import torch

from prefrl.envs.toys import TMazeSettings
from prefrl.improve import control
from prefrl.improve.control import ControlLearnerSettings
from prefrl.policies.rollout import whole_episodes
from prefrl.protocols import StepRewardModel

EPISODES = 200
POLICIES: dict[str, dict[str, Any]] = {
    "gru": {"width": 32, "hidden": 32, "chunk": 20},
    "transformer": {"width": 32, "heads": 2, "hidden": 64, "context": 20, "chunk": 20},
    "mlp": {},
}
RATES = {"gru": 3e-3, "transformer": 1e-3, "mlp": 3e-3}
LEARNER: dict[str, Any] = {
    "environments": 16,
    "steps_per_round": 7680,
    "rollout_steps": 160,
    "epochs": 5,
    "minibatch": 320,
    "entropy": 0.03,
    "target_kl": None,
    "device": "cpu",
}
"""A fixed rate: one that is steered by the KL rises tenfold where a policy is nearly settled, and then unsettles it."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kinds", nargs="+", choices=POLICIES, default=list(POLICIES))
    parser.add_argument("--length", type=int, default=20, help="of the maze, in steps")
    parser.add_argument("--rounds", type=int, default=8, help="of 7680 steps")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=100, help="the first seed")
    parser.add_argument("--short", action="store_true", help="one seed of gru and mlp in a maze of 5 steps")
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.short:
        options.kinds, options.seeds, options.length, options.rounds = ["gru", "mlp"], 1, 5, 4
    seeds = range(options.first, options.first + options.seeds)
    found = {kind: [learned(kind, seed, options) for seed in seeds] for kind in options.kinds}
    means = {kind: round(float(np.mean(golds)), 3) for kind, golds in found.items()}
    ours, peer = min((x for kind, x in means.items() if kind != "mlp"), default=None), means.get("mlp")
    print(
        json.dumps(
            {
                "name": f"control_memory: T-maze of {options.length} steps, {options.rounds * 7680} steps of learning",
                "unit": "true return",
                "ours": ours,
                "peer": peer,
                "ratio": round(ours / peer, 2) if ours and peer else None,
                "spread": {kind: [min(golds), max(golds)] for kind, golds in found.items()},
                "returns": found,
                "seeds": list(seeds),
                "equal_work": True,
                "short": options.short,
            }
        )
    )


def learned(kind: str, seed: int, options: argparse.Namespace) -> float:
    """The mean return of the policy's mode, after learning from the true reward."""
    # In place of the scores of a reward model.
    control.learned_rewards = lambda reward, rollout: rollout.gold
    control.step_rewards = lambda reward: cast(StepRewardModel, reward)
    settings, nothing = LEARNER | {"policy": {"kind": kind} | POLICIES[kind]}, cast(Any, None)
    settings["learning_rate"] = RATES[kind]
    task = TMazeSettings(length=options.length).build()
    learner = ControlLearnerSettings.model_validate(settings).build(task, np.random.default_rng(seed))
    began = time.process_time()
    for number in range(options.rounds):
        learner.pace(number / options.rounds, (number + 1) / options.rounds)
        learner.improve(nothing, nothing, np.random.default_rng([seed, number]))
    act, rng = learner._act(None), np.random.default_rng([9, seed])
    gold = round(float(whole_episodes(task, act, EPISODES, rng).gold.sum(1).mean()), 3)
    print(f"{kind} {seed}: {gold} ({time.process_time() - began:.0f} CPU-seconds)", flush=True)
    return gold


if __name__ == "__main__":
    main()
