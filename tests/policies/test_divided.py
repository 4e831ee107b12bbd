"""Some of a task's environments fare as they do among all of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from prefrl.envs.control import ControlSettings, GymnasiumTask


def _task(**settings: Any) -> GymnasiumTask:
    return ControlSettings.model_validate(
        {"horizon": 6, "segment_steps": 2, "hide": [1], "stack": 2, **settings}
    ).build()


@pytest.mark.parametrize(
    "settings",
    [
        {"env": "InvertedPendulum-v5"},
        {"env": "Pendulum-v1", "options": {"g": 9.0}},
        {"env": "CartPole-v1", "after_end": "restart"},
        {"env": "Acrobot-v1", "options": {"render_mode": None}, "variable_horizon": True},
    ],
)
def test_environments_of_two_ranks_go_through_what_all_do(settings: dict[str, Any]) -> None:
    task, count, seeds, drawn = _task(**settings), 5, np.random.default_rng(0), np.random.default_rng(1)
    mine = (range(2), range(2, 5))
    several = [task.some_environments(count, which) for which in mine]
    rngs = [np.random.default_rng(0) for _ in mine]
    all_ = task.environments(count)
    observations = all_.reset(seeds)
    for which, envs, rng in zip(mine, several, rngs, strict=True):
        assert envs is not None
        np.testing.assert_array_equal(envs.reset(rng), observations[which.start : which.stop])
    for _ in range(15):  # past the ends of two episodes
        actions = drawn.normal(size=(count, task.action_size)).astype(np.float32)
        step = all_.step(actions)
        for which, envs in zip(mine, several, strict=True):
            rows = slice(which.start, which.stop)
            assert envs is not None
            for one, other in zip(envs.step(actions[rows]), step, strict=True):
                np.testing.assert_array_equal(one, other[rows])
    # What is drawn from the same generators later, the policy's noise say, is the same too.
    assert all(rng.bit_generator.state == seeds.bit_generator.state for rng in rngs)


@pytest.mark.parametrize(
    "settings",
    [
        {"env": "Pendulum-v1"},
        {"env": "InvertedPendulum-v5", "variable_horizon": True},
        {"env": "InvertedPendulum-v5", "flicker": 0.5},
    ],
)
def test_what_hangs_on_the_others_or_costs_nothing_is_not_parted(settings: dict[str, Any]) -> None:
    assert _task(**settings).some_environments(4, range(2)) is None


def test_a_fault_names_the_environment_by_its_number_among_all() -> None:
    envs = _task(env="Pendulum-v1", options={"g": 9.0}).some_environments(5, range(2, 5))
    assert envs is not None
    envs.reset(np.random.default_rng(0))
    with pytest.raises(ValueError, match="environment 3, step 0 of its episode: its reward is nan"):
        envs.step(np.array([[0.0], [np.nan], [0.0]], np.float32))
