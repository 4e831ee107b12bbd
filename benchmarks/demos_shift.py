"""How mistakes grow with the horizon: a clone's with its square, DAgger's with itself (Ross and Bagnell 2010).

    python benchmarks/demos_shift.py [--seeds 5] [--first 100] [--to docs/curves/cloning_shift] [--short]

A ledge: "on" goes on, anything else falls, and whoever has fallen stays there until "climb". The expert never falls, so
a clone never sees what to do then. DAgger's expert answers 8 segments of 10 of the learner's own steps in each of 8
rounds. Both have 800 answered steps and as many passes, and draw from their policies. What counts are mistakes of an
episode, actions that are not the expert's, for horizons of 10 to 160. Writes TO.csv and TO.svg; the last line is one
JSON object: `slope_clone` and `slope_dagger` are slopes of log mistakes over log horizon, medians over seeds.
"""

from __future__ import annotations

import argparse
import csv
import json
import tempfile
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
from matplotlib.figure import Figure

from prefrl.envs.control import GymnasiumTask
from prefrl.envs.fast.vectorised import Vectorised
from prefrl.improve.clone import CloneSettings
from prefrl.improve.offline import Offline
from prefrl.label.expert import Expert, ExpertSettings
from prefrl.policies.acting import forgetful
from prefrl.store import Store
from prefrl.types import Bools, Floats, Query, Segment

HORIZONS = (10, 20, 40, 80, 160)
ROUNDS, CORRECTED, STEPS = 8, 8, 10
ON, _, CLIMB = np.eye(3, dtype=np.float32)


@dataclass(frozen=True)
class Ledge:
    """A state is (up or down, scenery, what the height sensor adds); actions are on, jump, climb."""

    def start(self, count: int, rng: np.random.Generator) -> Floats:
        return np.concatenate([np.ones((count, 1)), self._seen(count, rng)], 1)

    def advance(self, states: Floats, actions: Floats, rng: np.random.Generator) -> tuple[Floats, Floats, Bools]:
        action, up = actions.argmax(1), states[:, 0] > 0
        stands = np.where(up, action == 0, action == 2)
        following = np.concatenate([np.where(stands, 1.0, -1.0)[:, None], self._seen(len(states), rng)], 1)
        return following, -1.0 * ~stands, np.zeros(len(states), bool)

    def observe(self, states: Floats) -> Floats:
        return np.stack([states[:, 0] + 0.1 * states[:, 2], states[:, 1]], 1).astype(np.float32)

    def legal(self, states: Floats) -> Bools | None:
        return None

    def picture(self, state: Floats, size: int) -> np.ndarray | None:
        return None

    def _seen(self, count: int, rng: np.random.Generator) -> Floats:
        return rng.normal(size=(count, 2))


def task(horizon: int) -> GymnasiumTask:
    return GymnasiumTask(
        name="Ledge",
        horizon=horizon,
        segment_steps=STEPS,
        observation_size=2,
        action_size=3,
        action_bounds=None,
        fps=5.0,
        frame_size=64,
        make=partial(Vectorised, Ledge(), horizon=horizon),
    )


def advice(observations: Floats) -> Floats:
    found: Floats = np.where(observations[:, :1] > 0, ON, CLIMB).astype(np.float32)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--first", type=int, default=100)
    parser.add_argument("--to", type=Path, default=Path("docs/curves/cloning_shift"))
    parser.add_argument("--short", action="store_true", help="one seed, few episodes; writes nothing")
    options = parser.parse_args()
    steps = 100_000 if options.short else 2_000_000
    rows: list[dict[str, Any]] = []
    for seed in range(options.first, options.first + (1 if options.short else options.seeds)):
        for name in ("clone", "dagger"):
            learner = learned(name, seed)
            made = [mistakes(learner, horizon, steps // horizon, seed) for horizon in HORIZONS]
            rows += [
                {"method": name, "seed": seed, "horizon": horizon, "mistakes": float(each.sum())}
                | {"first": float(each[0])}
                for horizon, each in zip(HORIZONS, made, strict=True)
            ]
            print(f"{name} {seed}: {[round(row['mistakes'], 4) for row in rows[-len(HORIZONS) :]]}", flush=True)
    slopes = {
        name: [slope(rows, name, seed) for seed in sorted({r["seed"] for r in rows})] for name in ("clone", "dagger")
    }
    if not options.short:
        write(rows, options.to)
    said = {f"slope_{name}": round(float(np.median(values)), 3) for name, values in slopes.items()}
    each = {name: [round(value, 3) for value in values] for name, values in slopes.items()}
    print(
        json.dumps({"name": "demos_shift: a ledge", "unit": "slope"} | said | {"slopes": each, "short": options.short})
    )


def learned(method: str, seed: int) -> Offline:
    """A clone of an expert's twenty episodes; or of four, and of as many steps more that it has corrected: 800 both."""
    world, rng = task(40), np.random.default_rng(seed)
    corrected = method == "dagger"
    epochs = 40 if corrected else 40 * (ROUNDS + 1)
    settings = CloneSettings(hidden=(16,), cloning_epochs=epochs, learning_rate=1e-3, threads=1)
    learner = settings.build(cast(Any, world), rng)
    with tempfile.TemporaryDirectory() as folder, Store[Segment](folder) as store:
        shows = Expert(ExpertSettings(episodes=4 if corrected else 20), cast(Any, world), forgetful(advice))
        shows.answer(store, rng)
        learner.improve(cast(Any, None), store, rng)
        for _ in range(ROUNDS if corrected else 0):
            store.ask([Query((one,)) for one in drawn(learner, world, rng)])
            shows.answer(store, rng)
            learner.improve(cast(Any, None), store, rng)
    return learner


def drawn(learner: Offline, world: GymnasiumTask, rng: np.random.Generator) -> list[Segment]:
    """Segments of what the policy draws: its mode would never fall."""
    from prefrl.policies.acting import played
    from prefrl.policies.rollout import collect
    from prefrl.sample.segments import segment

    envs = world.environments(CORRECTED)
    rollout, _ = collect(envs, envs.reset(rng), STEPS, played(learner.actor(), rng))
    name = f"drawn {rng.integers(2**62)}"
    return [segment(rollout, i, 0, STEPS, name) for i in range(CORRECTED)]


def mistakes(learner: Offline, horizon: int, episodes: int, seed: int) -> Floats:
    """(H,) how probable it is at each step that the drawn action is not the expert's."""
    world, rng, act = Ledge(), np.random.default_rng([seed, horizon]), learner.actor()
    states, found = world.start(episodes, rng), np.zeros(horizon)
    for t in range(horizon):
        seen = world.observe(states)
        actions, _ = act(seen, rng, None)
        found[t] = (actions != advice(seen)).any(1).mean()
        states, _, _ = world.advance(states, actions, rng)
    return found


def slope(rows: list[dict[str, Any]], method: str, seed: int) -> float:
    own = [(row["horizon"], row["mistakes"]) for row in rows if (row["method"], row["seed"]) == (method, seed)]
    return float(np.polyfit(*np.log(np.array(own)).T, 1)[0])


def write(rows: list[dict[str, Any]], to: Path) -> None:
    with to.with_suffix(".csv").open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: round(x, 6) if isinstance(x, float) else x for name, x in row.items()} for row in rows)
    figure = Figure(figsize=(6.2, 4.2), layout="constrained")
    ax = figure.subplots()
    ax.set(xlabel="horizon H, steps", ylabel="mistakes in an episode", xscale="log", yscale="log", xticks=HORIZONS)
    ax.set_xticks(HORIZONS, [str(horizon) for horizon in HORIZONS], minor=False)
    ax.grid(color="0.9")
    ax.spines[["top", "right"]].set_visible(False)
    horizons = np.array(HORIZONS)
    for name, colour, power, label in (("clone", "C1", 2, "eps H$^2$ / 2"), ("dagger", "C0", 1, "eps H")):
        own = [row for row in rows if row["method"] == name]
        for seed in sorted({row["seed"] for row in own}):
            ax.plot(horizons, [r["mistakes"] for r in own if r["seed"] == seed], ".-", color=colour, alpha=0.5)
        eps = float(np.mean([row["first"] for row in own]))
        ax.plot(horizons, eps * horizons**power / power, "--", color=colour, label=f"{name}: {label}, eps = {eps:.1e}")
    ax.legend(frameon=False)
    figure.savefig(to.with_suffix(".svg"))


if __name__ == "__main__":
    main()
