"""Online DPO: its optima by exact enumeration, the pairs that it makes, and what it learns on the toy."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import preferred
import pytest
import torch
from preferred import LIKES, NO_STORE, SMALL
from test_fixed_points import logp
from test_fixed_points import solved as solved  # a fixture
from torch import Tensor

from prefrl.envs.text import Reviews
from prefrl.improve.direct import Direct, Pairs
from prefrl.improve.objectives import dpo_loss, ipo_loss
from prefrl.improve.online_dpo import OnlineDPOSettings, pairs_of
from prefrl.policies.responses import Responses
from prefrl.protocols import RewardModel
from prefrl.types import Floats, Response

BETA, N = 0.3, 12
SOFT: dict[str, Any] = {"soft": True, "beta": BETA, "missing_end_penalty": 0.0, "policy": {"chunk": 1000}}
UNSCORED = np.nan


def learner(task: Any, **changes: object) -> Direct:
    settings = SMALL | {"updates": 8, "prompts": 8} | changes
    return OnlineDPOSettings.model_validate(settings).build(task, np.random.default_rng(0))


# --- optima -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("responses", [2, 4])
def test_soft_pairs_have_no_gradient_where_the_policy_is_the_start_tilted_by_the_reward(
    solved: Any, responses: int
) -> None:
    """In each single batch, and whatever pairs are chosen: not only on average."""
    task, best = solved
    reward = preferred.implied(best, task.start, BETA)
    for soft in (True, False):
        settings = OnlineDPOSettings.model_validate(SOFT | {"soft": soft, "updates": 1, "responses": responses})
        there = preferred.at(best, settings, task)
        found = there.improve(reward, NO_STORE, np.random.default_rng(0))
        assert found["pairs"] > 10
        assert found["margin"] > 0.01
        assert (found["grad_norm"] < 1e-4) == soft  # sure pairs pull on, see below


def test_soft_pairs_lead_to_the_start_tilted_by_the_reward(solved: Any) -> None:
    task, best = solved
    reward = preferred.implied(best, task.start, BETA)
    settings = OnlineDPOSettings.model_validate(SOFT | {"updates": 50, "prompts": 64, "learning_rate": 3e-3})
    one = settings.build(task, np.random.default_rng(0))
    one.improve(reward, NO_STORE, np.random.default_rng(0))
    with torch.no_grad():
        start, found, aim = logp(task.start), logp(one.policy.model), logp(best)
    assert kl(found, aim) < 0.06 * kl(start, aim)  # what is missing of reward - beta x KL, over beta


def kl(p: Tensor, q: Tensor) -> float:
    return float((p.exp() * (p - q)).sum())


REFERENCE = torch.randn(N, generator=torch.Generator().manual_seed(1), dtype=torch.float64).log_softmax(0)
WINS = (torch.arange(N)[:, None] > torch.arange(N)).double() + 0.5 * torch.eye(N, dtype=torch.float64)
"""(N, N) sure preferences: the later one is better."""


def pull(policy: Tensor, square: bool) -> Tensor:
    """(N,) the expected gradient in the logits, of all pairs as the policy (N,) itself draws them."""
    logits = policy.log().requires_grad_()
    gains = logits.log_softmax(0) - REFERENCE
    gaps = gains[:, None] - gains
    losses = ipo_loss(gaps, WINS, 0.0, BETA) if square else dpo_loss(BETA * gaps, WINS, 0.0)
    (found,) = torch.autograd.grad((policy[:, None] * policy * losses).sum(), logits)
    return found


def test_sure_pairs_with_the_square_stop_at_the_start_tilted_by_the_chance_to_beat_the_policy_itself() -> None:
    """The equilibrium of playing against oneself (Calandriello et al. 2024), found by damped steps."""
    policy = REFERENCE.exp()
    for _ in range(200):
        tilted = (REFERENCE + WINS @ policy / BETA).softmax(0)
        policy = 0.7 * policy + 0.3 * tilted
    torch.testing.assert_close(policy, tilted)
    torch.testing.assert_close(pull(policy, square=True), torch.zeros(N, dtype=torch.float64), atol=1e-10, rtol=0)


def test_sure_pairs_with_the_sigmoid_raise_the_best_response_wherever_the_policy_is() -> None:
    """So nothing holds it near the start but the number of updates."""
    generator = torch.Generator().manual_seed(5)
    for scale in (0.1, 1.0, 3.0):
        policy = (scale * torch.randn(N, generator=generator, dtype=torch.float64)).softmax(0)
        found = pull(policy, square=False)
        assert found[-1] < 0 < found[0]  # going down it raises the best one and lowers the worst


# --- pairs ------------------------------------------------------------------------------------------------------------


def drawn(count: int) -> Responses:
    tokens = torch.zeros(count, 1, dtype=torch.int64)
    return Responses(("?",) * count, ((1,),) * count, tokens, tokens == 0, tokens.float(), tokens[:, 0] == 0)


def pairs(worth: Sequence[Sequence[float]], **changes: object) -> Pairs:
    settings = OnlineDPOSettings.model_validate({"responses": len(worth[0]), **changes})
    flat = np.array(worth, np.float32).flatten()
    return pairs_of(settings, drawn(len(flat)), torch.zeros(len(flat)), flat)


def test_the_best_and_the_worst_that_were_scored_make_a_pair_and_equal_ones_none() -> None:
    found = pairs(
        [
            [0.0, 2.0, 1.0],
            [1.0, 1.0, 1.0],
            [UNSCORED, -1.0, 3.0],
            [UNSCORED, UNSCORED, 5.0],
            [UNSCORED, UNSCORED, UNSCORED],
            [2.0, UNSCORED, 1.5],
        ]
    )
    assert found.edges.tolist() == [[1, 0], [8, 7], [15, 17]]
    assert found.preference.tolist() == [1.0, 1.0, 1.0]


def test_soft_pairs_count_with_the_probability_that_the_scores_say() -> None:
    found = pairs([[0.0, 2.0], [1.0, 0.5]], soft=True)
    assert found.preference.tolist() == pytest.approx([1 / (1 + math.exp(-2.0)), 1 / (1 + math.exp(-0.5))])


class Alike:
    """Gives all responses one score."""

    def __init__(self, worth: float) -> None:
        self._worth = worth

    def score(self, candidates: Sequence[Response]) -> Floats:
        return np.full(len(candidates), self._worth, np.float32)


@pytest.mark.parametrize(("worth", "unscored"), [(0.0, 0.0), (UNSCORED, 1.0)])
def test_without_a_pair_nothing_is_learned(toy_reviews: Reviews, worth: float, unscored: float) -> None:
    one = learner(toy_reviews, updates=1, missing_end_penalty=0.0)
    before = preferred.flat(one)
    found = one.improve(cast("RewardModel[Response]", Alike(worth)), NO_STORE, np.random.default_rng(0))
    assert torch.equal(before, preferred.flat(one))
    assert (found["equal_groups"], found["pairs"], found["updates"], found["unscored"]) == (1.0, 0.0, 0.0, unscored)
    assert "loss" not in found


def test_an_infinite_score_is_an_error(toy_reviews: Reviews) -> None:
    with pytest.raises(FloatingPointError, match="a reward is infinite"):
        learner(toy_reviews, prompts=1).improve(
            cast("RewardModel[Response]", Alike(np.inf)), NO_STORE, np.random.default_rng(0)
        )


def test_a_response_without_an_end_is_the_worse_one_of_two_that_score_alike(toy_reviews: Reviews) -> None:
    one = learner(toy_reviews, updates=1, prompts=16)
    found = one.improve(cast("RewardModel[Response]", Alike(0.0)), NO_STORE, np.random.default_rng(0))
    assert 0 < found["ended"] < 1
    assert 0 < found["pairs"] < 16
    assert found["pairs"] == pytest.approx(16 * (1 - found["equal_groups"]))


# --- on the toy -------------------------------------------------------------------------------------------------------


def test_it_learns_what_the_reward_likes(toy_reviews: Reviews) -> None:
    one = learner(toy_reviews, prompts=16)
    before = one.evaluate(LIKES, np.random.default_rng(0)).metrics
    for number in range(2):
        metrics = one.improve(LIKES, NO_STORE, np.random.default_rng(number))
    after = one.evaluate(LIKES, np.random.default_rng(0)).metrics
    assert after["learned"] > before["learned"] + 0.3
    assert metrics["kl"] > 0
    assert metrics["updates"] == 8
    assert one.steps.learn > 0


def test_the_same_seed_gives_the_same_bytes_and_a_resumed_learner_goes_on_alike(toy_reviews: Reviews) -> None:
    settings = OnlineDPOSettings.model_validate(SMALL | {"updates": 2, "prompts": 6, "responses": 3})
    preferred.check_resumed(settings, toy_reviews, LIKES, NO_STORE)


def test_the_size_of_a_chunk_changes_a_step_by_rounding_only(toy_reviews: Reviews) -> None:
    settings = OnlineDPOSettings.model_validate(SMALL | {"updates": 1, "prompts": 20})
    found = preferred.with_chunks(settings, toy_reviews, LIKES, NO_STORE)
    for name in ("loss", "grad_norm", "margin", "kl"):
        assert found[0][name] == pytest.approx(found[1][name], rel=1e-3, abs=1e-4)


def test_the_formula_says_what_the_settings_say() -> None:
    assert "mean[ 1 log s(h) ]" in OnlineDPOSettings().formula()
    assert "of 4 responses" in OnlineDPOSettings(responses=4).formula()
    assert "R = score(y) - 1 [no end token];  32 prompts a batch" in OnlineDPOSettings().formula()
    assert "turned round" in OnlineDPOSettings(soft=True).formula()
