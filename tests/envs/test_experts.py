"""The experts that are known without learning."""

from typing import cast

import numpy as np
import pytest

from prefrl.envs.control import ControlSettings
from prefrl.envs.experts import EXPERTS
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
