"""The scripts that a user would start from run as they are, and say what they promise."""

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


def test_every_script_is_run() -> None:
    assert {path.stem for path in EXAMPLES.glob("*.py")} == set(SAID)


@pytest.mark.slow
@pytest.mark.parametrize("name", SAID)
def test_a_script_runs_in_an_empty_folder_to_its_end(name: str, tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, str(EXAMPLES / f"{name}.py")],
        cwd=tmp_path,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines()[-1].startswith(SAID[name]), done.stdout
