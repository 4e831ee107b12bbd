"""The experts that are known without learning."""

from typing import cast

import numpy as np
import pytest

from prefrl.envs.control import ControlSettings
from prefrl.envs.experts import EXPERTS, MOODS
from prefrl.envs.toys import ForkSettings
from prefrl.policies.rollout import whole_episodes
from prefrl.protocols import ControlTask
from prefrl.types import Bools, Floats


@pytest.mark.parametrize(("name", "least"), [("Pendulum-v1", -170.0)])
def test_an_expert_is_one(name: str, least: float) -> None:
    task = cast("ControlTask", ControlSettings.model_validate({"env": name}).build())
    size, advice = EXPERTS[name]
    assert size == task.observation_size

    def act(observations: Floats, legal: Bools | None, begins: Bools) -> tuple[Floats, Floats]:
        actions = advice(observations)
        return actions, actions

    rollout = whole_episodes(task, act, 200, np.random.default_rng(0))
    assert rollout.gold.sum(1).mean() > least


@pytest.mark.parametrize("side", [-1.0, 1.0])
def test_the_expert_of_the_fork_gets_there_on_either_side_and_goes_on_where_it_is(side: float) -> None:
    task = ForkSettings().build()

    def act(observations: Floats, legal: Bools | None, begins: Bools) -> tuple[Floats, Floats]:
        actions = MOODS["fork"](observations, np.full(len(observations), 0.5 + 0.4 * side))
        beyond = side * observations[:, 0] > 0
        np.testing.assert_array_equal(EXPERTS["fork"][1](observations)[beyond], actions[beyond])
        return actions, actions

    rollout = whole_episodes(task, act, 100, np.random.default_rng(0))
    assert (rollout.gold.sum(1) == 1).all()
    assert rollout.states is not None
    assert (rollout.states[:, -1, 3] == side).all()
