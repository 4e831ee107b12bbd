"""The whole Pendulum run: preset control/pendulum against imitation's documented preference comparisons.

    python benchmarks/control_loop.py [--short] [--peers .venv-peers-control/bin/python]

Both learn Pendulum-v1 from 200 comparisons by a synthetic teacher, each with its own published settings: imitation's
tutorial (5 iterations, 50,000 requested steps) takes about 77,000 true environment steps, the preset about as many.
Every `env.step` of learning and querying is counted. Afterwards 20 episodes of the deterministic policy are played on
the true reward. Runs take turns, a process and a thread each. CPU seconds of a run (imports, and the peer's final
evaluation, left out; our evaluation after each round counted in) are compared by their medians over seeds. `ratio` is
peer / ours: above 1, prefrl needs fewer.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

EPISODES, LABELS = 20, 200
ONE_THREAD = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--short", action="store_true", help="one seed a side: under two minutes")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--peers", default=".venv-peers-control/bin/python", help="Python that has imitation")
    parser.add_argument("--worker", choices=["ours", "peer"], help=argparse.SUPPRESS)
    parser.add_argument("--seed", type=int, default=0, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        print("RESULT " + json.dumps({"ours": ours, "peer": peer}[options.worker](options.seed)), flush=True)
        return
    if not Path(options.peers).exists():
        sys.exit(f"no {options.peers}: run `make peers`, or install benchmarks/peers-control.txt and say --peers")
    print(json.dumps(compare(options.peers, 1 if options.short else options.seeds) | {"short": options.short}))


def compare(peers: str, seeds: int) -> dict[str, Any]:
    """Run both sides in turn, seed by seed."""
    found: dict[str, list[dict[str, float]]] = {"ours": [], "peer": []}
    for seed in range(seeds):
        for name in ("ours", "peer") if seed % 2 == 0 else ("peer", "ours"):
            found[name].append(run(name, sys.executable if name == "ours" else peers, seed))
            print(f"{name} seed {seed}: {found[name][-1]}", flush=True)
    median = {
        name: {key: statistics.median(r[key] for r in runs) for key in ("cpu", "gold", "steps")}
        for name, runs in found.items()
    }
    return {
        "name": f"control_loop: Pendulum-v1 from {LABELS} comparisons, the whole run",
        "unit": "CPU s",
        "ours": round(median["ours"]["cpu"], 2),
        "peer": round(median["peer"]["cpu"], 2),
        "ratio": round(median["peer"]["cpu"] / median["ours"]["cpu"], 3),
        "spread": {name: [min(r["cpu"] for r in runs), max(r["cpu"] for r in runs)] for name, runs in found.items()},
        "equal_work": True,
        "gold": {name: [r["gold"] for r in runs] for name, runs in found.items()},
        "gold_median": {name: values["gold"] for name, values in median.items()},
        "env_steps": {name: values["steps"] for name, values in median.items()},
        "seeds": seeds,
    }


def run(name: str, python: str, seed: int) -> dict[str, float]:
    command = [python, __file__, "--worker", name, "--seed", str(seed)]
    with tempfile.TemporaryDirectory() as folder:  # imitation writes its logs into the current folder
        command[1] = str(Path(__file__).resolve())
        command[0] = python if os.sep not in python else os.path.abspath(python)
        done = subprocess.run(
            command, cwd=folder, env={**os.environ, **ONE_THREAD}, capture_output=True, text=True, check=False
        )
    lines = [line for line in done.stdout.splitlines() if line.startswith("RESULT ")]
    if done.returncode or not lines:
        raise RuntimeError(f"{name} failed:\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}")
    result: dict[str, float] = json.loads(lines[-1][7:])
    return result


def ours(seed: int) -> dict[str, float]:
    import torch

    from prefrl.config import Config
    from prefrl.store import Store

    torch.set_num_threads(1)
    config = Config.load("control/pendulum", [f"seed={seed}", f"loop.labels={LABELS}"])
    with tempfile.TemporaryDirectory() as folder, Store[Any](Path(folder)) as store:
        begin = time.process_time()
        loop = config.build(store)
        *_, last = loop.run()
        cpu = time.process_time() - begin
        steps = loop.learner.steps
    return {"cpu": round(cpu, 2), "gold": round(last.metrics["evaluate/gold"], 1), "steps": steps.learn + steps.query}


def peer(seed: int) -> dict[str, float]:
    """The tutorial "Learning a Reward Function using Preference Comparisons", with a seed and a step counter."""
    import gymnasium
    import numpy as np
    import torch
    from imitation.algorithms import preference_comparisons as pc
    from imitation.policies.base import FeedForward32Policy, NormalizeFeaturesExtractor
    from imitation.rewards.reward_nets import BasicRewardNet
    from imitation.util.networks import RunningNorm
    from imitation.util.util import make_vec_env
    from stable_baselines3 import PPO
    from stable_baselines3.common.evaluation import evaluate_policy

    class Counted(gymnasium.Wrapper):  # type: ignore[type-arg]
        taken = 0

        def step(self, action: Any) -> Any:
            Counted.taken += 1
            return self.env.step(action)

    torch.set_num_threads(1)
    torch.manual_seed(seed)
    begin, rng = time.process_time(), np.random.default_rng(seed)
    venv = make_vec_env("Pendulum-v1", rng=rng, post_wrappers=[lambda env, _: Counted(env)])
    net = BasicRewardNet(venv.observation_space, venv.action_space, normalize_input_layer=RunningNorm)
    model = pc.PreferenceModel(net)
    trainer = pc.BasicRewardTrainer(preference_model=model, loss=pc.CrossEntropyRewardLoss(), epochs=3, rng=rng)
    normalised = {
        "features_extractor_class": NormalizeFeaturesExtractor,
        "features_extractor_kwargs": {"normalize_class": RunningNorm},
    }
    schedule = {"n_steps": 2048 // venv.num_envs, "batch_size": 64, "n_epochs": 10, "learning_rate": 2e-3}
    objective = {"ent_coef": 0.01, "clip_range": 0.1, "gae_lambda": 0.95, "gamma": 0.97}
    agent = PPO(FeedForward32Policy, venv, policy_kwargs=normalised, seed=seed, **schedule, **objective)
    pc.PreferenceComparisons(
        pc.AgentTrainer(algorithm=agent, reward_fn=net, venv=venv, exploration_frac=0.05, rng=rng),
        net,
        num_iterations=5,
        fragmenter=pc.RandomFragmenter(warning_threshold=0, rng=rng),
        preference_gatherer=pc.SyntheticGatherer(rng=rng),
        reward_trainer=trainer,
        fragment_length=100,
        transition_oversampling=1,
        initial_comparison_frac=0.1,
        allow_variable_horizon=False,
        initial_epoch_multiplier=4,
        query_schedule="hyperbolic",
    ).train(total_timesteps=50_000, total_comparisons=LABELS)
    cpu, steps = time.process_time() - begin, Counted.taken
    fresh = make_vec_env("Pendulum-v1", rng=np.random.default_rng(seed + 10_000), n_envs=1)
    gold, _ = evaluate_policy(agent, fresh, EPISODES, deterministic=True)
    return {"cpu": round(cpu, 2), "gold": round(float(np.mean(gold)), 1), "steps": steps}


if __name__ == "__main__":
    main()
