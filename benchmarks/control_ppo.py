"""PPO on a simulator's own reward: prefrl's learner for control against stable-baselines3's, at equal settings.

    python benchmarks/control_ppo.py [--env HalfCheetah-v5] [--windows 5] [--short]
    python benchmarks/control_ppo.py --threads 2
    python benchmarks/control_ppo.py --env HalfCheetah-v5 --returns --steps 1000000 --seeds 5 [--out runs/control-ppo]

Both have 16 environments, rollouts of 256 steps in each, minibatches of 256, 10 epochs, two layers of 64 units, and the
same learning rate, clip, discount and trace; stable-baselines3 steps with DummyVecEnv, which is its fastest here, and
normalises observations and rewards (VecNormalize). Ours normalises observations itself, and is given the true reward
over its std so far: not shifted, since episodes end where gymnasium ends them, for both.

The first command measures cost: windows of learning take turns in one process, with one thread; what acting, stepping
and updating cost together is compared in CPU seconds. `ratio` is peer / ours: above 1, prefrl needs fewer.

The second measures seconds on the clock, where either side may use so many cores: prefrl steps on so many threads
(`task.threads`), and either side computes with one thread of torch or with so many; stable-baselines3 steps with
DummyVecEnv or with SubprocVecEnv, a process for each environment. What is quickest for each is compared.

The third measures what is learned: after so many steps 20 episodes of the policy's mode are scored by the true reward.
The seeds' interquartile mean with a 95 % bootstrap interval; runs are kept in OUT and taken up where they are there.
The last line is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from scipy.stats import bootstrap, trim_mean
from stable_baselines3 import PPO
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from prefrl.envs.control import ControlSettings
from prefrl.envs.fast.wrapped import make
from prefrl.improve import control
from prefrl.improve.control import ControlLearner, ControlLearnerSettings
from prefrl.policies.rollout import Rollout, whole_episodes
from prefrl.protocols import RewardModel, StepRewardModel, Store
from prefrl.types import Floats, Segment

ENVIRONMENTS, STEPS, MINIBATCH, EPOCHS, RATE = 16, 256, 256, 10, 3e-4
BATCH = ENVIRONMENTS * STEPS
EPISODES = 20


class TrueReward:
    """The simulator's, over its std in all that was seen. Without a shift, which would reward an early end."""

    def __init__(self) -> None:
        self._count, self._mean, self._squares = 0, 0.0, 0.0

    def __call__(self, reward: StepRewardModel, rollout: Rollout) -> Floats:
        gold = rollout.gold
        total, delta = self._count + gold.size, float(gold.mean()) - self._mean
        self._squares += float(gold.var()) * gold.size + delta**2 * self._count * gold.size / total
        self._mean, self._count = self._mean + delta * gold.size / total, total
        return gold / (np.sqrt(self._squares / total) + 1e-8)


class Ours:
    def __init__(self, env: str, seed: int, steer: bool, fresh: bool = False, threads: int = 1) -> None:
        settings = ControlLearnerSettings(
            fresh_starts=fresh,
            environments=ENVIRONMENTS,
            steps_per_round=BATCH,
            rollout_steps=STEPS,
            minibatch=MINIBATCH,
            epochs=EPOCHS,
            learning_rate=RATE,
            target_kl=0.01 if steer else None,
            critic_epochs=0,
            entropy=0.0,
        )
        self._task = ControlSettings(env=env, variable_horizon=True, threads=threads).build()
        self._learner, self._rng = settings.build(self._task, np.random.default_rng(seed)), np.random.default_rng(seed)
        self._reward = TrueReward()

    def learn(self, batches: int) -> None:
        # In place of the reward model's scores, which would be part of neither side's work.
        control.learned_rewards = self._reward  # type: ignore[assignment]
        control.step_rewards = lambda reward: cast(StepRewardModel, reward)
        learner = cast(ControlLearner, self._learner)
        learner._settings = learner._settings.model_copy(update={"steps_per_round": batches * BATCH})
        learner.improve(cast(RewardModel[Segment], None), cast(Store[Segment], None), self._rng)

    def gold(self) -> float:
        rollout = whole_episodes(self._task, self._learner._act(None), EPISODES, np.random.default_rng(9))
        # Until the first end of each.
        alive = np.cumsum(rollout.ends, 1) - rollout.ends == 0
        return float((rollout.gold * alive).sum(1).mean())


class Peer:
    def __init__(self, env: str, seed: int, processes: bool = False) -> None:
        self._env = env
        stepper = SubprocVecEnv if processes else DummyVecEnv
        self._envs = VecNormalize(stepper([lambda: make(env) for _ in range(ENVIRONMENTS)]))
        self._envs.seed(seed)
        self._model = PPO(
            "MlpPolicy",
            self._envs,
            RATE,
            n_steps=STEPS,
            batch_size=MINIBATCH,
            n_epochs=EPOCHS,
            policy_kwargs={"net_arch": {"pi": [64, 64], "vf": [64, 64]}, "activation_fn": torch.nn.Tanh},
            device="cpu",
            seed=seed,
        )

    def learn(self, batches: int) -> None:
        self._model.learn(batches * BATCH, reset_num_timesteps=False)

    def gold(self) -> float:
        single = VecNormalize(DummyVecEnv([lambda: make(self._env)]), training=False, norm_reward=False)
        single.obs_rms = self._envs.obs_rms
        single.seed(9)
        return float(cast(float, evaluate_policy(self._model, single, EPISODES)[0]))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--env", default="HalfCheetah-v5")
    parser.add_argument("--windows", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1, help="more than 1: seconds on the clock with so many cores")
    parser.add_argument("--returns", action="store_true", help="what is learned, in place of how fast")
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=100, help="the first seed")
    parser.add_argument("--keep-rate", action="store_true", help="our learning rate is not steered by the KL")
    parser.add_argument("--fresh", action="store_true", help="our rollouts begin with new episodes each")
    parser.add_argument("--out", type=Path, default=Path("runs/control-ppo"))
    parser.add_argument("--short", action="store_true", help="a window a side")
    options = parser.parse_args()
    torch.set_num_threads(1)
    measure = returns if options.returns else clock if options.threads > 1 else speed
    print(json.dumps(measure(options) | {"short": options.short}))


def speed(options: argparse.Namespace) -> dict[str, Any]:
    sides = {"ours": Ours(options.env, 0, steer=False), "peer": Peer(options.env, 0)}
    for side in sides.values():
        side.learn(1)  # not counted: what is only done once
    found: dict[str, list[float]] = {name: [] for name in sides}
    for number in range(1 if options.short else options.windows):
        for name in sides if number % 2 == 0 else reversed(sides):
            found[name].append(timed(lambda side=sides[name]: side.learn(2)) / (2 * BATCH))
    ratios = [peer / ours for ours, peer in zip(found["ours"], found["peer"], strict=True)]
    ours, peer = (statistics.median(found[name]) * 1e6 for name in ("ours", "peer"))
    return {
        "name": f"control_ppo: {options.env}, PPO with {ENVIRONMENTS} environments, one thread",
        "unit": "CPU us an environment step",
        "ours": round(ours, 1),
        "peer": round(peer, 1),
        "ratio": round(statistics.median(ratios), 2),
        "spread": [round(min(ratios), 2), round(max(ratios), 2)],
        "equal_work": True,
    }


@dataclass(frozen=True)
class Way:
    """One way of a side to use several cores."""

    side: Ours | Peer
    torch_threads: int

    def seconds(self) -> float:
        torch.set_num_threads(self.torch_threads)
        return timed(lambda: self.side.learn(2), time.perf_counter)


def clock(options: argparse.Namespace) -> dict[str, Any]:
    """Every way has its turn in each window; the best of either side are compared window by window."""
    env, threads = options.env, options.threads
    ours, dummy, processes = Ours(env, 0, steer=False, threads=threads), Peer(env, 0), Peer(env, 0, processes=True)
    ways = {
        f"{name}, {computing} of torch": Way(side, computing)
        for name, side in {"ours": ours, "peer": dummy, "peer in processes": processes}.items()
        for computing in (1, threads)
    }
    for way in ways.values():
        way.seconds()  # not counted: what is only done once
    found: dict[str, list[float]] = {name: [] for name in ways}
    for number in range(1 if options.short else options.windows):
        for name in ways if number % 2 == 0 else reversed(ways):
            found[name].append(ways[name].seconds() / (2 * BATCH) * 1e6)
    middle = {name: round(statistics.median(values), 1) for name, values in found.items()}
    best, peer = (min((n for n in ways if n.startswith(side)), key=middle.__getitem__) for side in ("ours", "peer"))
    ratios = [theirs / own for own, theirs in zip(found[best], found[peer], strict=True)]
    return {
        "name": f"control_ppo: {env}, PPO with {ENVIRONMENTS} environments, {threads} threads",
        "unit": "us on the clock an environment step",
        "ours": middle[best],
        "peer": middle[peer],
        "ratio": round(statistics.median(ratios), 2),
        "spread": [round(min(ratios), 2), round(max(ratios), 2)],
        "ways": middle,
        "load": round(os.getloadavg()[0], 1),
        "equal_work": True,
    }


def timed(call: Callable[[], None], seconds: Callable[[], float] = time.process_time) -> float:
    start = seconds()
    call()
    return seconds() - start


def returns(options: argparse.Namespace) -> dict[str, Any]:
    options.out.mkdir(parents=True, exist_ok=True)
    seeds = list(range(options.first, options.first + options.seeds))
    found: dict[str, list[float]] = {"ours": [], "peer": []}
    for seed in seeds:
        for name, values in found.items():
            variant = "-kept" * options.keep_rate + "-fresh" * options.fresh if name == "ours" else ""
            kept = options.out / f"{options.env}-{options.steps}-{name}{variant}-{seed}.json"
            if not kept.exists():
                ours = name == "ours"
                side = (
                    Ours(options.env, seed, not options.keep_rate, options.fresh) if ours else Peer(options.env, seed)
                )
                side.learn(-(-options.steps // BATCH))  # at once: a call begins with new episodes
                kept.write_text(json.dumps(side.gold()))
            values.append(json.loads(kept.read_text()))
            print(f"{name} {seed}: {values[-1]:.0f}", flush=True)
    return {
        "name": f"control_ppo: {options.env}, return after {options.steps} steps, interquartile mean",
        "unit": "true return",
        **{name: round(float(trim_mean(values, 0.25)), 1) for name, values in found.items()},
        "ratio": round(float(trim_mean(found["ours"], 0.25) / trim_mean(found["peer"], 0.25)), 3),
        "spread": {name: interval(values) for name, values in found.items()},
        "returns": found,
        "seeds": seeds,
        "equal_work": True,
    }


def interval(values: list[float]) -> list[float]:
    """95 %, of the interquartile mean over seeds."""
    if len(values) < 2:
        return values * 2
    found = bootstrap((values,), lambda x, axis: trim_mean(x, 0.25, axis=axis), rng=0, method="percentile")
    return [round(float(x), 1) for x in found.confidence_interval]


if __name__ == "__main__":
    main()
