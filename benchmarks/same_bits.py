"""Do two commits learn the same weights, to the bit?

    python benchmarks/same_bits.py OLD [NEW]

Runs short presets on both commits (the working tree where NEW is left out), one thread each, and compares the sha256 of
every tensor that the last checkpoints hold: reward model, policy, optimiser. Names are left out, so that a change that
only moves code or renames parts passes. Ends with status 1 where anything differs. About four minutes.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from safetensors.numpy import load_file

ROOT = Path(__file__).parents[1]
RUNS = {"control/toy": 4, "text/toy": 2, "control/pendulum": 2, "text/reviews": 1}
"""Presets, and how many rounds of each."""
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


@contextmanager
def checkout(commit: str | None, work: Path) -> Iterator[Path]:
    """A folder that holds a commit; for None this working tree."""
    if commit is None:
        yield ROOT
        return
    folder = work / "tree"
    git("worktree", "add", "--detach", str(folder), commit)
    try:
        yield folder
    finally:
        git("worktree", "remove", "--force", str(folder))


def git(*arguments: str) -> None:
    subprocess.run(["git", "-C", str(ROOT), *arguments], check=True, capture_output=True)


def learned(tree: Path, preset: str, rounds: int, work: Path) -> Counter[str]:
    """The sha256 of each tensor after a run of the code in `tree`."""
    out = work / preset.replace("/", "-")
    environment = dict.fromkeys(THREADS, "1") | {"PYTHONPATH": str(tree), "XDG_CACHE_HOME": str(work / "cache")}
    command = [sys.executable, "-m", "prefrl", "run", preset, f"loop.rounds={rounds}", "--out", str(out)]
    subprocess.run(command, cwd=work, env=os.environ | environment, check=True, stdout=subprocess.DEVNULL)
    last = max((out / "checkpoints").iterdir())
    tensors = [tensor for file in sorted(last.glob("*.safetensors")) for tensor in load_file(file).values()]
    return Counter(hashlib.sha256(f"{t.dtype}{t.shape}".encode() + t.tobytes()).hexdigest() for t in tensors)


def tensors_of(commit: str | None, presets: list[str]) -> dict[str, Counter[str]]:
    with tempfile.TemporaryDirectory() as folder, checkout(commit, Path(folder)) as tree:
        return {preset: learned(tree, preset, RUNS[preset], Path(folder)) for preset in presets}


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("old", help="a commit")
    parser.add_argument("new", nargs="?", help="another one; this working tree where it is left out")
    parser.add_argument("--presets", nargs="+", choices=[*RUNS], default=[*RUNS])
    options = parser.parse_args()
    old, new = (tensors_of(commit, options.presets) for commit in (options.old, options.new))
    different = {preset: (old[preset] - new[preset]).total() for preset in options.presets}
    for preset in options.presets:
        print(f"{preset}: {different[preset]} of {old[preset].total()} tensors differ ({new[preset].total()} now)")
    same = old == new
    print(json.dumps({"name": "same_bits", "old": options.old, "new": options.new or "tree", "same": same}))
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main())
