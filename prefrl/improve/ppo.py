"""An advantage for each token of a response, from a critic: what makes the policy gradient PPO's.

Variant: Ziegler et al. 2019. The KL is taken off at each token and the score comes with the last one; GAE has no
discount. The critic may start from the reward model, as in Stiennon et al. 2020 and Huang et al. 2024. Left out:
updates of the critic alone before the policy moves.
"""

from __future__ import annotations

import math
from typing import Literal

import torch
from pydantic import Field
from torch import Tensor

from prefrl.components import ConfigError, Settings
from prefrl.improve.gradient import Batch
from prefrl.improve.objectives import gae, masked_whiten, step_rewards
from prefrl.policies.language import LanguagePolicy
from prefrl.policies.responses import Responses
from prefrl.protocols import RewardModel
from prefrl.reward_models.text import TransformerReward
from prefrl.types import Metrics, Response

NETWORKS = {
    "shared": "the policy's hidden states",
    "own": "a network of its own",
    "reward": "a network that starts from the reward model",
}


class CriticSettings(Settings):
    """What a value is expected from, and how it is learned."""

    network: Literal["shared", "own", "reward"] = "shared"
    """Whose hidden states the value is a linear function of: the policy's, which then learn from both losses; those
    of a network that starts as a copy of the policy; or of one that starts as a copy of the reward model, head and all,
    when the first batch is learned from."""
    weight: float = Field(0.1, gt=0)
    """Of the critic's loss beside the policy's."""
    clip: float | None = Field(None, gt=0)
    """How far a value may go in a batch before its loss no longer falls; null for the plain squared error."""
    trace: float = Field(1.0, ge=0, le=1)
    """GAE's lambda: 1 weighs whole returns, and is right whatever the critic has learned; 0 only the next token."""


def critic_formula(how: CriticSettings, penalty: str, score: str, whitened: bool) -> list[str]:
    """The advantages in plain letters: `penalty` for the KL of a token, and a score that comes with the last one."""
    clip = "" if how.clip is None else f", V within {how.clip:g} of V_old"
    return [
        f"A_t = G_t{', whitened' if whitened else ''}",
        f"G_t = sum_k {how.trace:g}^k [R_(t+k) + V_old(t+k+1) - V_old(t+k)]",
        f"R_t = [t = T] {score}{penalty}",
        f"minus {how.weight:g} mean_t [ (V(t) - G_t - V_old(t))^2 / 2 ]{clip};  V from {NETWORKS[how.network]}",
    ]


def by_token(
    policy: LanguagePolicy, drawn: Responses, scores: Tensor, kl: Tensor, beta: float, trace: float, whiten: bool
) -> tuple[Batch[Responses], Metrics]:
    """An advantage for each token, from scores (B,) and the KL of each token (B, L).

    Metrics: explained, the share of the returns' variance that the critic foresaw; NaN where they do not vary.
    """
    mask, values = drawn.mask, policy.all_values(drawn)  # (B, L)
    rewards = step_rewards(scores.nan_to_num(), kl, mask, beta)
    following = torch.cat([values[:, 1:], torch.zeros_like(values[:, :1])], 1)  # 0 after the last token
    # A response that was cut is over as well: its score is for what is there.
    ends = mask & ~torch.cat([mask[:, 1:], torch.zeros_like(mask[:, :1])], 1)
    advantages = gae(rewards, values, following, ends, 1.0, trace)
    known = mask & ~scores.isnan()[:, None]
    advantages = torch.where(known, advantages, 0.0)  # where nothing was scored the critic is held where it is
    returns = values + advantages
    explained = _explained(advantages[known], returns[known])
    used = masked_whiten(advantages, known) if whiten else advantages
    return Batch(drawn, drawn.logp, used, returns, values), {"explained": explained}


def start_from_reward(policy: LanguagePolicy, reward: RewardModel[Response]) -> None:
    """Give the critic the reward model's network and head: at first its value is the score of what stands there.

    Raises `ConfigError` as `check_start` does.
    """
    found = check_start(policy, reward)
    policy.start_critic(found.backbone.model.state_dict(), *found.mean_head())


def check_start(policy: LanguagePolicy, reward: RewardModel[Response]) -> TransformerReward:
    """The reward model, if a critic can start from it.

    Raises `ConfigError` where it is no network like the policy's that reads the policy's tokens.
    """
    wanted = "learner.critic.network=reward starts from a reward model that is fitted whole on the starting policy"
    if not isinstance(reward, TransformerReward) or reward.backbone.opened is None or reward.backbone.chat:
        raise ConfigError(f"{wanted}: set reward.kind=transformer, and leave its backbone and checkpoint empty")
    if not policy.critic_fits(reward.backbone.model.state_dict()):
        raise ConfigError(f"{wanted}: set reward.train=full, and leave reward.backbone empty")
    return reward


def _explained(errors: Tensor, returns: Tensor) -> float:
    variance = float(returns.var(correction=0)) if len(returns) else 0.0
    # By rounding returns that are all alike vary too.
    alike = variance <= 1e-10 * float(returns.square().mean()) if variance else True
    return math.nan if alike else 1.0 - float(errors.var(correction=0)) / variance
