"""Run a preset over several seeds, one after another, each in its own process, and say what came of it.

    python benchmarks/seeds.py control/pendulum --seeds 5 [dotted.key=value ...]

Runs lie in runs/seeds/ and are taken up where they stopped. The last line is one JSON object.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import time
from pathlib import Path
from statistics import mean
from typing import Any


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("preset")
    parser.add_argument("overrides", nargs="*")
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("runs/seeds"))
    options = parser.parse_args()
    rows = [run(options.preset, seed, options.overrides, options.out) for seed in range(options.seeds)]
    print(json.dumps(account(options.preset, options.overrides, rows)))


def run(preset: str, seed: int, overrides: list[str], out: Path) -> dict[str, Any]:
    """One seed: its summary, and the wall time of the whole command."""
    folder = out / "-".join([preset.replace("/", "-"), *overrides, str(seed)])
    command = [sys.executable, "-m", "prefrl", "run", preset, f"seed={seed}", *overrides, "--out", str(folder)]
    begin = time.perf_counter()
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    summary: dict[str, Any] = json.loads((folder / "summary.json").read_text())
    row = summary | {"wall": round(time.perf_counter() - begin, 1)}
    shown = ("seed", "gold_before", "gold_after", "fluency_before", "fluency_after", "kl", "labels", "steps", "wall")
    print({name: row[name] for name in shown if row[name] is not None}, flush=True)
    return row


def account(preset: str, overrides: list[str], rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Means and ranges over the seeds."""
    gold = [row["gold_after"] for row in rows]
    made = {
        "name": preset,
        "overrides": overrides,
        "seeds": len(rows),
        "gold_before": mean(row["gold_before"] for row in rows),
        "gold_after": mean(gold),
        "gold_range": [min(gold), max(gold)],
        "labels": max(row["labels"]["asked"] for row in rows),
        "steps_learn_and_query": max(row["steps"]["learn"] + row["steps"]["query"] for row in rows),
        "wall_seconds": [min(row["wall"] for row in rows), max(row["wall"] for row in rows)],
    }
    if rows[0]["kind"] == "text":
        shares = [row["fluency_after"] / row["fluency_before"] for row in rows]
        made |= {"fluency_share": mean(shares), "kl": mean(row["kl"] for row in rows)}
    return made


if __name__ == "__main__":
    main()
