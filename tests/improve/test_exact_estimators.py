"""The estimators of the policy-gradient core against what is exact in tables: 4 standard errors of 200 batches."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import pytest
import torch
from torch import Tensor

from prefrl.envs import exact
from prefrl.envs.exact import MDP
from prefrl.envs.fast.vectorised import Vectorised
from prefrl.envs.tabular import Tabular
from prefrl.improve import objectives
from prefrl.types import Floats

BATCHES, EPISODES, HORIZON = 200, 32, 5
STATES, ACTIONS = 4, 3


class Played(NamedTuple):
    """Episodes of a fixed policy in a random world: (N, HORIZON) each."""

    mdp: MDP
    logits: Floats
    states: Tensor
    actions: Tensor
    rewards: Tensor

    @property
    def policy(self) -> Floats:
        return exact.soft(self.logits, 1.0)


@pytest.fixture(scope="module")
def played() -> Played:
    rng = np.random.default_rng(0)
    mdp = MDP(
        rng.dirichlet(np.full(STATES, 0.5), (STATES, ACTIONS)),
        rng.normal(size=(STATES, ACTIONS)),
        rng.dirichlet(np.ones(STATES)),
    )
    logits, count = rng.normal(size=(STATES, ACTIONS)), BATCHES * EPISODES
    environments, below = Vectorised(Tabular(mdp), count, HORIZON), exact.soft(logits, 1.0).cumsum(1)
    seen, found = environments.reset(rng), []
    for _ in range(HORIZON):
        states = seen.argmax(1)
        chosen = (rng.random((count, 1)) * below[states, -1:] >= below[states]).sum(1)
        step = environments.step(np.eye(ACTIONS, dtype=np.float32)[chosen])
        found.append((states, chosen, step.rewards))
        seen = step.observations
    states, actions, rewards = (torch.as_tensor(np.stack(x, 1)) for x in zip(*found, strict=True))
    return Played(mdp, logits, states, actions, rewards)


def traces(trace: float, exactly: bool) -> Callable[[Played], Tensor]:
    """GAE from a critic that knows every value, or from one that knows none: with a trace of 1 it may say anything."""

    def advantages(played: Played) -> Tensor:
        values = exact.returns_to_go(played.mdp, played.policy, HORIZON)
        known = torch.as_tensor(exact.state_values(played.policy, values))  # (HORIZON, S)
        if not exactly:
            known = torch.linspace(-3, 5, known.numel(), dtype=known.dtype).reshape(known.shape)
        here = known[torch.arange(HORIZON), played.states]
        after = torch.cat([here[:, 1:], torch.zeros_like(here[:, :1])], 1)
        ends = torch.zeros_like(here).index_fill_(1, torch.tensor([HORIZON - 1]), 1.0)
        return objectives.gae(played.rewards, here, after, ends, 1.0, trace)

    return advantages


def whole(baseline: Callable[[Tensor], Tensor], group: int) -> Callable[[Played], Tensor]:
    """The return of an episode, against others of its group, for each of its steps."""

    def advantages(played: Played) -> Tensor:
        scores = baseline(played.rewards.sum(1).reshape(-1, group)).reshape(-1, 1)
        return scores.expand(-1, HORIZON)

    return advantages


UNBIASED = {
    "returns to go": traces(1.0, exactly=False),
    "a critic that is right, trace 1": traces(1.0, exactly=True),
    "a critic that is right, trace 0.5": traces(0.5, exactly=True),
    "a critic that is right, trace 0": traces(0.0, exactly=True),
    "leave one out": whole(objectives.leave_one_out, 4),
    "leave one out of all": whole(objectives.leave_one_out, EPISODES),
}


@pytest.mark.parametrize("clip", [None, 0.2])
@pytest.mark.parametrize("name", UNBIASED)
def test_every_unbiased_advantage_gives_the_exact_policy_gradient(
    played: Played, name: str, clip: float | None
) -> None:
    advantages = UNBIASED[name](played)
    batches = gradients(played, advantages, clip)
    error = batches.std(0, ddof=1) / np.sqrt(BATCHES)
    wanted = exact.gradient(played.mdp, played.policy, HORIZON)
    assert (np.abs(batches.mean(0) - wanted) < 4 * error).all()
    assert np.abs(wanted).max() > 20 * error.max()  # a gradient of 0, or of the other sign, would be seen


def test_a_baseline_that_holds_an_episode_itself_shrinks_the_gradient_by_its_share(played: Played) -> None:
    def centred(scores: Tensor) -> Tensor:
        return torch.cat([objectives.batch_centred(batch[None]) for batch in scores])

    found = gradients(played, whole(centred, 4)(played), None)
    wanted = (1 - 1 / 4) * exact.gradient(played.mdp, played.policy, HORIZON)
    assert (np.abs(found.mean(0) - wanted) < 4 * found.std(0, ddof=1) / np.sqrt(BATCHES)).all()


def test_scaling_by_the_spread_of_a_group_keeps_the_direction(played: Played) -> None:
    wanted = exact.gradient(played.mdp, played.policy, HORIZON).ravel()
    for scaled in (objectives.group_normalised, objectives.batch_scaled, objectives.win_rates):
        found = gradients(played, whole(lambda x, scaled=scaled: scaled(x), 8)(played), None).mean(0).ravel()  # type: ignore[misc]
        assert found @ wanted > 0.97 * np.linalg.norm(found) * np.linalg.norm(wanted)


@pytest.mark.parametrize("estimator", [objectives.kl_k1, objectives.kl_k3])
def test_the_sampled_kl_is_the_exact_one(played: Played, estimator: Callable[[Tensor, Tensor], Tensor]) -> None:
    other = exact.soft(played.logits[:, ::-1], 1.0)
    mu = exact.marginals(played.mdp, played.policy, HORIZON).sum((0, 2))  # (S,) steps in each state
    wanted = mu @ (played.policy * np.log(played.policy / other)).sum(1)
    ours, theirs = (torch.as_tensor(np.log(p))[played.states, played.actions] for p in (played.policy, other))
    found = estimator(ours, theirs).sum(1).reshape(BATCHES, EPISODES).mean(1)
    assert abs(float(found.mean()) - wanted) < 4 * float(found.std()) / BATCHES**0.5
    assert wanted > 0.2


def gradients(played: Played, advantages: Tensor, clip: float | None) -> Floats:
    """(BATCHES, S, A): what each batch's loss says of the logits, for the policy that acted."""
    logits = torch.as_tensor(played.logits).expand(BATCHES, -1, -1).clone().requires_grad_()
    batch = torch.arange(BATCHES).repeat_interleave(EPISODES)[:, None]
    logp = logits.log_softmax(2)[batch, played.states, played.actions]
    mask = torch.ones_like(logp, dtype=torch.bool)
    if clip is None:
        losses = objectives.policy_gradient(logp, advantages)
    else:
        losses = objectives.clipped_surrogate(objectives.log_ratio(logp, logp.detach(), mask), advantages, clip)
    objectives.reduce(losses, mask, "constant", EPISODES, EPISODES * HORIZON).backward()  # type: ignore[no-untyped-call]
    assert logits.grad is not None
    return -logits.grad.numpy()
