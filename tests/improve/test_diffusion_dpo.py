from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from small_pictures import likes_ink, policy_of, small_digits

from prefrl.envs.digits import Digits
from prefrl.improve.diffusion_dpo import DiffusionDPO, DiffusionDPOSettings
from prefrl.judgements import Comparison
from prefrl.store import Store
from prefrl.types import Picture, Query, Steps


@pytest.fixture(scope="module")
def task() -> Digits:
    return small_digits("thicker", "a three")


def learner(task: Digits, **changes: Any) -> DiffusionDPO:
    small = {"epochs": 30, "minibatch": 16, "learning_rate": 1e-3, "evaluation_pictures": 64}
    return DiffusionDPOSettings.model_validate({**small, **changes}).build(task, np.random.default_rng(0))


@pytest.fixture
def store(task: Digits, tmp_path: Path) -> Iterator[Store[Picture]]:
    """Pairs in which the thicker one is better, whatever the caption."""
    found = learner(task).sample(128, np.random.default_rng(0))
    queries = [Query((found[i], found[i + 2])) for i in range(0, 126, 4) for i in (i, i + 1)]
    with Store[Picture](tmp_path) as opened:
        opened.ask(queries)
        better = [query.candidates[0].pixels.mean() > query.candidates[1].pixels.mean() for query in queries]
        opened.answer([Comparison(q.id, float(b), "ann") for q, b in zip(queries, better, strict=True)])
        yield opened


def ink(one: DiffusionDPO) -> float:
    return one.evaluate(likes_ink(), np.random.default_rng(5)).metrics["learned"]


def test_it_learns_what_is_preferred_without_a_reward(task: Digits, store: Store[Picture]) -> None:
    one = learner(task)
    before = ink(one)
    metrics = one.improve(likes_ink(), store, np.random.default_rng(0))
    assert ink(one) > before + 0.2
    assert metrics["pairs"] == 64
    assert metrics["accuracy"] > 0.6
    assert metrics["margin"] > 0
    assert one.steps == Steps(evaluate=128)


def test_a_larger_beta_stays_nearer(task: Digits, store: Store[Picture]) -> None:
    far, near = learner(task, beta=0.02), learner(task, beta=5.0)
    for one in (far, near):
        one.improve(likes_ink(), store, np.random.default_rng(0))
    kls = [one.evaluate(likes_ink(), np.random.default_rng(0)).metrics["kl"] for one in (far, near)]
    assert kls[1] < 0.5 * kls[0]


def test_parts_change_nothing_but_rounding_and_a_resumed_one_goes_on_alike(task: Digits, store: Store[Picture]) -> None:
    whole, parts, resumed = (
        learner(task, epochs=2),
        learner(task, epochs=2, policy={"chunk": 8}),
        learner(task, epochs=2),
    )
    for seed in (1, 2):
        for one in (whole, parts):
            one.improve(likes_ink(), store, np.random.default_rng(seed))
        if seed == 1:
            resumed.load(whole.state())
    resumed.improve(likes_ink(), store, np.random.default_rng(2))
    for a, b, c in zip(*(one.policy.parameters() for one in (whole, parts, resumed)), strict=True):
        torch.testing.assert_close(a, b, atol=1e-4, rtol=1e-3)
        assert torch.equal(a, c)


@torch.no_grad()
def test_the_gain_is_in_expectation_the_bound_on_the_log_ratio_of_chains() -> None:
    """A step's own Gaussian against the policy's and the start's: the difference of two KLs, times the steps."""
    policy = policy_of(small_digits("a three"))
    policy.model.leave.bias.add_(0.1)
    pixels, levels = torch.zeros(3, 64), torch.tensor([2, 3, 4])
    noise, which = torch.randn(3, 64, generator=torch.Generator().manual_seed(0)), torch.zeros(3, dtype=torch.int64)
    found = policy.gains(pixels, which, levels, noise)
    bar = policy.model.signal.double()
    for i, level in enumerate(levels.tolist()):
        noisy = bar[level].sqrt() * pixels[i] + (1 - bar[level]).sqrt() * noise[i]
        alpha = bar[level] / bar[level - 1]
        scale = bar[level - 1].sqrt() * (1 - alpha) / (1 - bar[level])
        variance = (1 - bar[level - 1]) / (1 - bar[level]) * (1 - alpha)
        one = noisy.float()[None], levels[i : i + 1], which[:1]
        ours, start = (
            (scale * m.clean(*one)[0].double()).square().sum() / (2 * variance) for m in (policy.model, policy.start)
        )
        assert float(found[i]) == pytest.approx(3 * float(start - ours), rel=1e-3)


def test_what_it_cannot_learn_from_is_told(task: Digits, tmp_path: Path) -> None:
    with Store[Picture](tmp_path) as empty, pytest.raises(ValueError, match="diffusion_dpo learns from judged pairs"):
        learner(task).improve(likes_ink(), empty, np.random.default_rng(0))
    said = cast(Any, DiffusionDPOSettings(label_smoothing=0.1)).formula()
    assert "0.9 log s(h) + 0.1 log s(-h)" in said
