"""The scripts and notebooks that a user would start from run as they are, and say what they promise."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

EXAMPLES = Path(__file__).parent.parent / "examples"
SAID = {
    "control_from_preferences": "what it does at zero:",
    "own_environment": "round 3: gold",
    "reward_from_file": "scores:",
    "own_reward_function": "round 3: reward",
    "own_labeler": "mean square of an action:",
    "sb3_on_a_learned_reward": "pendulum.zip: SAC after 600 steps",
}
"""A script -> the last thing that it says."""
NOTEBOOKS = ("control", "text")


def test_every_script_and_notebook_is_run() -> None:
    assert {path.stem for path in EXAMPLES.glob("*.py")} == set(SAID)
    assert {path.stem for path in EXAMPLES.glob("*.ipynb")} == set(NOTEBOOKS)


@pytest.mark.slow
@pytest.mark.parametrize("name", SAID)
def test_a_script_runs_in_an_empty_folder_to_its_end(name: str, tmp_path: Path) -> None:
    said = execute(tmp_path, str(EXAMPLES / f"{name}.py"))
    assert said.splitlines()[-1].startswith(SAID[name]), said


@pytest.mark.slow
@pytest.mark.parametrize("name", NOTEBOOKS)
def test_a_notebook_runs_from_its_first_cell_to_its_last(name: str, tmp_path: Path) -> None:
    cells = json.loads((EXAMPLES / f"{name}.ipynb").read_text())["cells"]
    code = [cell for cell in cells if cell["cell_type"] == "code"]
    assert all(output["output_type"] != "error" for cell in code for output in cell["outputs"])
    source = "\n".join("".join(cell["source"]) for cell in code).replace("text/reviews", "text/toy")
    execute(tmp_path, "-c", source)
    assert (tmp_path / f"runs/{name}-notebook/report.html").exists()


def execute(folder: Path, *program: str) -> str:
    """Run Python there; returns what it printed."""
    done = subprocess.run(
        [sys.executable, *program],
        cwd=folder,
        env=os.environ | {"OMP_NUM_THREADS": "1", "MPLBACKEND": "Agg"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout
