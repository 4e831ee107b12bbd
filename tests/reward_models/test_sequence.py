"""Rewards that look back: how far, over no episode's begin, never ahead, and the same whatever stands beside them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from prefrl.components import ConfigError, settings_class
from prefrl.envs.control import ControlSettings
from prefrl.fit.settings import FittingSettings
from prefrl.fit.trainer import fit_judged
from prefrl.judgements import Comparison, Judged
from prefrl.reward_models.sequence import GRU, PreferenceTransformerSettings
from prefrl.reward_models.steps import StepReward, windows
from prefrl.types import Floats, Query, Segment

KINDS: list[tuple[str, dict[str, Any]]] = [
    ("gru", {"width": 8}),
    ("preference_transformer", {"width": 8, "layers": 2}),
    ("preference_transformer", {"width": 8, "preference_attention": False}),
]
EACH = pytest.mark.parametrize(("kind", "options"), KINDS, ids=["gru", "transformer", "transformer-unweighted"])
MEMORY = 4


def _model(kind: str, options: dict[str, Any], memory: int | None = MEMORY, members: int = 3) -> StepReward:
    task = ControlSettings(env="Pendulum-v1", segment_steps=6).build()
    made: Any = settings_class("rewards", kind)
    model: StepReward = made(members=members, memory=memory, **options).build(task, np.random.default_rng(0))
    segments = _segments(12)
    model.settle(model.stack(segments), lambda scores: scores.sum(1))
    return model


def _steps(rows: int, steps: int, seed: int = 1) -> tuple[Floats, Floats]:
    rng = np.random.default_rng(seed)
    return rng.normal(size=(rows, steps, 3)).astype(np.float32), rng.normal(size=(rows, steps, 1)).astype(np.float32)


def _segments(count: int, steps: int = 6) -> list[Segment]:
    return [Segment(o, a, "e", i) for i, (o, a) in enumerate(zip(*_steps(count, steps), strict=True))]


@EACH
def test_each_reward_is_the_last_of_its_own_window_alone(kind: str, options: dict[str, Any]) -> None:
    model, (observations, actions) = _model(kind, options), _steps(2, 15)
    begins = np.zeros((2, 15), bool)
    begins[0, [3, 9, 10]] = True
    found = model.rewards(observations, actions, begins)
    for row in range(2):
        for t in range(15):
            start = max([0, t - MEMORY + 1, *(int(b) for b in np.flatnonzero(begins[row]) if b <= t)])
            part = (slice(row, row + 1), slice(start, t + 1))
            alone = model.rewards(observations[part], actions[part])[0, -1]
            np.testing.assert_allclose(found[row, t], alone, rtol=1e-4, atol=1e-5)


@EACH
@pytest.mark.parametrize("steps", [1, 3, 4, 6, 11])
def test_a_segment_s_score_is_the_sum_of_its_steps_rewards_and_what_is_fitted(
    kind: str, options: dict[str, Any], steps: int
) -> None:
    model, segments = _model(kind, options), _segments(3, steps)
    raw = model.scores(model.stack(segments)).detach().numpy()
    rewards = model.rewards(np.stack([s.observations for s in segments]), np.stack([s.actions for s in segments]))
    np.testing.assert_allclose(model.score(segments), rewards.sum(1), rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(model.raw_member_scores(segments), raw, rtol=1e-4, atol=1e-5)


@EACH
def test_a_later_step_and_one_before_the_memory_change_nothing_and_those_between_do(
    kind: str, options: dict[str, Any]
) -> None:
    model, (observations, actions) = _model(kind, options), _steps(1, 12)
    before = model.rewards(observations, actions)[0]
    for t in range(12):
        other = observations.copy()
        other[0, t] += 1.0
        changed = ~np.isclose(model.rewards(other, actions)[0], before, rtol=1e-5, atol=1e-6)
        assert changed.nonzero()[0].tolist() == list(range(t, min(t + MEMORY, 12)))


@EACH
def test_no_reward_sees_another_episode(kind: str, options: dict[str, Any]) -> None:
    model, (observations, actions) = _model(kind, options), _steps(1, 8)
    begins = np.zeros((1, 8), bool)
    begins[0, 5] = True
    other = observations.copy()
    other[0, :5] = 9.0
    apart = model.rewards(other, actions, begins)[0, 5:]
    np.testing.assert_array_equal(apart, model.rewards(observations, actions, begins)[0, 5:])
    assert not np.allclose(apart, model.rewards(other, actions)[0, 5:])


@EACH
def test_padding_whatever_is_in_it_changes_no_score(kind: str, options: dict[str, Any]) -> None:
    model, segments = _model(kind, options), [*_segments(3, 4), *_segments(2, 9)]
    stacked = dict(model.stack(segments))
    real = stacked["mask"][..., None] > 0
    filled = {**stacked, "inputs": torch.where(real, stacked["inputs"], torch.tensor(7.0))}
    torch.testing.assert_close(model.scores(stacked), model.scores(filled))
    np.testing.assert_allclose(
        model.raw_member_scores(segments), model.scores(stacked).detach().numpy(), rtol=1e-4, atol=1e-5
    )


@EACH
def test_members_in_one_pass_are_the_members_alone(kind: str, options: dict[str, Any]) -> None:
    three, one, segments = _model(kind, options), _model(kind, options, members=1), _segments(4)
    stacked = three.stack(segments)
    one.stack(segments)
    for e in range(3):
        state = one.state()
        for name, values in three.network.named().items():
            state[name] = values[e : e + 1].detach()
        one.load(state)
        torch.testing.assert_close(one.scores(stacked)[0], three.scores(stacked)[e])


@EACH
def test_a_later_fit_starts_from_the_same_function_though_its_normaliser_moves(
    kind: str, options: dict[str, Any]
) -> None:
    model, (observations, actions) = _model(kind, options), _steps(2, 7)
    before = model.rewards(observations, actions)
    model.stack([Segment(s.observations * 3 - 4, s.actions, "x", s.start) for s in _segments(5)])
    np.testing.assert_allclose(model.rewards(observations, actions), before, atol=1e-4)


@EACH
def test_the_memory_is_a_segment_long_unless_it_is_set(kind: str, options: dict[str, Any]) -> None:
    assert _model(kind, options, memory=None).memory == 6
    assert _model(kind, options, memory=2).memory == 2
    model, (observations, actions) = _model(kind, options, memory=1), _steps(1, 5)
    shuffled = [3, 0, 4, 1, 2]
    found = model.rewards(observations[:, shuffled], actions[:, shuffled])
    np.testing.assert_allclose(found, model.rewards(observations, actions)[:, shuffled], rtol=1e-4, atol=1e-5)


def test_the_recurrent_layer_is_torch_s() -> None:
    model, (observations, actions) = _model("gru", {"width": 8}, members=2), _steps(3, 4)
    assert isinstance(model.network, GRU)
    x, p = torch.from_numpy(np.concatenate([observations, actions], 2)), dict(model.network.named())
    for e in range(2):
        other = torch.nn.GRU(4, 8, batch_first=True)
        state = {
            "weight_ih_l0": p["input_weight"][e].T,
            "weight_hh_l0": p["state_weight"][e].T,
            "bias_ih_l0": p["input_bias"][e, 0],
            "bias_hh_l0": p["state_bias"][e, 0],
        }
        other.load_state_dict(state)
        expected = (other(x)[0] @ p["output_weight"][e] + p["output_bias"][e])[..., 0]
        torch.testing.assert_close(model.network.outputs(x)[e], expected)


def test_preference_attention_is_a_weighted_mean_of_what_the_steps_so_far_are_worth() -> None:
    weighted = _model("preference_transformer", {"width": 8}, members=1)
    plain = _model("preference_transformer", {"width": 8, "preference_attention": False}, members=1)
    state = {name: x for name, x in weighted.state().items() if not name.startswith("attend")}
    plain.load(state)
    x = torch.from_numpy(np.concatenate(_steps(5, 4), 2))
    worth, found = plain.network.outputs(x)[0], weighted.network.outputs(x)[0]
    torch.testing.assert_close(found[:, 0], worth[:, 0])
    assert (found <= worth.cummax(1).values + 1e-5).all()
    assert (found >= worth.cummin(1).values - 1e-5).all()
    assert not torch.allclose(found, worth, atol=1e-3)


@given(st.lists(st.integers(1, 9), min_size=1, max_size=6), st.integers(2, 5))
@settings(max_examples=60, deadline=None)
def test_every_step_is_new_in_one_window_with_all_it_may_see(lengths: list[int], memory: int) -> None:
    begins = np.zeros(sum(lengths), bool)
    begins[np.cumsum([0, *lengths[:-1]])] = True
    seen = {}
    for start, length, new in zip(*windows(begins, memory), strict=True):
        for t in range(start + length - new, start + length):
            assert t not in seen
            seen[t] = start
    heads = np.repeat(np.cumsum([0, *lengths[:-1]]), lengths)
    assert sorted(seen) == list(range(len(begins)))
    for t, start in seen.items():
        assert heads[t] <= start <= max(heads[t], t - memory + 1)
        assert t - start < memory


def _delayed(count: int) -> list[Judged[Segment]]:
    """The better one pushes in the direction in which the step before pointed."""
    segments = _segments(2 * count)
    worth = [float((np.sign(s.observations[:-1, 0]) * s.actions[1:, 0]).sum()) for s in segments]
    judged = []
    for i in range(0, 2 * count, 2):
        query = Query((segments[i], segments[i + 1]))
        first = query.candidates[0] is segments[i]
        judged.append(Judged(query, Comparison(query.id, float((worth[i] > worth[i + 1]) == first))))
    return judged


def test_what_hangs_on_the_step_before_is_learned_and_by_a_reward_of_one_step_it_is_not() -> None:
    accuracy = {}
    for memory in (1, 2):
        model = _model("gru", {}, memory=memory, members=1)
        fitting = FittingSettings(epochs=20, learning_rate=5e-3, held_out=0.25)
        fitted = fit_judged(model, _delayed(400), fitting, np.random.default_rng(0))
        accuracy[memory] = fitted.metrics["accuracy_held_out"]
    assert accuracy[2] > 0.72 > 0.65 > accuracy[1]


def test_heads_must_divide_the_width() -> None:
    task = ControlSettings(env="Pendulum-v1", segment_steps=6).build()
    with pytest.raises(ConfigError, match=r"multiple of reward\.heads, got 10 and 4"):
        PreferenceTransformerSettings(width=10, heads=4).build(task, np.random.default_rng(0))
