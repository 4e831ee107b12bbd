"""Environments at fault: what is said of them, and what is left of the run."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from prefrl import Config, Run
from prefrl.components import PLUGINS
from prefrl.envs.fast.watched import TIMED_OUT, EnvironmentFault, guarded
from prefrl.envs.fast.wrapped import Wrapped
from prefrl.policies.rollout import collect
from prefrl.types import Bools, Floats


class Faulty(gymnasium.Env[Any, Any]):
    """It does as it is told, but for one step."""

    observation_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, fault: str = "", at: int = 3) -> None:
        self.fault, self.at, self.steps = fault, at, 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        if self.fault == "reset":
            raise OSError("the port is closed")
        return np.zeros(2, np.float32), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.steps += 1
        if self.steps <= self.at:
            return np.zeros(2, np.float32), 0.5, False, False, {}
        if self.fault == "raises":
            raise ZeroDivisionError("no mass")
        if self.fault == "hangs":
            time.sleep(60)
        observation = {"shape": np.zeros(1, np.float32), "type": np.zeros(2)}.get(self.fault, np.zeros(2, np.float32))
        reward = {"nan": np.nan, "infinite": -np.inf}.get(self.fault, 0.0)
        return observation, reward, False, False, {}


def _run(fault: str, steps: int = 6) -> None:
    kinds = iter(["", fault])
    envs = Wrapped(lambda: Faulty(next(kinds)), 2, 10, "absorb")
    envs.reset(np.random.default_rng(0))
    for _ in range(steps):
        envs.step(np.zeros((2, 1), np.float32))


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        ("raises", "environment 1, step 3 of its episode raised ZeroDivisionError: no mass"),
        ("reset", "a reset of environment 1 raised OSError: the port is closed"),
        ("nan", r"environment 1, step 3 of its episode: its reward is nan, after action \[0\.\]"),
        ("infinite", "environment 1, step 3 of its episode: its reward is -inf"),
        ("shape", r"environment 1, step 3 of its episode: its observation has shape \(1,\) and type float32, but"),
        ("type", r"environment 1, step 3 .* shape \(2,\) and type float64, but the first one had \(2,\) and float32"),
    ],
)
def test_a_fault_is_told_with_the_environment_and_the_step(fault: str, said: str) -> None:
    with pytest.raises(EnvironmentFault, match=said) as caught:
        _run(fault)
    if fault in ("raises", "reset"):
        assert isinstance(caught.value.__cause__, ZeroDivisionError | OSError)
    _run("")


def test_an_action_that_is_not_finite_is_told_before_the_environment_sees_it() -> None:
    envs = Wrapped(Faulty, 2, 10, "absorb")
    steps = iter(range(5))

    def act(observations: Floats, legal: Bools | None, begins: Bools) -> tuple[Floats, Floats]:
        actions = np.zeros((2, 1), np.float32)
        actions[1] = np.inf if next(steps) == 2 else 0.0
        return actions, actions

    with pytest.raises(FloatingPointError, match=r"action of environment 1 in step 2 of the rollout is \[inf\]"):
        collect(envs, envs.reset(np.random.default_rng(0)), 5, act)


def test_an_environment_that_hangs_ends_the_process_and_says_which(tmp_path: Path) -> None:
    script = (
        "import time; from prefrl.envs.fast.watched import guarded\n"
        "with guarded('environment 1, step 3 of its episode', 0.2): time.sleep(60)\n"
    )
    known = os.environ | {PLUGINS: "mine.py"}
    ended = subprocess.run([sys.executable, "-c", script], env=known, capture_output=True, text=True, timeout=30)
    assert ended.returncode == TIMED_OUT
    assert "go on with prefrl --plugin mine.py resume FOLDER" in ended.stderr
    assert "environment 1, step 3 of its episode has not come back within 0.2 seconds" in ended.stderr
    with guarded("what is quick enough", 30.0):
        pass


def test_a_run_says_from_where_it_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with Run(Config.load("control/toy"), tmp_path / "run") as run:
        rounds = iter(run)
        next(rounds)
        monkeypatch.setattr(run.loop.learner, "sample", lambda *_: _run("raises"))
        with pytest.raises(EnvironmentFault, match=r"no mass\n.*round-0000; once .*, go on with: prefrl resume .*run$"):
            next(rounds)
