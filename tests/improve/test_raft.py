"""RAFT: towards the exact best-of-K distribution of a model that can be enumerated, and what it learns on a toy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, cast

import numpy as np
import pytest
import torch
from test_fixed_points import ALL, NO_STORE, WORTH, Worth, logp, share
from test_fixed_points import solved as solved  # a fixture
from torch import Tensor

from prefrl.envs.text import Reviews
from prefrl.evaluate.best_of_n import masses_of_best
from prefrl.improve import raft
from prefrl.improve.direct import Direct
from prefrl.improve.raft import RAFTSettings
from prefrl.protocols import RewardModel, TextTask
from prefrl.types import Floats, Response

K = 4
SMALL: dict[str, Any] = {"updates": 3, "evaluation_prompts": 64, "learning_rate": 2e-3, "policy": {"chunk": 6}}


class Likes:
    """Scores a response by how often it says "the"; as many of the first as it is told it does not score."""

    def __init__(self, silent: int = 0) -> None:
        self.silent = silent

    def score(self, candidates: Sequence[Response]) -> Floats:
        found = np.array([r.text.split().count("the") for r in candidates], np.float32)
        found[: self.silent] = np.nan
        return found


def likes(silent: int = 0) -> RewardModel[Response]:
    return cast("RewardModel[Response]", Likes(silent))


def learner(task: TextTask, **changes: object) -> Direct:
    return RAFTSettings.model_validate({**SMALL, **changes}).build(task, np.random.default_rng(0))


def improve(one: Direct, seed: int = 1, silent: int = 0) -> dict[str, float]:
    return one.improve(likes(silent), NO_STORE, np.random.default_rng(seed))


def flat(one: Direct) -> Tensor:
    return torch.cat([p.flatten() for p in one.state()["model"].values()])


def best_of_k(start: Tensor) -> Tensor:
    """(156,) how probable each response is as the best of K, which are worth 0 or 1 each."""
    mass = torch.stack([(start.exp() * (worth == WORTH)).sum() for worth in (0, 1)]).double()
    tilt = torch.from_numpy(masses_of_best(mass.numpy(), K)) / mass
    return start.exp() * tilt[WORTH.long()]


def test_a_step_goes_down_the_kl_from_best_of_k_to_the_policy(solved: Any) -> None:
    task, _ = solved
    start = logp(task.start).detach()
    target = best_of_k(start)
    assert float(target.sum()) == pytest.approx(1, abs=1e-5)
    sizes = {"updates": 1, "prompts": 4096, "responses": K, "minibatch": 4096, "policy": {"chunk": 4096}}
    one = learner(task, **sizes, missing_end_penalty=0.0, max_grad_norm=1e9, learning_rate=1e-3)
    metrics = one.improve(cast("RewardModel[Response]", Worth()), NO_STORE, np.random.default_rng(0))
    made = torch.cat([p.grad.flatten() for p in one.policy.parameters() if p.grad is not None])
    # The mean of -log pi over tokens: the sequences' cross-entropy, over their mean length.
    length = float(target @ ALL.mask.sum(1).double())
    exact = torch.autograd.grad(-(target.float() @ logp(task.start)) / length, list(task.start.parameters()))
    wanted = torch.cat([g.flatten() for g in exact])
    assert float(torch.cosine_similarity(made, wanted, 0)) > 0.98
    assert float(made.norm()) == pytest.approx(float(wanted.norm()), rel=0.05)
    assert metrics["loss"] == pytest.approx(float(-(target.float() @ start)) / length, rel=0.03)
    with torch.no_grad():
        after = logp(one.policy.model)
    assert float(target.float() @ (start - after)) < 0  # KL(best of K || pi) has fallen
    assert share(after) > share(start)
    assert metrics["reward"] == pytest.approx(share(start), abs=0.02)
    assert metrics["reward_best"] == pytest.approx(float(target.float() @ WORTH), abs=0.03)


def test_it_learns_what_scores_highest(toy_reviews: Reviews) -> None:
    one = learner(toy_reviews)
    before = one.evaluate(likes(), np.random.default_rng(0)).metrics
    found = [improve(one, seed) for seed in range(2)]
    after = one.evaluate(likes(), np.random.default_rng(0)).metrics
    assert after["learned"] > before["learned"] + 0.5
    assert found[-1]["reward"] > found[0]["reward"]
    assert found[-1]["kl"] > found[0]["kl"]
    assert all(m["reward_best"] > m["reward"] + 0.3 for m in found)
    assert one.steps.learn > 0


def test_the_same_seed_gives_the_same_bytes_and_a_resumed_learner_goes_on_alike(toy_reviews: Reviews) -> None:
    whole, first, second = (learner(toy_reviews, updates=1) for _ in range(3))
    for seed in (1, 2):
        improve(whole, seed)
    improve(first, 1)
    second.load(first.state())
    improve(second, 2)
    assert torch.equal(flat(whole), flat(second))
    assert not torch.equal(flat(whole), flat(first))


def test_the_size_of_a_chunk_changes_a_step_by_rounding_only(toy_reviews: Reviews) -> None:
    found = [improve(learner(toy_reviews, policy={"chunk": chunk}, updates=1)) for chunk in (3, 1000)]
    assert found[0] == pytest.approx(found[1], rel=1e-4, abs=1e-4)
    assert abs(found[0]["kl"]) < 1e-3  # what is measured is the policy that wrote, before its step


def test_every_pass_takes_every_best_response_once(toy_reviews: Reviews) -> None:
    sizes = {"updates": 2, "prompts": 5, "responses": 2, "epochs": 3, "learning_rate": 1e-9}
    one, whole = learner(toy_reviews, **sizes, minibatch=2), learner(toy_reviews, **sizes, minibatch=5)
    # A mean over a minibatch's own tokens, however many there are.
    assert improve(one)["loss"] == pytest.approx(improve(whole)["loss"], rel=0.2)
    assert {int(held["step"]) for held in one.state()["optimizer"]["state"].values()} == {2 * 3 * 3}  # 2, 2 and 1


def test_what_was_not_scored_is_never_learned(toy_reviews: Reviews) -> None:
    one, other = (learner(toy_reviews, updates=1, prompts=2, responses=4) for _ in range(2))
    before = flat(one)
    metrics = improve(one, silent=8)
    assert torch.equal(flat(one), before)
    assert metrics["unscored"] == 1
    assert "loss" not in metrics
    assert np.isnan(metrics["reward"])
    improve(other, silent=4)  # the first prompt's alone
    assert not torch.equal(flat(other), before)


class Same:
    """Has the same score for everything, or none for every other response."""

    def __init__(self, every_other: bool = False) -> None:
        self.every_other = every_other

    def score(self, candidates: Sequence[Response]) -> Floats:
        found = np.zeros(len(candidates), np.float32)
        if self.every_other:
            found[::2] = np.nan
        return found


def test_what_is_taken_off_a_score_decides_between_equals(toy_reviews: Reviews) -> None:
    one = learner(toy_reviews, responses=4)
    improve(one)  # so that there is a distance to the start
    drawn = one.policy.respond(toy_reviews.prompts(16, np.random.default_rng(0)), 4, np.random.default_rng(0))
    kl = (drawn.logp - one.policy.start_logp(drawn)).sum(1).view(-1, 4)
    ended = drawn.ended.view(-1, 4)
    assert 0 < int(ended.sum()) < 64

    def kept(reward: Same, **changes: float) -> Tensor:
        settings = RAFTSettings.model_validate({"responses": 4, "missing_end_penalty": 0.0} | changes)
        return raft._choose(settings, one.policy, drawn, cast("RewardModel[Response]", reward))[0]

    firsts = torch.arange(16) * 4
    assert torch.equal(kept(Same()), firsts)
    assert torch.equal(kept(Same(every_other=True)), firsts + 1)
    assert torch.equal(kept(Same(), beta=0.5), firsts + kl.argmin(1))
    assert torch.equal(kept(Same(), missing_end_penalty=0.5), firsts + torch.from_numpy(ended.numpy().argmax(1)))


def test_the_formula_says_what_the_settings_say() -> None:
    assert RAFTSettings().formula().endswith("the best of 8 responses y to a prompt by score(y) - 1 [no end token]")
    assert "score(y) - 0 [no end token] - 0.5 [log pi(y)" in RAFTSettings(missing_end_penalty=0, beta=0.5).formula()
