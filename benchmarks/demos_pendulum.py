"""Cloning an expert who swings a pendulum up: prefrl against imitation on the same demonstrations.

    python benchmarks/demos_pendulum.py --method clone|noise|dagger|adversarial [--seeds 5] [--first 100] [--short]
        [--peers .venv-peers-control/bin/python] [--alone] [--settings KEY=VALUE ...]

`clone`: four episodes of the expert, 800 answered steps; `noise`: the same with noise in what is executed (DART);
`dagger`: one episode, and 600 steps of the learner's own that the expert answers. imitation's BC is given the same
episodes, its DAgger the same expert and as many answered steps, each with as many passes over the data, minibatches as
large and the same network. 20 episodes of the policy's mode are scored. The last line is one JSON object: `gold` and
`peer_gold` are means over seeds, `ratio` is peer / ours in CPU seconds of cloning (medians).

`adversarial`: control/pendulum-adversarial, which has four clean episodes, against imitation's GAIL on the same
episodes for as many steps from a random start, as is usual there. `early` is the return after at most 30,000 steps of
the policy's own and `gold` the one at the end, after about 120,000; our CPU seconds hold all evaluations.
`--alone` leaves the peer out; `--settings` changes the preset of `adversarial`.
"""

from __future__ import annotations

import argparse
import json
import math
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from prefrl.types import Segment

EPISODES, EPOCHS, MINIBATCH, RATE = 20, 200, 64, 1e-3
EARLY, LATE = 30_000, 120_000
"""Steps of an adversary's own, when it is scored."""
ONE_THREAD = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
SETTINGS = {
    "clone": ["control/pendulum-demos", "labeler.noise=0"],
    "noise": ["control/pendulum-demos"],
    "dagger": ["control/pendulum-dagger"],
    "adversarial": ["control/pendulum-adversarial"],
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--method", choices=SETTINGS, default="clone")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--short", action="store_true", help="one seed")
    parser.add_argument("--alone", action="store_true", help="without the peer")
    parser.add_argument("--peers", default=".venv-peers-control/bin/python", help="Python that has imitation")
    parser.add_argument("--settings", nargs="*", default=[], help="settings beside the preset's, for adversarial")
    parser.add_argument("--worker", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker:
        work = gail if options.method == "adversarial" else partial(peer, options.method)
        print("RESULT " + json.dumps(work(options.worker, options.first)), flush=True)
        return
    if not (options.alone or Path(options.peers).exists()):
        sys.exit(f"no {options.peers}: run `make peers`, or install benchmarks/peers-control.txt and say --peers")
    found: dict[str, list[dict[str, float]]] = {"ours": [], "peer": []}
    for seed in range(options.first, options.first + (1 if options.short else options.seeds)):
        with tempfile.TemporaryDirectory() as folder:
            mine = adversary(Path(folder), seed, options.settings) if options.method == "adversarial" else None
            found["ours"].append(mine or ours(options.method, Path(folder), seed))
            print(f"seed {seed}: ours {found['ours'][-1]}", flush=True)
            if not options.alone:
                found["peer"].append(other(options, Path(folder), seed))
                print(f"seed {seed}: peer {found['peer'][-1]}", flush=True)
    print(json.dumps(said(options.method, found) | {"short": options.short}))


def said(method: str, found: dict[str, list[dict[str, float]]]) -> dict[str, Any]:
    ran = {name: runs for name, runs in found.items() if runs}
    cpu = {name: statistics.median(run["cpu"] for run in runs) for name, runs in ran.items()}
    early = {name: [run["early"] for run in runs] for name, runs in ran.items() if "early" in runs[0]}
    gold = {name: [run["gold"] for run in runs] for name, runs in ran.items()}
    means = {name: round(statistics.mean(values), 1) for name, values in gold.items()}
    return {
        "name": f"demos_pendulum: {method}",
        "unit": "return",
        "gold": means["ours"],
        "peer_gold": means.get("peer"),
        "golds": gold,
        **({"early": early} if early else {}),
        "cpu": cpu,
        "ratio": round(cpu["peer"] / cpu["ours"], 2) if "peer" in cpu else None,
        "equal_work": True,
    }


def ours(method: str, folder: Path, seed: int) -> dict[str, float]:
    """A run of the preset; what its expert showed is left in `folder` for the peer."""
    import torch

    from prefrl.config import Config
    from prefrl.store import Store
    from prefrl.types import Segment

    torch.set_num_threads(1)
    preset, *settings = SETTINGS[method]
    same = [
        f"learner.cloning_epochs={EPOCHS}",
        f"learner.cloning_minibatch={MINIBATCH}",
        f"learner.learning_rate={RATE}",
    ]
    config = Config.load(preset, [f"seed={seed}", f"learner.evaluation_episodes={EPISODES}", *same, *settings])
    cpu = 0.0
    with Store[Segment](folder / "store") as store:
        loop = config.build(store)
        improve = loop.learner.improve

        def timed(*given: Any) -> Any:
            nonlocal cpu
            begin = time.process_time()
            metrics = improve(*given)
            cpu += time.process_time() - begin
            return metrics

        loop.learner.improve = timed  # type: ignore[method-assign]
        *_, last = loop.run()
        shown = [one.like for one in store.demonstrations() if one.like.id == one.query.candidates[0].id]
    keep(folder, shown)
    return {"gold": round(last.metrics["evaluate/gold"], 1), "cpu": round(cpu, 2)}


def keep(folder: Path, shown: Sequence[Segment]) -> None:
    np.savez(folder / "shown.npz", seen=[s.observations for s in shown], done=[s.actions for s in shown])


def adversary(folder: Path, seed: int, settings: Sequence[str]) -> dict[str, float]:
    """A run of the preset; what its expert showed is left in `folder` for the peer."""
    import torch

    from prefrl.config import Config
    from prefrl.store import Store
    from prefrl.types import Segment

    torch.set_num_threads(1)
    own = [f"seed={seed}", f"learner.evaluation_episodes={EPISODES}", *settings]
    config = Config.load(SETTINGS["adversarial"][0], own)
    early, begin = math.nan, time.process_time()
    with Store[Segment](folder / "store") as store:
        for done in config.build(store).run():
            steps = done.metrics["steps/learn"] + done.metrics["steps/query"]
            early = done.metrics["evaluate/gold"] if steps <= EARLY else early
        cpu = time.process_time() - begin
        shown = [one.like for one in store.demonstrations() if one.like.id == one.query.candidates[0].id]
    keep(folder, shown)
    return {
        "early": round(early, 1),
        "gold": round(done.metrics["evaluate/gold"], 1),
        "steps": steps,
        "cpu": round(cpu, 1),
    }


def other(options: argparse.Namespace, folder: Path, seed: int) -> dict[str, float]:
    script = str(Path(__file__).resolve())
    command = [os.path.abspath(options.peers), script, "--method", options.method, "--first", str(seed)]
    done = subprocess.run(
        [*command, "--worker", str(folder)],
        cwd=folder,
        env={**os.environ, **ONE_THREAD},
        capture_output=True,
        text=True,
        check=False,
    )
    lines = [line for line in done.stdout.splitlines() if line.startswith("RESULT ")]
    if done.returncode or not lines:
        raise RuntimeError(f"the peer failed:\n{done.stdout[-2000:]}\n{done.stderr[-4000:]}")
    result: dict[str, float] = json.loads(lines[-1][7:])
    return result


def peer(method: str, folder: Path, seed: int) -> dict[str, float]:
    """imitation's BC on the same episodes, or its DAgger with the same expert from the same first episode."""
    import torch
    from imitation.algorithms.bc import BC
    from imitation.data.types import Trajectory
    from imitation.policies.base import NonTrainablePolicy
    from imitation.util.util import make_vec_env
    from stable_baselines3.common.evaluation import evaluate_policy
    from stable_baselines3.common.policies import ActorCriticPolicy

    class Expert(NonTrainablePolicy):
        """The swing-up by energy, as in prefrl.envs.experts: this Python has no prefrl."""

        def _choose_action(self, obs: Any) -> Any:
            cosine, sine, speed = (float(x) for x in obs)
            pump = -0.3 * speed * (speed**2 / 2 + 15.0 * (cosine - 1.0))
            rest = abs(speed) + abs(sine) < 0.05
            torque = -10.0 * np.arctan2(sine, cosine) - 2.5 * speed if cosine > 0.7 else 2.0 if rest else pump
            return np.clip([torque], -2.0, 2.0).astype(np.float32)

    torch.set_num_threads(1)
    torch.manual_seed(seed)
    rng = np.random.default_rng(seed)
    venv = make_vec_env("Pendulum-v1", rng=rng, n_envs=1)
    found = np.load(folder / "shown.npz")
    # The last observation stands twice: what followed the last action was not kept, and BC does not look at it.
    episodes = [
        Trajectory(np.concatenate([seen, seen[-1:]]), done, None, terminal=True)
        for seen, done in zip(found["seen"], found["done"], strict=True)
    ]
    policy = ActorCriticPolicy(venv.observation_space, venv.action_space, lambda _: RATE, net_arch=[64, 64])
    trainer = BC(
        observation_space=venv.observation_space,
        action_space=venv.action_space,
        demonstrations=episodes,
        rng=rng,
        policy=policy,
        batch_size=MINIBATCH,
        optimizer_kwargs={"lr": RATE},
        device="cpu",
    )
    begin = time.process_time()
    if method == "dagger":
        _dagger(venv, folder, trainer, Expert(venv.observation_space, venv.action_space), episodes, rng)
    else:
        trainer.train(n_epochs=EPOCHS, progress_bar=False)
    cpu = time.process_time() - begin
    fresh = make_vec_env("Pendulum-v1", rng=np.random.default_rng(seed + 10_000), n_envs=1)
    gold, _ = evaluate_policy(trainer.policy, fresh, EPISODES, deterministic=True)
    return {"gold": round(float(np.mean(gold)), 1), "cpu": round(cpu, 2)}


def gail(folder: Path, seed: int) -> dict[str, float]:
    """imitation's GAIL on the same episodes, with PPO of stable-baselines3 and the settings of its documentation's
    example, but for environments and rollouts as ours."""
    import torch
    from imitation.algorithms.adversarial.gail import GAIL
    from imitation.data.types import Trajectory
    from imitation.rewards.reward_nets import BasicRewardNet
    from imitation.util.networks import RunningNorm
    from imitation.util.util import make_vec_env
    from stable_baselines3 import PPO
    from stable_baselines3.common.evaluation import evaluate_policy

    torch.set_num_threads(1)
    torch.manual_seed(seed)
    venv = make_vec_env("Pendulum-v1", rng=np.random.default_rng(seed), n_envs=8)
    found = np.load(folder / "shown.npz")
    episodes = [
        Trajectory(np.concatenate([seen, seen[-1:]]), done, None, terminal=True)
        for seen, done in zip(found["seen"], found["done"], strict=True)
    ]
    learner = PPO(
        "MlpPolicy",
        venv,
        n_steps=240,
        batch_size=64,
        ent_coef=0.0,
        learning_rate=4e-4,
        gamma=0.95,
        n_epochs=5,
        seed=seed,
    )
    trainer = GAIL(
        demonstrations=episodes,
        demo_batch_size=512,
        gen_replay_buffer_capacity=2048,
        n_disc_updates_per_round=8,
        venv=venv,
        gen_algo=learner,
        reward_net=BasicRewardNet(venv.observation_space, venv.action_space, normalize_input_layer=RunningNorm),
    )
    said, cpu = {}, 0.0
    for name, steps in (("early", EARLY), ("gold", LATE - EARLY)):
        begin = time.process_time()
        trainer.train(steps)
        cpu += time.process_time() - begin
        fresh = make_vec_env("Pendulum-v1", rng=np.random.default_rng(seed + 10_000), n_envs=1)
        said[name] = round(float(np.mean(evaluate_policy(learner, fresh, EPISODES, deterministic=True)[0])), 1)
    return {**said, "cpu": round(cpu, 1)}


def _dagger(venv: Any, folder: Path, trainer: Any, expert: Any, episodes: Any, rng: np.random.Generator) -> None:
    """Three rounds of an episode each: 600 steps of the learner's own that the expert answers, as ours."""
    from imitation.algorithms.dagger import SimpleDAggerTrainer

    dagger = SimpleDAggerTrainer(
        venv=venv,
        scratch_dir=folder / "scratch",
        expert_policy=expert,
        rng=rng,
        expert_trajs=episodes,
        bc_trainer=trainer,
        beta_schedule=lambda round: float(round == 0),
    )
    dagger.train(
        800,
        rollout_round_min_episodes=1,
        rollout_round_min_timesteps=200,
        bc_train_kwargs={"n_epochs": EPOCHS, "progress_bar": False},
    )


if __name__ == "__main__":
    main()
