"""A learner of text against best-of-n, at the same distance from the start and by the same reward model.

    python benchmarks/text_best_of_n.py TASK [--learner rloo|grpo|ppo|raft|online_dpo|dpo] [--seeds 5] [--first 100]
        [--set KEY=VALUE] [--prompts 128] [--pool 64] [--short]

Runs the learner's preset for each seed, in runs/best-of-n/, where a run that is there already is taken up. Its newest
reward model then chooses among a pool of responses that the starting policy writes to the evaluation's prompts; from
that pool best-of-n's gold and fluency are estimated for every n, without bias. The learner's are measured as the run's
summary does, on as many fresh responses to the same prompts as the pool has. At the learner's KL best-of-n is a mixture
of two neighbouring n. Its KL is taken to be log n - (n - 1) / n, and a mixture's to lie between the two: upper bounds,
so best-of-n may do a little better than is said here, and clearly so below 0.19 nats, where n is 1 or 2: in --short.
A learner that is farther away than the best of the whole pool is compared with that (`beyond` counts those).

`gold_gain` and `fluency_gain`: learner minus best-of-n, the mean over seeds with a 95 % bootstrap interval over them
(from five seeds; the range below that). `optimum_gain`: learner minus the optimum of the objective that policy
gradients have, at the learner's KL: the start tilted by exp(score / beta), by weights on the same pool. That tells it
well while exp(KL) is far below the pool's size. The last line is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np
from scipy.optimize import brentq
from scipy.special import softmax
from scipy.stats import entropy

from prefrl.config import presets
from prefrl.evaluate.best_of_n import expected, kl_bound
from prefrl.protocols import TextTask
from prefrl.rundir import open_saved
from prefrl.stages import reward_of
from prefrl.storage.checkpoints import load_state
from prefrl.types import Floats, Response

PRESETS = {"ppo": "-ppo", "raft": "-raft", "online_dpo": "-online-dpo", "dpo": "-dpo"}
"""Learners with a preset of their own beside the task's, where there is one; others are algorithms of the task's."""
RESAMPLES, FEW = 9999, 5
AT_ONCE = 4
SHOWN = (1, 2, 4, 8, 16, 32, 64, 128, 256)


@dataclass(frozen=True)
class Size:
    prompts: int = 128
    pool: int = 64
    settings: tuple[str, ...] = ()


SHORT = Size(32, 16, ("loop.rounds=1", "loop.labels=40", "learner.updates=2", "learner.evaluation_prompts=32"))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("task", help="a preset of text")
    parser.add_argument("--learner", choices=("rloo", "grpo", "ppo", "raft", "online_dpo", "dpo"), default="rloo")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=100, help="the first seed")
    parser.add_argument("--out", type=Path, default=Path("runs/best-of-n"))
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="a setting of the runs")
    parser.add_argument("--run", type=Path, help="a finished run, or what `prefrl improve` wrote: that one alone")
    parser.add_argument("--prompts", type=int, default=Size.prompts, help="of the comparison")
    parser.add_argument("--pool", type=int, default=Size.pool, help="responses to each; best-of-n is known up to it")
    parser.add_argument("--short", action="store_true", help="two small runs")
    options = parser.parse_args()
    size, seeds = (SHORT, 2) if options.short else (Size(options.prompts, options.pool), options.seeds)
    size = replace(size, settings=(*options.set, *size.settings))
    if options.run:
        found = compared(options.run, options.first, size)
        print({name: np.round(value, 3).tolist() for name, value in found.items() if name != "n"})
        return
    rows = []
    for seed in range(options.first, options.first + seeds):
        folder = finished(options.task, options.learner, seed, size, options.out)
        rows.append(compared(folder, seed, size))
        print({name: np.round(value, 3).tolist() for name, value in rows[-1].items() if name != "n"}, flush=True)
    print(json.dumps({"name": f"text_best_of_n: {options.task}, {options.learner}"} | account(rows, options.short)))


def finished(task: str, learner: str, seed: int, size: Size, out: Path) -> Path:
    """The folder of a run, which is made, or taken up where it stopped."""
    own = task + PRESETS.get(learner, "")
    preset = own if own in presets() else task
    settings = [f"seed={seed}", *size.settings]
    if preset == task:
        settings.append(f"learner.algorithm={learner}")
    if learner == "dpo":
        settings = [one for one in settings if not one.startswith("learner.updates")]
    short = "-short" if size.pool == SHORT.pool else ""
    folder = out / f"{task.replace('/', '-')}-{learner}{short}-{seed}"
    command = [sys.executable, "-m", "prefrl", "run", preset, *settings, "--out", str(folder)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return folder


def compared(folder: Path, seed: int, size: Size) -> dict[str, Any]:
    """What a run's policy, and the best of n of the start, are worth on the same prompts."""
    saved = open_saved(folder)
    task = saved.config.build_task()
    reward = reward_of(folder, task)
    learner = saved.config.build_learner(task, np.random.default_rng(0))
    policy, prompts = learner.policy, task.evaluation_prompts(size.prompts, np.random.default_rng([seed, 1]))

    def written(stream: int) -> tuple[list[Response], Floats]:
        """Responses, and the log-ratio of each to the starting policy; some prompts at a time, which is faster."""
        found, ratios, rng = [], [], np.random.default_rng([seed, stream])
        for at in range(0, len(prompts), AT_ONCE):
            how = policy.sampling(size.pool, temperature=1.0)
            drawn = policy.respond(prompts[at : at + AT_ONCE], size.pool, rng, how)
            found += drawn.candidates(task.tokenizer)
            ratios.append((drawn.logp - policy.start_logp(drawn, temperature=1.0)).sum(1).numpy(force=True))
        return found, np.concatenate(ratios)

    base, _ = written(2)  # nothing is loaded yet: it is the starting policy that writes
    judged, measured = reward.score(base), measures(base, task)
    curves = curves_of(judged, measured, size.pool)
    learner.load(load_state(saved.folder, "learner"))
    drawn, ratios = written(3)
    kl = float(ratios.mean())
    learned = {name: float(values.mean()) for name, values in measures(drawn, task).items()}

    distances = kl_bound(np.arange(1, size.pool + 1))
    some = [n for n in SHOWN if n <= size.pool]
    summary = json.loads((folder / "summary.json").read_text())
    row: dict[str, Any] = {"seed": seed, "kl": kl, "kl_summary": summary["kl"], "beyond": int(kl > distances[-1])}
    row |= {"repeats": repeats(base, size.pool), "n": some}
    for name, curve in curves.items():
        best = float(np.interp(kl, distances, curve))
        row |= {name: learned[name], f"best_{name}": best, f"curve_{name}": [curve[n - 1] for n in some]}
    weights = tilted(judged.reshape(-1, size.pool), kl)
    return row | {"optimum_gold": float((weights * measured["gold"].reshape(weights.shape)).sum(1).mean())}


def tilted(judged: Floats, kl: float) -> Floats:
    """(P, N) scores of a pool -> its weights in the objective's optimum, start x exp(score / beta), at this KL.

    Of N samples no weights are farther away than log N, and near that the pool's best alone is left.
    """

    def weights(log_beta: float) -> Floats:
        return softmax(judged / np.exp(log_beta), axis=1)

    def distance(log_beta: float) -> float:
        return float(np.mean([entropy(w, np.full_like(w, 1 / len(w))) for w in weights(log_beta)]))

    low, high = np.log(judged.std()) - 9, np.log(judged.std()) + 9
    return weights(low if distance(low) <= kl else brentq(lambda x: distance(x) - kl, low, high, xtol=1e-3))


def repeats(base: list[Response], pool: int) -> float:
    """The share of responses that another one to the same prompt says as well: 0 where the KL is at its bound."""
    found = [1 - len({r.tokens for r in base[i : i + pool]}) / pool for i in range(0, len(base), pool)]
    return mean(found)


def measures(responses: list[Response], task: TextTask) -> dict[str, Floats]:
    """Each (N,): what is hidden from everything that learns."""
    found = {"gold": task.gold(responses)}
    fluent = task.fluency(responses)
    return found if fluent is None else found | {"fluency": np.asarray(fluent, float)}


def curves_of(judged: Floats, measured: dict[str, Floats], pool: int) -> dict[str, Floats]:
    """Each (N,): the best of 1, 2, ... N by the reward."""
    judged = judged.reshape(-1, pool)
    return {name: expected(judged, x.reshape(judged.shape)).mean(0) for name, x in measured.items()}


def account(rows: list[dict[str, Any]], short: bool) -> dict[str, Any]:
    """`ours`, `peer`, `ratio` and `spread` are of gold."""
    made: dict[str, Any] = {"unit": "gold, against best-of-n at equal KL"}
    for name in ("gold", "fluency"):
        if name in rows[0]:
            ours, peer = (np.array([row[f"{best}{name}"] for row in rows]) for best in ("", "best_"))
            made |= {f"{name}_gain": mean(ours - peer), f"{name}_interval": interval(ours - peer)}
            made |= {f"{name}_ours": mean(ours), f"{name}_peer": mean(peer)}
            curve = np.mean([row[f"curve_{name}"] for row in rows], 0)
            made[f"{name}_curve"] = {n: round(float(y), 3) for n, y in zip(rows[0]["n"], curve, strict=True)}
    short_of = np.array([row["gold"] - row["optimum_gold"] for row in rows])
    made |= {"optimum_gain": mean(short_of), "optimum_interval": interval(short_of)}
    made |= {"kl": mean(row["kl"] for row in rows), "beyond": sum(row["beyond"] for row in rows)}
    ours, peer = made.pop("gold_ours"), made.pop("gold_peer")
    made |= {"ours": ours, "peer": peer, "ratio": ours / peer, "spread": made["gold_interval"]}
    made = {name: np.round(x, 3).tolist() if isinstance(x, float | list) else x for name, x in made.items()}
    how = "bootstrap" if len(rows) >= FEW else "range"
    seeds = [row["seed"] for row in rows]
    # Equal KL and one reward model, not equal work: best-of-n learns nothing, and pays each time.
    return made | {"intervals": how, "seeds": seeds, "equal_work": False, "short": short}


def interval(values: Floats) -> list[float]:
    """95 % of a bootstrap over seeds; of fewer than five it would say nothing, so it is their range."""
    if len(values) < FEW:
        return [float(values.min()), float(values.max())]
    drawn = np.random.default_rng(0).choice(values, (RESAMPLES, len(values))).mean(1)
    return [float(x) for x in np.quantile(drawn, [0.025, 0.975])]


if __name__ == "__main__":
    main()
