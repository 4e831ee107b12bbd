"""The linear reward against scipy's own optimiser, and the spread of its members against the posterior's."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from scipy.optimize import approx_fprime, minimize
from torch.nn.functional import softplus

from prefrl.components import ConfigError
from prefrl.envs.control import ControlSettings
from prefrl.reward_models.linear import Linear, LinearSettings
from prefrl.reward_models.steps import StepReward
from prefrl.types import Floats, Segment

PLANTED = np.array([1.0, -2.0, 0.5, 3.0])
STEPS = 5


def _segments(count: int, rng: np.random.Generator) -> list[Segment]:
    return [
        Segment(
            rng.normal(0.5, 2.0, (STEPS, 3)).astype(np.float32), rng.normal(size=(STEPS, 1)).astype(np.float32), "e", i
        )
        for i in range(count)
    ]


def _model(**settings: Any) -> StepReward:
    task = ControlSettings(env="Pendulum-v1", segment_steps=STEPS).build()
    return LinearSettings(**settings).build(task, np.random.default_rng(7))


def _means(segments: list[Segment]) -> Floats:
    means: Floats = np.stack([np.concatenate([s.observations, s.actions], 1).mean(0) for s in segments])
    return means.astype(np.float64)


def _fit(model: StepReward, count: int, temperature: float = 1.0) -> tuple[list[Segment], Floats]:
    """Bradley-Terry data of the planted weights; also returns each pair's answer, 1 where its first is better."""
    rng = np.random.default_rng(0)
    segments = _segments(2 * count, rng)
    values = _means(segments) @ PLANTED
    answers = (rng.random(count) < 1 / (1 + np.exp(values[1::2] - values[::2]))).astype(float)
    signs = torch.from_numpy(1 - 2 * answers)

    def loss(scores: torch.Tensor) -> torch.Tensor:
        return softplus(signs * (scores[:, ::2] - scores[:, 1::2])).sum(1)

    model.settle(model.stack(segments), loss)
    model.calibrate(temperature)
    return segments, answers


def _network(model: StepReward) -> Linear:
    assert isinstance(model.network, Linear)
    return model.network


def test_members_centre_on_the_maximum_that_scipy_finds_and_spread_as_the_curvature_there_says() -> None:
    model = _model(members=4000, prior_std=2.0)
    segments, answers = _fit(model, 150)
    steps = np.concatenate([np.concatenate([s.observations, s.actions], 1) for s in segments])
    design = _means(segments) / steps.std(0)
    difference = (1 - 2 * answers)[:, None] * (design[::2] - design[1::2])

    def negative(w: Floats) -> float:
        return float(np.logaddexp(0, difference @ w).sum() + 0.5 * (w**2).sum() / 4.0)

    def gradient(w: Any) -> Any:
        return difference.T @ (1 / (1 + np.exp(-difference @ w))) + w / 4.0

    expected = minimize(negative, np.zeros(4), method="BFGS", options={"gtol": 1e-8}).x
    covariance = np.linalg.inv(np.asarray(approx_fprime(expected, gradient, 1e-6)))
    weights = _network(model).named()["weight"][:, :, 0].double().numpy()
    np.testing.assert_allclose(weights.mean(0), expected, atol=1e-4)
    np.testing.assert_allclose(np.cov(weights.T, bias=True), covariance, rtol=0.1, atol=0.05 * covariance.max())


@pytest.mark.parametrize("members", [1, 2, 5, 8])
def test_the_members_mean_is_the_maximum_however_many_there_are(members: int) -> None:
    model, reference = _model(members=members), _model(members=1)
    _fit(model, 60)
    _fit(reference, 60)
    weights = _network(model).named()["weight"].numpy()
    np.testing.assert_allclose(weights.mean(0), _network(reference).named()["weight"].numpy()[0], rtol=1e-4, atol=1e-5)


def test_more_judgements_make_the_members_agree() -> None:
    spread = []
    for count in (20, 200, 2000):
        model = _model()
        _fit(model, count)
        spread.append(float(_network(model).named()["weight"].numpy().std(0).mean()))
    assert spread[0] > 2 * spread[1] > 4 * spread[2]


def test_a_planted_reward_is_recovered() -> None:
    model = _model()
    _fit(model, 2000)
    fresh = _segments(300, np.random.default_rng(5))
    assert np.corrcoef(model.score(fresh), _means(fresh) @ PLANTED)[0, 1] > 0.98


def test_a_square_is_recovered_by_quadratic_features_alone() -> None:
    rng = np.random.default_rng(3)
    segments = _segments(800, rng)
    values = torch.from_numpy(np.stack([(s.observations[:, 0] ** 2).mean() for s in segments]).astype(np.float64))
    signs = (values[1::2] - values[::2]).sign()

    def loss(scores: torch.Tensor) -> torch.Tensor:
        return softplus(signs * (scores[:, ::2] - scores[:, 1::2])).sum(1)

    found = {}
    for features in ("inputs", "quadratic"):
        model = _model(features=features)
        model.settle(model.stack(segments), loss)
        found[features] = np.corrcoef(model.score(segments), values.numpy())[0, 1]
    assert found["quadratic"] > 0.95 > 0.7 > found["inputs"]


def test_there_is_nothing_to_descend_and_a_refit_forgets_the_last_one() -> None:
    model, once = _model(), _model()
    assert list(model.parameters()) == []
    _fit(model, 30)
    _fit(model, 100)
    segments, _ = _fit(once, 100)
    np.testing.assert_allclose(model.score(segments), once.score(segments), rtol=1e-4, atol=1e-4)


def test_a_loss_that_is_not_convex_is_minimised_too() -> None:
    """With errors assumed at random, the likelihood of a clear mistake flattens out."""
    model, rng = _model(prior_std=50.0), np.random.default_rng(0)
    segments = _segments(400, rng)
    values = torch.from_numpy(_means(segments) @ PLANTED)
    signs = (values[::2] - values[1::2]).sign() * torch.where(torch.arange(200) % 4 == 0, -1.0, 1.0)

    def loss(scores: torch.Tensor) -> torch.Tensor:
        p = (signs * (scores[:, ::2] - scores[:, 1::2])).sigmoid()
        return -(0.5 * p + 0.25).log().sum(1)

    model.settle(model.stack(segments), loss)
    assert np.corrcoef(model.score(segments), values.numpy())[0, 1] > 0.97


def test_a_candidate_that_is_not_finite_is_an_error_that_says_so() -> None:
    model, segments = _model(), _segments(4, np.random.default_rng(0))
    segments[2].observations[0, 0] = np.inf
    with pytest.raises(ValueError, match="candidate 2 of the fit has features that are not finite"):
        model.settle(model.stack(segments), lambda scores: softplus(scores).sum(1))


def _bring(monkeypatch: pytest.MonkeyPatch, **functions: Any) -> None:
    """As if an installed package brought these features."""

    class Point:
        def __init__(self, function: Any) -> None:
            self.load = lambda: function

    points = {name: Point(function) for name, function in functions.items()}
    monkeypatch.setattr("prefrl.reward_models.steps.feature_functions", lambda: points)


def test_hand_made_features_take_the_place_of_the_inputs(monkeypatch: pytest.MonkeyPatch) -> None:
    """A reward of a distance and of a product is linear in these two, and not in the inputs."""

    def made(observations: Floats, actions: Floats) -> Floats:
        return np.stack([np.abs(observations[:, 0]), observations[:, 1] * actions[:, 0]], 1)

    _bring(monkeypatch, made=made)
    model, plain = _model(features="made"), _model()
    rng = np.random.default_rng(0)
    segments, fresh = _segments(400, rng), _segments(200, rng)

    def gold(some: list[Segment]) -> Floats:
        return np.array([(made(s.observations, s.actions) @ [-2.0, 1.0]).mean() for s in some])

    values = gold(segments)
    signs = torch.from_numpy(np.sign(values[::2] - values[1::2]))
    for one in (model, plain):
        one.settle(one.stack(segments), lambda s: softplus(-signs * (s[:, ::2] - s[:, 1::2])).sum(1))
    assert np.corrcoef(model.score(fresh), gold(fresh))[0, 1] > 0.99
    assert abs(np.corrcoef(plain.score(fresh), gold(fresh))[0, 1]) < 0.5
    rewards = model.rewards(fresh[0].observations[None], fresh[0].actions[None])
    np.testing.assert_allclose(rewards.sum(), model.score(fresh[:1])[0], rtol=1e-4)
    assert _network(model).named()["weight"].shape == (8, 2, 1)


def test_of_observations_alone_it_sees_no_action() -> None:
    model = _model(features="observations")
    segments, _ = _fit(model, 100)
    others = [replace(one, actions=one.actions + 1.0) for one in segments]
    np.testing.assert_array_equal(model.score(segments), model.score(others))
    assert np.corrcoef(model.score(segments), _means(segments)[:, :3] @ PLANTED[:3])[0, 1] > 0.9
    assert _network(model).named()["weight"].shape == (8, 3, 1)


def test_features_that_are_not_there_or_not_of_steps_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(ConfigError, match=r"unknown reward\.features 'quadratc'; did you mean 'quadratic'"):
        _model(features="quadratc")
    _bring(monkeypatch, flat=lambda o, a: o[:, 0], odd=lambda o, a: o[: len(o) // 2 + 1])
    with pytest.raises(ConfigError, match=r"expected \(S, d\) real numbers .* got float32 of shape \(1,\)"):
        _model(features="flat")
    model = _model(features="odd")
    with pytest.raises(ValueError, match=r"features of 10 steps must be of shape \(10, 3\), got \(6, 3\)"):
        model.stack(_segments(2, np.random.default_rng(0)))
