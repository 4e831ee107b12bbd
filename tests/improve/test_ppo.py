"""PPO for text: a critic's values of what stands before a token, and the advantages that come of them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
import torch
from torch import Tensor

from prefrl.components import ConfigError
from prefrl.envs.text import Reviews
from prefrl.improve.ppo import by_token, start_from_reward
from prefrl.improve.text import TextLearner, TextLearnerSettings
from prefrl.policies.responses import Responses
from prefrl.protocols import RewardModel, Store
from prefrl.reward_models.text import TransformerReward, TransformerSettings
from prefrl.types import Floats, Response

NO_STORE = cast("Store[Response]", None)
NETWORKS = ("shared", "own")


class Lengths:
    """Scores a response by its length, or not at all."""

    def __init__(self, known: bool = True) -> None:
        self.known = known

    def score(self, candidates: list[Response]) -> Floats:
        return np.array([len(c.tokens) if self.known else np.nan for c in candidates], np.float32)


class Openings:
    """Scores a response by its prompt alone, so that all is known before the first token."""

    def score(self, candidates: list[Response]) -> Floats:
        return np.array([float(c.prompt.endswith("and")) for c in candidates], np.float32)


LENGTHS = cast("RewardModel[Response]", Lengths())
OPENINGS = cast("RewardModel[Response]", Openings())


def learner(task: Reviews, network: str = "shared", **changes: Any) -> TextLearner:
    small = {"algorithm": "ppo", "updates": 1, "prompts": 16, "evaluation_prompts": 8, "critic": {"network": network}}
    return TextLearnerSettings.model_validate(small | changes).build(task, np.random.default_rng(0))


def drawn(one: TextLearner, count: int = 12) -> Responses:
    return one.policy.respond(["The plot was"] * (count // 2), 2, np.random.default_rng(0))


def with_head(one: TextLearner) -> None:
    """Give the critic something to say."""
    assert one.policy.critic is not None
    with torch.no_grad():
        one.policy.critic.head.weight.copy_(torch.linspace(-1, 1, one.policy.critic.head.weight.numel())[None])


@pytest.mark.parametrize("network", NETWORKS)
def test_values_are_0_at_first_and_on_padding_and_come_with_the_log_probabilities(
    toy_reviews: Reviews, network: str
) -> None:
    one = learner(toy_reviews, network)
    rows = drawn(one)
    assert not one.policy.values(rows).any()
    with_head(one)
    logp, _, values = one.policy.log_prob_and_values(rows)
    torch.testing.assert_close(values, one.policy.values(rows))
    torch.testing.assert_close(logp, one.policy.log_prob(rows)[0])
    torch.testing.assert_close(values.detach(), one.policy.all_values(rows))
    assert not values[~rows.mask].any()
    assert values[rows.mask].std() > 0.01


@pytest.mark.parametrize("network", NETWORKS)
def test_a_value_is_of_what_stands_before_its_token(toy_reviews: Reviews, network: str) -> None:
    one = learner(toy_reviews, network)
    with_head(one)
    rows = drawn(one)
    other = rows.tokens.clone()
    other[:, 2] = (other[:, 2] + 1) % 100
    before, after = one.policy.values(rows), one.policy.values(replace(rows, tokens=other))
    torch.testing.assert_close(after[:, :3], before[:, :3])
    assert not torch.allclose(after[:, 3], before[:, 3])


@pytest.mark.parametrize("network", NETWORKS)
def test_the_policys_network_learns_from_the_critic_where_it_is_shared(toy_reviews: Reviews, network: str) -> None:
    one = learner(toy_reviews, network)
    with_head(one)
    one.policy.values(drawn(one)).sum().backward()  # type: ignore[no-untyped-call]
    learns = any(p.grad is not None and p.grad.any() for p in one.policy.model.parameters())
    assert learns is (network == "shared")


@pytest.mark.parametrize("network", NETWORKS)
def test_it_learns_what_is_to_come(toy_reviews: Reviews, network: str) -> None:
    one = learner(
        toy_reviews,
        network,
        prompts=32,
        learning_rate=3e-3,
        beta=0.0,
        missing_end_penalty=0.0,
        critic={"network": network, "weight": 10.0},
    )
    explained = [one.improve(OPENINGS, NO_STORE, np.random.default_rng(seed))["explained"] for seed in range(20)]
    assert explained[0] == pytest.approx(0, abs=0.05)  # a constant, in the first of its four epochs
    assert np.mean(explained[-5:]) > 0.4


def test_advantages_and_returns_by_hand(toy_reviews: Reviews) -> None:
    one = learner(toy_reviews, critic={"trace": 0.5}, beta=0.5)
    with_head(one)
    rows = drawn(one, 2)
    scores, kl = torch.tensor([2.0, -1.0]), torch.where(rows.mask, 0.1, 0.0)
    batch, _ = by_token(one.policy, rows, scores, kl, beta=0.5, trace=0.5, whiten=False)
    values = one.policy.all_values(rows)
    for row, count in enumerate(rows.mask.sum(1).tolist()):
        rewards = [-0.05] * (count - 1) + [float(scores[row]) - 0.05]
        following, running = 0.0, 0.0
        for t in reversed(range(count)):
            value = float(values[row, t])
            running = rewards[t] + following - value + 0.5 * running
            assert float(batch.advantages[row, t]) == pytest.approx(running, abs=1e-5)
            assert batch.returns is not None
            assert float(batch.returns[row, t]) == pytest.approx(running + value, abs=1e-5)
            following = value
    assert not batch.advantages[~rows.mask].any()


def test_a_critic_from_the_reward_model_begins_with_the_score_of_what_stands_there(toy_reviews: Reviews) -> None:
    one, reward = learner(toy_reviews, "reward"), fitted(toy_reviews)
    start_from_reward(one.policy, reward)
    rows = drawn(one)
    values = one.policy.all_values(rows)
    whole = rows.candidates(toy_reviews.tokenizer)
    for row, step in ((0, 1), (1, 2), (2, 3)):
        before = replace(whole[row], tokens=whole[row].tokens[:step])
        assert float(values[row, step]) == pytest.approx(float(reward.score([before])[0]), abs=1e-4)
    assert values[rows.mask].std() > 0.01


def fitted(task: Reviews, **settings: Any) -> TransformerReward:
    """A reward model whose scores have a shift and a scale."""
    reward = TransformerSettings(**settings).build(task, np.random.default_rng(3))
    asked = task.prompts(4, np.random.default_rng(0))
    policy = learner(task).policy
    candidates = policy.respond(asked, 4, np.random.default_rng(1)).candidates(task.tokenizer)
    reward.settle(reward.stack(candidates), lambda scores: scores.sum(1))
    return reward


def test_a_critic_starts_from_the_reward_model_once(toy_reviews: Reviews) -> None:
    one = learner(toy_reviews, "reward", learning_rate=1e-9)
    first = fitted(toy_reviews)
    one.improve(first, NO_STORE, np.random.default_rng(0))
    taken = head(one).clone()
    torch.testing.assert_close(taken[0], first.mean_head()[0])
    one.improve(cast("RewardModel[Response]", Lengths()), NO_STORE, np.random.default_rng(0))
    torch.testing.assert_close(head(one), taken)


@pytest.mark.parametrize("reward", [{"train": "lora"}, None])
def test_a_critic_cannot_start_from_any_reward(toy_reviews: Reviews, reward: dict[str, Any] | None) -> None:
    found = LENGTHS if reward is None else fitted(toy_reviews, **reward)
    with pytest.raises(ConfigError, match=r"critic\.network=reward"):
        learner(toy_reviews, "reward").check_reward(found)
    learner(toy_reviews, "reward").check_reward(fitted(toy_reviews))
    learner(toy_reviews, "own").check_reward(found)


def test_what_no_reward_scored_leaves_policy_and_critic_as_they_are(toy_reviews: Reviews) -> None:
    one = learner(toy_reviews, epochs=1)
    with_head(one)
    before = {name: value.clone() for name, value in one.policy.state().items()}
    metrics = one.improve(cast("RewardModel[Response]", Lengths(known=False)), NO_STORE, np.random.default_rng(0))
    assert metrics["unscored"] == 1
    for name, value in one.policy.state().items():
        torch.testing.assert_close(value, before[name], msg=name)


def test_a_state_holds_the_critic_and_fits_its_own_kind_alone(toy_reviews: Reviews) -> None:
    one = learner(toy_reviews)
    with_head(one)
    state = one.state()
    again = learner(toy_reviews)
    again.load(state)
    assert torch.equal(head(again), head(one))
    with pytest.raises(ValueError, match="critic"):
        learner(toy_reviews, "own").load(state)
    TextLearnerSettings(updates=1).build(toy_reviews, np.random.default_rng(0))


def head(one: TextLearner) -> Tensor:
    assert one.policy.critic is not None
    return one.policy.critic.head.weight


def test_a_policy_without_a_critic_says_so(toy_reviews: Reviews) -> None:
    one = TextLearnerSettings().build(toy_reviews, np.random.default_rng(0))
    with pytest.raises(ValueError, match="without a critic"):
        one.policy.log_prob_and_values(drawn(one))


def test_adapters_and_a_critic_go_together(toy_reviews: Reviews) -> None:
    one = learner(toy_reviews, policy={"train": "lora", "lora_rank": 2})
    before = one.policy.state()
    one.improve(LENGTHS, NO_STORE, np.random.default_rng(0))
    changed = {name for name, value in one.policy.state().items() if not torch.equal(value, before[name])}
    assert {"critic.head.weight", "critic.head.bias"} < changed
    assert all("lora_" in name or "critic." in name for name in changed)


@pytest.mark.parametrize(("given", "batch"), [({}, (128, 1)), ({"prompts": 6}, (6, 8)), ({"responses": 2}, (128, 2))])
def test_one_response_a_prompt_is_for_many_prompts_alone(given: dict[str, int], batch: tuple[int, int]) -> None:
    settings = TextLearnerSettings.model_validate({"algorithm": "ppo"} | given)
    assert (settings.prompts, settings.responses) == batch


def test_a_kl_that_is_not_a_reward_is_refused() -> None:
    with pytest.raises(ValueError, match="kl_in=reward"):
        TextLearnerSettings(algorithm="ppo", kl_in="advantage")


def test_where_returns_do_not_vary_there_is_nothing_to_explain(toy_reviews: Reviews) -> None:
    class Same:
        def score(self, candidates: list[Response]) -> Floats:
            return np.full(len(candidates), 10.0, np.float32)

    one = learner(toy_reviews, beta=0.0, missing_end_penalty=0.0)
    metrics = one.improve(cast("RewardModel[Response]", Same()), NO_STORE, np.random.default_rng(0))
    assert np.isnan(metrics["explained"])
