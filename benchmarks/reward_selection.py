"""How many labels does asking well save? Accuracy against labels for every selector, on control tasks and on text.

    python benchmarks/reward_selection.py [--short] [--seeds 5] [--out docs/curves/reward_selection.csv]

Each task has one fixed pool of candidates: segments of every policy that a run of its preset goes through, or
responses of the starting policy. Each selector asks a batch at a time about what it has not asked yet, a gold oracle
answers, and the preset's reward model (5 members; for text only the heads) is fitted on from where it stands. The
test set is the same for all: random pairs of other episodes, or of responses to other prompts, that differ in gold.
Ratio: the labels that selector `information` with `diversify=k_medoids` needs for the accuracy that uniform has at the
end, over uniform's labels; null where it does not get there. That selector was chosen after a look at Pendulum with
seed 0, so seeds begin at 1; the others are reported beside it. Curves are means over seeds, made monotone (isotonic
regression), and read by linear interpolation. Finished curves are kept in the CSV and not run again.
"""

from __future__ import annotations

import argparse
import csv
import json
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import torch
from scipy.optimize import isotonic_regression

from prefrl.components import settings_class
from prefrl.config import Config
from prefrl.fit.trainer import fit_judged
from prefrl.judgements import Comparison, Judged
from prefrl.policies.rollout import whole_episodes
from prefrl.sample.segments import cut
from prefrl.seeding import streams
from prefrl.store import Store
from prefrl.types import Query, gold_score

MEMBERS, CHOSEN, FIRST_SEED = 5, "information+k_medoids", 1
HEADS = ("reward.train=head", "fitting.learning_rate=0.01", "fitting.epochs=30")
"""With the whole backbone trained, as in the preset, uniform gets worse with more labels: 0.82 at 30, 0.78 at 150."""
SHORT_POLE = (
    *("task.horizon=100", "task.segment_seconds=1.0", "loop.rounds=8", "loop.labels=200"),
    *("fitting.epochs=300", "fitting.learning_rate=1e-3"),
    *("learner.environments=160", "learner.steps_per_round=16000", "learner.rollout_steps=50"),
    *("learner.fresh_starts=false", "learner.rollback=0.1"),
)
"""The preset as it was when this was measured, with a horizon of 100."""
COLUMNS = ("task", "selector", "seed", "labels", "accuracy")


@dataclass(frozen=True)
class Case:
    """A task with its label budget."""

    preset: str
    overrides: tuple[str, ...]
    labels: int
    batch: int
    pool: int = 4000
    tested: int = 2000

    def config(self) -> Config:
        return Config.load(self.preset, [*self.overrides, f"reward.members={MEMBERS}"])


CASES = (
    Case("control/pendulum", (), 200, 20),
    Case("control/cartpole", SHORT_POLE, 200, 20),
    Case("control/hopper", ("loop.rounds=5", "loop.labels=300"), 300, 30),
    Case("text/reviews", HEADS, 150, 15, pool=1200, tested=1000),
)
SHORT = (Case("control/toy", (), 80, 20),)
SELECTORS: dict[str, dict[str, Any]] = {
    "uniform": {"kind": "uniform"},
    "coverage": {"kind": "coverage"},
    "disagreement": {"kind": "disagreement"},
    "entropy": {"kind": "entropy"},
    "information": {"kind": "information"},
    "information+k_medoids": {"kind": "information", "diversify": "k_medoids"},
    "information+dpp": {"kind": "information", "diversify": "dpp"},
    "information+batch": {"kind": "information", "diversify": "batch"},
}


@dataclass(frozen=True, eq=False)
class Bench:
    """What all selectors of a task share."""

    case: Case
    config: Any
    task: Any
    pool: list[Any]
    tested: list[Any]
    pairs: np.ndarray
    """(M, 2): indices into `tested`, the better one first."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--short", action="store_true", help="a toy, two selectors, two seeds: under two minutes")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--tasks", nargs="*", default=[c.preset for c in CASES], help="which presets to run")
    parser.add_argument("--selectors", nargs="*", default=list(SELECTORS), help="which of them to run")
    parser.add_argument("--out", type=Path, default=Path("docs/curves/reward_selection.csv"))
    options = parser.parse_args()
    torch.set_num_threads(1)
    if options.short:
        with tempfile.TemporaryDirectory() as folder:
            out, chosen = Path(folder) / "short.csv", {name: SELECTORS[name] for name in ("uniform", CHOSEN)}
            run(SHORT, chosen, 2, out)
            print(json.dumps(account(read(out)) | {"short": True}))
        return
    chosen = {name: SELECTORS[name] for name in options.selectors}
    run([case for case in CASES if case.preset in options.tasks], chosen, options.seeds, options.out)
    print(json.dumps(account(read(options.out)) | {"short": False}))


def run(cases: Sequence[Case], selectors: dict[str, dict[str, Any]], seeds: int, out: Path) -> None:
    """Every curve that the CSV does not hold yet; each is added whole."""
    for case in cases:
        done = {(row["task"], row["selector"], int(row["seed"])) for row in read(out)}
        todo = [
            (n, s) for s in range(FIRST_SEED, FIRST_SEED + seeds) for n in selectors if (case.preset, n, s) not in done
        ]
        bench = prepare(case) if todo else None
        for name, seed in todo:
            assert bench is not None
            rows = [(case.preset, name, seed, n, round(a, 5)) for n, a in curve(bench, selectors[name], seed)]
            add(out, rows)
            print(*rows[-1], flush=True)


def prepare(case: Case) -> Bench:
    config = case.config()
    task = config.task.build()  # type: ignore[attr-defined]
    pool, tested = (text if task.kind == "text" else segments)(case, task)
    golds = np.array([gold_score(c) for c in tested])
    pairs = written_pairs(tested) if task.kind == "text" else random_pairs(len(tested), np.random.default_rng(1))
    pairs = pairs[golds[pairs[:, 0]] != golds[pairs[:, 1]]]
    better = golds[pairs[:, 0]] > golds[pairs[:, 1]]
    return Bench(case, config, task, pool, tested, np.where(better[:, None], pairs, pairs[:, ::-1]))


def random_pairs(count: int, rng: np.random.Generator, times: int = 10) -> np.ndarray:
    """(M, 2): each of `count` candidates in `times` pairs."""
    return np.concatenate([rng.permutation(count)[: count // 2 * 2].reshape(-1, 2) for _ in range(times)])


def written_pairs(tested: Sequence[Any]) -> np.ndarray:
    """(M, 2): all pairs of responses to one prompt."""
    by_prompt: dict[str, list[int]] = {}
    for i, response in enumerate(tested):
        by_prompt.setdefault(response.prompt, []).append(i)
    return np.array([pair for same in by_prompt.values() for pair in combinations(same, 2)])


def segments(case: Case, task: Any) -> tuple[list[Any], list[Any]]:
    """Segments of the policy after each round of a run of the preset, as many of each; oldest first."""
    rng, pool, tested, config = np.random.default_rng(0), list[Any](), list[Any](), case.config()
    with tempfile.TemporaryDirectory() as folder, Store[Any](Path(folder)) as store:
        loop: Any = config.build(store)
        for stage in loop.run():
            parts = []
            for name, count in (("pool", case.pool), ("test", case.tested)):
                count //= config.loop.rounds + 1
                episodes = max(2, 2 * count * task.segment_steps // task.horizon)
                rollout = whole_episodes(task, loop.learner._act(rng), min(episodes, 100), rng)
                parts.append(cut(rollout, task.segment_steps, count, f"{name} {stage.number}", rng))
            pool, tested = pool + parts[0], tested + parts[1]
    return pool, tested


def text(case: Case, task: Any) -> tuple[list[Any], list[Any]]:
    """Responses of the starting policy, to prompts for learning and to prompts for evaluation."""
    from prefrl.policies.language import LanguagePolicy, LanguageSettings

    rng = np.random.default_rng(0)
    policy = LanguagePolicy(task, 1.0, LanguageSettings(), rng)
    drawn = [
        policy.respond(prompts, 4, np.random.default_rng(4))
        for prompts in (task.prompts(case.pool // 4, rng), task.evaluation_prompts(case.tested // 4, rng))
    ]
    pool, tested = map(policy.with_gold, drawn)
    return pool, tested


def curve(bench: Bench, selector: dict[str, Any], seed: int) -> Iterator[tuple[int, float]]:
    """(labels, accuracy) after each batch."""
    settings: Any = settings_class("selectors", selector["kind"]).model_validate(selector)
    chooser = settings.build()
    reward = bench.config.reward.build(bench.task, streams(seed, 0).build)
    left, judged = {c.id: c for c in bench.pool}, list[Judged[Any]]()
    for step in range(1, bench.case.labels // bench.case.batch + 1):
        rng = streams(seed, step)
        queries = chooser.select(list(left.values()), reward, bench.case.batch, rng.select)
        judged += [judge(query) for query in queries]
        for query in queries:
            for candidate in query.candidates:
                del left[candidate.id]
        fit_judged(reward, judged, bench.config.fitting, rng.fit)
        yield len(judged), accuracy(bench, reward)


def judge(query: Query[Any]) -> Judged[Any]:
    """The gold oracle's answer."""
    first, second = (gold_score(candidate) for candidate in query.candidates)
    return Judged(query, Comparison(query.id, 0.5 + 0.5 * float(np.sign(first - second))))


def accuracy(bench: Bench, reward: Any) -> float:
    """The share of the test pairs whose better candidate has the higher score."""
    scores = reward.score(bench.tested)[bench.pairs]
    return float((scores[:, 0] > scores[:, 1]).mean())


def account(rows: Sequence[dict[str, str]]) -> dict[str, Any]:
    """What each selector needed, as shares of uniform's labels: of the mean curves, and of single seeds."""
    shares: dict[str, dict[str, float | None]] = {}
    spread: dict[str, list[float | None]] = {}
    finals: dict[str, dict[str, float]] = {}
    seeds: dict[str, dict[str, int]] = {}
    ours: dict[str, float] = {}
    for task in dict.fromkeys(row["task"] for row in rows):
        curves = by_selector([row for row in rows if row["task"] == task])
        if not set(curves.get(CHOSEN, {})) & set(curves.get("uniform", {})):
            continue
        both = {name: paired(c, curves["uniform"]) for name, c in curves.items()}
        means = {name: [monotone(np.mean(side, axis=0)) for side in sides] for name, sides in both.items() if sides[0]}
        shares[task] = {name: rounded(share(*sides)) for name, sides in means.items()}
        finals[task] = {name: round(float(sides[0][-1, 1]), 4) for name, sides in means.items()}
        seeds[task] = {name: len(sides[0]) for name, sides in both.items()}
        each = [share(monotone(c), monotone(uniform)) for c, uniform in zip(*both[CHOSEN], strict=True)]
        spread[task] = [rounded(min(each)), rounded(max(each))]
        ours[task] = share(*means[CHOSEN])
    return {
        "name": f"reward_selection: labels that {CHOSEN} needs for uniform's final accuracy",
        "unit": "share of uniform's labels",
        "ours": {task: rounded(value) for task, value in ours.items()},
        "peer": 1.0,
        "ratio": rounded(max(ours.values(), default=float("inf"))),
        "spread": spread,
        "equal_work": True,
        "shares": shares,
        "final_accuracy": finals,
        "seeds": seeds,
    }


def paired(curves: dict[str, np.ndarray], uniform: dict[str, np.ndarray]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """A selector's curves and uniform's, of the seeds that both have."""
    common = [seed for seed in curves if seed in uniform]
    return [curves[seed] for seed in common], [uniform[seed] for seed in common]


def rounded(value: float) -> float | None:
    """JSON has no infinity."""
    return round(value, 3) if np.isfinite(value) else None


def by_selector(rows: Sequence[dict[str, str]]) -> dict[str, dict[str, np.ndarray]]:
    """selector -> seed -> curve (L, 2) of labels and accuracy."""
    found: dict[str, dict[str, list[tuple[float, float]]]] = {}
    for row in rows:
        found.setdefault(row["selector"], {}).setdefault(row["seed"], []).append(
            (float(row["labels"]), float(row["accuracy"]))
        )
    return {name: {seed: np.array(c) for seed, c in seeds.items()} for name, seeds in found.items()}


def monotone(curve: np.ndarray) -> np.ndarray:
    """The nearest curve on which accuracy never falls: where single points lie by luck should not count."""
    return np.stack([curve[:, 0], isotonic_regression(curve[:, 1]).x], axis=1)


def share(curve: np.ndarray, uniform: np.ndarray) -> float:
    """The labels at which a monotone curve reaches uniform's last accuracy, over uniform's labels."""
    (labels, accuracies), (most, target) = curve.T, uniform[-1]
    if accuracies[-1] < target:
        return float("inf")
    after = int(np.argmax(accuracies >= target))
    before = max(after - 1, 0)
    reached = np.interp(target, accuracies[[before, after]], labels[[before, after]]) if after else labels[0]
    return float(reached / most)


def read(path: Path) -> list[dict[str, str]]:
    if not path.exists():
        return []
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def add(path: Path, rows: Sequence[tuple[Any, ...]]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    new = not path.exists()
    with path.open("a", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerows([COLUMNS] * new)
        writer.writerows(rows)


if __name__ == "__main__":
    main()
