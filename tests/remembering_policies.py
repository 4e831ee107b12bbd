"""Policies with a memory, for tests: some way from their start, so that outputs differ from step to step."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch

from prefrl.envs.control import ControlSettings
from prefrl.envs.toys import TMazeSettings
from prefrl.policies.acting import Acting, forgotten
from prefrl.policies.gru import GRUPolicySettings
from prefrl.policies.remembering import RememberingPolicy
from prefrl.policies.rollout import Rollout, collect
from prefrl.policies.transformer import TransformerPolicySettings
from prefrl.protocols import ControlTask
from prefrl.types import Floats

PENDULUM = ControlSettings(env="Pendulum-v1", hide=(2,), horizon=10, segment_steps=3).build()
MAZE = TMazeSettings(length=6).build()
TASKS: dict[str, ControlTask] = {"box": PENDULUM, "discrete": MAZE}
SMALL = TransformerPolicySettings(context=3, layers=2, width=6, heads=2, hidden=5)
KINDS: dict[str, GRUPolicySettings | TransformerPolicySettings] = {
    "gru": GRUPolicySettings(width=5, hidden=6),
    "transformer": SMALL,
}


def made(task: ControlTask, chunk: int = 4, kind: str = "gru", **changes: Any) -> RememberingPolicy:
    policy = KINDS[kind].model_copy(update={"chunk": chunk} | changes).build(task, np.random.default_rng(0))
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.data += 0.3 * torch.randn(parameter.shape, generator=generator)
    policy.observe(np.random.default_rng(2).normal(0.1, 0.7, (50, task.observation_size)))
    return policy


def two_rollouts(policy: RememberingPolicy, task: ControlTask) -> tuple[Rollout, Floats]:
    """The second of two rollouts of 17 steps that follow one another, and what was remembered where it begins."""
    envs, act = task.environments(3), Acting(policy.decide(), np.random.default_rng(4))
    first, observations = collect(envs, envs.reset(np.random.default_rng(3)), 17, act)
    begins = first.ends[:, -1]
    memory = forgotten(act.memory, begins)
    assert memory is not None
    return collect(envs, observations, 17, act, begins)[0], memory
