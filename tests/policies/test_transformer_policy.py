"""A transformer over the last observations: it sees as far as it should, and no other episode."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from remembering_policies import MAZE, PENDULUM, SMALL, made, two_rollouts

from prefrl.policies.remembering import BOTH
from prefrl.policies.rollout import Rollout
from prefrl.policies.transformer import TransformerPolicySettings

REACH = SMALL.layers * (SMALL.context - 1)


def outputs(rollout: Rollout, memory: np.ndarray, context: int = 3) -> torch.Tensor:
    """(3, 17) values of a policy that looks back over two layers of `context` steps each."""
    policy = made(PENDULUM, 50, "transformer", context=context)
    return policy.read(rollout, memory, np.zeros((3, 17), bool)).values


def test_a_step_depends_on_the_last_observations_of_its_own_episode_alone() -> None:
    rollout, memory = two_rollouts(made(PENDULUM, 50, "transformer"), PENDULUM)
    before = outputs(rollout, memory)
    at = 5  # seven steps into the episode, which ends after the rollout's third and thirteenth step
    assert np.flatnonzero(rollout.ends[0]).tolist() == [2, 12]
    rollout.observations[0, at] += 1.0
    changed = np.flatnonzero((outputs(rollout, memory) - before).abs()[0].numpy() > 1e-6)
    assert changed.tolist() == list(range(at, at + REACH + 1))
    rollout.observations[0, 11] += 1.0  # the episode ends with the next step
    again = np.flatnonzero((outputs(rollout, memory) - before).abs()[0].numpy() > 1e-6)
    assert again.tolist() == [*range(at, at + REACH + 1), 11, 12]
    assert outputs(rollout, memory)[1:].equal(before[1:])


def test_values_and_those_of_final_observations_are_those_of_the_episode_seen_whole() -> None:
    """Also where the layers together reach less far back than its first step."""
    policy = made(MAZE, 4, "transformer")
    rollout, memory = two_rollouts(policy, MAZE)
    asked = rollout.ends.copy()
    assert np.flatnonzero(asked[0]).tolist() == [0, 6, 12]
    asked[:, 0] = False  # the episode that began in the rollout before
    reading = policy.read(rollout, memory, asked)
    chunks = policy.values(reading.inputs).reshape(3, -1)[:, :17]
    torch.testing.assert_close(chunks, reading.values)
    normalise, networks, finals = policy.normaliser.now(), policy._networks, reading.final.view(3, 2)
    for row, (episode, end) in product(range(3), enumerate((6, 12))):
        steps = slice(end - 5, end + 1)
        seen = np.concatenate([rollout.observations[row, steps], rollout.final_observations[row, [end]]])
        nothing = networks.known(np.zeros((1, networks.remembers), np.float32), normalise)
        begins = torch.zeros(1, 7, dtype=torch.bool)
        _, critic = networks.features(torch.from_numpy(normalise(seen))[None], begins, nothing, BOTH)
        expected = policy._values(critic)[:, 0]
        torch.testing.assert_close(reading.values[row, steps], expected[:-1], atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(finals[row, episode], expected[-1], atol=1e-5, rtol=1e-5)


def test_gradients_go_back_beyond_the_first_step_of_a_chunk() -> None:
    """The sign of a maze of 6 steps is attended to from chunks of 2."""
    policy = made(MAZE, 2, "transformer", context=6, layers=1)
    inputs = policy.read(*two_rollouts(policy, MAZE), np.zeros((3, 17), bool)).inputs
    inputs.known.requires_grad_()
    (slopes,) = torch.autograd.grad(policy.log_prob(inputs)[0].sum(), inputs.known)
    assert slopes[..., :-1].abs().sum(2).gt(0).any(1).sum() > len(inputs.mask) // 2


def test_widths_that_heads_cannot_share_are_refused() -> None:
    with pytest.raises(ValidationError, match="width must be a multiple of heads, got 64 and 5"):
        TransformerPolicySettings(heads=5)
