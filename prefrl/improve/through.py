"""Imagined branches with their gradients: a learned world, a learned reward and a policy as one function, in torch."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from torch import Tensor

from prefrl.components import ConfigError
from prefrl.envs.learned import World
from prefrl.policies.mlp import MLPPolicy
from prefrl.protocols import RewardModel, TracedRewards


class Branch(NamedTuple):
    """n imagined branches of h steps, in torch, with their gradients."""

    observations: Tensor
    """(n, h + 1, O), the last of which nothing was done in."""
    actions: Tensor
    """(n, h, A)."""
    going: Tensor
    """(n, h + 1): 1 up to the end of the episode, then 0."""


def follow(policy: MLPPolicy, world: World, starts: Tensor, noise: Tensor | None, steps: int, mean: bool) -> Branch:
    """Act in a learned world from starts (n, O), with standard normal noise (h, n, A) or by the mode.

    Branches follow the members, as many each (n is a multiple of E), or the `mean` of them all.
    """
    shape = starts.shape[:1] if mean else (world.members, len(starts) // world.members)
    state, going = starts.view(*shape, -1), starts.new_ones(shape)
    seen, done, alive = [state], list[Tensor](), [going]
    for t in range(steps):
        action = policy.traced(state, None if noise is None else noise[t].view(*shape, -1))
        after = world.predict(state, action)
        after = after.mean(0) if mean else after
        state, going = after[..., :-1], going * (after[..., -1] <= 0.5)
        seen, done, alive = [*seen, state], [*done, action], [*alive, going]
    observations, actions = (torch.stack(x, -2).view(len(starts), len(x), -1) for x in (seen, done))
    return Branch(observations, actions, torch.stack(alive, -1).view(len(starts), -1))


def returns(rewards: Tensor, going: Tensor, end: Tensor | None, discount: float) -> Tensor:
    """(n, h) rewards, (n, h + 1) and what the end is worth (n,) -> (n, h) discounted returns from each step on."""
    left, found = torch.zeros_like(rewards[:, 0]) if end is None else end * going[:, -1], list[Tensor]()
    for t in reversed(range(rewards.shape[1])):
        left = rewards[:, t] * going[:, t] + discount * left
        found.append(left)
    return torch.stack(found[::-1], 1)


def traced_rewards(reward: RewardModel[Any]) -> TracedRewards:
    """Raises `ConfigError` where a reward says nothing of its gradient."""
    if isinstance(reward, TracedRewards) and reward.traceable:
        return reward
    raise ConfigError(
        f"learner.kind=backprop goes back through the reward, and this one ({type(reward).__name__}) has no gradient "
        "to what was seen and done: use reward.kind=mlp, without hand-made features"
    )


@contextmanager
def held(parameters: Iterable[torch.nn.Parameter]) -> Iterator[None]:
    """What a gradient goes through, without any for itself."""
    some = [one for one in parameters if one.requires_grad]
    for one in some:
        one.requires_grad_(False)
    try:
        yield
    finally:
        for one in some:
            one.requires_grad_(True)


__all__ = ["Branch", "follow", "held", "returns", "traced_rewards"]
