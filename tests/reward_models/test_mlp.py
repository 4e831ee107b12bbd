"""The ensemble of MLPs: what it scores, what it normalises, and what it must not see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from prefrl.components import ConfigError
from prefrl.envs.control import ControlSettings, GymnasiumTask
from prefrl.protocols import StepRewardModel
from prefrl.reward_models.mlp import MLP, MLPSettings
from prefrl.reward_models.steps import StepReward
from prefrl.types import Segment


def _task() -> GymnasiumTask:
    return ControlSettings(env="Pendulum-v1", segment_steps=10).build()


def _model(members: int = 3, seed: int = 0) -> StepReward:
    return MLPSettings(members=members, hidden=(8, 8)).build(_task(), np.random.default_rng(seed))


def _settle(model: StepReward, segments: list[Segment], temperature: float = 1.0) -> None:
    model.settle(model.stack(segments), lambda scores: scores.sum(1))
    model.calibrate(temperature)


def _segments(count: int, lengths: tuple[int, ...] = (10,), seed: int = 1) -> list[Segment]:
    rng = np.random.default_rng(seed)
    scale = np.array([1.0, 1.0, 5.0])
    return [
        Segment(
            (rng.normal(size=(t, 3)) * scale + 2).astype(np.float32), rng.normal(size=(t, 1)).astype(np.float32), "e", i
        )
        for i, t in enumerate(lengths[k % len(lengths)] for k in range(count))
    ]


def test_a_score_is_the_sum_of_the_rewards_of_its_steps() -> None:
    model, segments = _model(), _segments(5, (10, 4))
    _settle(model, segments)
    sums = [model.rewards(s.observations[None], s.actions[None]).sum() for s in segments]
    np.testing.assert_allclose(model.score(segments), sums, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(model.score(segments), model.member_scores(segments).mean(0), rtol=1e-6)


def test_raw_scores_are_the_fitted_logits_and_asking_for_them_changes_nothing() -> None:
    model, segments = _model(), _segments(8, (10, 4))
    stacked = model.stack(segments)
    fitted = model.scores(stacked).detach().numpy()
    model.settle(stacked, lambda scores: scores.sum(1))
    before = {name: torch.as_tensor(value).clone() for name, value in model.state().items()}
    raw = model.raw_member_scores(segments)
    model.raw_member_scores(_segments(3, seed=9))
    np.testing.assert_allclose(raw, fitted, rtol=1e-5, atol=1e-5)
    assert abs(raw - model.member_scores(segments)).max() > 1.0
    assert all(torch.equal(before[name], torch.as_tensor(value)) for name, value in model.state().items())


def test_padding_changes_nothing() -> None:
    model, segments = _model(), _segments(4, (10, 3))
    stacked = model.stack(segments)
    filled = {**stacked, "inputs": torch.where(stacked["mask"][..., None] > 0, stacked["inputs"], 7.0)}
    assert torch.equal(model.scores(stacked), model.scores(filled))


def test_members_evaluated_together_are_the_members_evaluated_alone() -> None:
    model, segments = _model(), _segments(4)
    stacked = model.stack(segments)
    x = stacked["inputs"]
    network = model.network
    assert isinstance(network, MLP)
    for e in range(3):
        h = x
        for w, b in zip(network.weights[:-1], network.biases[:-1], strict=True):
            h = torch.tanh(h @ w[e] + b[e])
        alone = (h @ network.weights[-1][e] + network.biases[-1][e])[..., 0].mean(1) * 10.0
        torch.testing.assert_close(model.scores(stacked)[e], alone)


def test_members_start_different() -> None:
    segments = _segments(6)
    scores = _model().member_scores(segments)
    assert not np.allclose(scores[0], scores[1])


def test_settling_gives_each_member_rewards_of_mean_0_and_std_1() -> None:
    model, segments = _model(), _segments(20, (10, 6))
    _settle(model, segments)
    steps = [Segment(s.observations[t : t + 1], s.actions[t : t + 1], "e", t) for s in segments for t in range(len(s))]
    rewards = model.member_scores(steps)
    np.testing.assert_allclose(rewards.mean(1), 0, atol=1e-5)
    np.testing.assert_allclose(rewards.std(1), 1, atol=1e-4)


def test_logits_do_not_depend_on_the_usual_length_of_segments() -> None:
    short = ControlSettings(env="Pendulum-v1", segment_steps=10).build()
    long = ControlSettings(env="Pendulum-v1", segment_steps=40).build()
    (one,) = _segments(1)
    four = replace(one, observations=np.tile(one.observations, (4, 1)), actions=np.tile(one.actions, (4, 1)))
    scores = []
    for task, segment in ((short, one), (long, four)):
        model = MLPSettings().build(task, np.random.default_rng(0))
        scores.append(model.scores(model.stack([segment])).detach())
    torch.testing.assert_close(scores[0], scores[1])


def test_a_later_fit_starts_from_the_same_function_though_its_normaliser_moves() -> None:
    model, segments = _model(), _segments(8)
    _settle(model, segments)
    before = model.rewards(segments[0].observations[None], segments[0].actions[None])
    mean = model._input_mean
    model.stack([replace(s, observations=s.observations * 3 - 4) for s in segments])
    assert not torch.allclose(mean, model._input_mean)
    after = model.rewards(segments[0].observations[None], segments[0].actions[None])
    np.testing.assert_allclose(before, after, atol=1e-4)


def test_it_never_sees_gold_states_or_time() -> None:
    plain = _segments(6)
    other = [
        replace(s, gold=np.full(len(s), np.nan), states=np.full((len(s), 2), np.nan), start=99, episode="x")
        for s in plain
    ]
    assert _model().member_scores(plain).tobytes() == _model().member_scores(other).tobytes()
    models = [_model(), _model()]
    for model, segments in zip(models, (plain, other), strict=True):
        _settle(model, segments)
    assert models[0].score(plain).tobytes() == models[1].score(plain).tobytes()


def test_same_seed_gives_equal_bytes_and_another_does_not() -> None:
    segments = _segments(3)
    assert _model().member_scores(segments).tobytes() == _model().member_scores(segments).tobytes()
    assert _model().member_scores(segments).tobytes() != _model(seed=1).member_scores(segments).tobytes()


def test_state_and_load_give_the_same_model() -> None:
    model, segments = _model(), _segments(6)
    _settle(model, segments)
    other = _model(seed=5)
    before = other.fitted
    other.load(model.state())
    assert (before, other.fitted) == (False, True)
    assert other.score(segments).tobytes() == model.score(segments).tobytes()


def test_a_state_does_not_change_with_the_model() -> None:
    model, segments = _model(), _segments(6)
    state = model.state()
    model.stack(segments)
    with torch.no_grad():
        for p in model.parameters():
            p.add_(1)
    fresh = _model()
    fresh.load(state)
    assert fresh.score(segments).tobytes() == _model().score(segments).tobytes()


def test_other_shapes_are_refused_by_name() -> None:
    state = MLPSettings(hidden=(4,)).build(_task(), np.random.default_rng(0)).state()
    with pytest.raises(ValueError, match="weight_0 has shape"):
        MLPSettings(hidden=(8,)).build(_task(), np.random.default_rng(0)).load(state)


def test_raw_scores_are_divided_by_the_temperature_and_what_learners_get_is_not() -> None:
    segments, cool, hot = _segments(8), _model(), _model()
    _settle(cool, segments)
    _settle(hot, segments, 4.0)
    np.testing.assert_allclose(hot.raw_member_scores(segments) * 4.0, cool.raw_member_scores(segments), rtol=1e-5)
    np.testing.assert_array_equal(hot.score(segments), cool.score(segments))
    again = _model(seed=3)
    again.load(hot.state())
    np.testing.assert_array_equal(again.raw_member_scores(segments), hot.raw_member_scores(segments))


def test_a_step_that_is_not_finite_spoils_its_own_segment_only() -> None:
    model, segments = _model(), _segments(4)
    segments[2].observations[5, 1] = np.nan
    scores = model.scores(model.stack(segments)).detach()
    assert scores.isfinite().all(0).tolist() == [True, True, False, True]


def test_it_is_a_step_reward_model_and_wants_a_control_task() -> None:
    assert isinstance(_model(), StepRewardModel)

    class Text:
        name, kind = "reviews", "text"

    with pytest.raises(ConfigError, match="'text'"):
        MLPSettings().build(Text(), np.random.default_rng(0))
