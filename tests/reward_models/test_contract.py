"""What every reward model for control keeps, whatever its kind: the Protocol of `prefrl.protocols.StepRewardModel`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.nn.functional import softplus

from prefrl.components import TABLE, ConfigError, settings_class
from prefrl.protocols import StepRewardModel
from prefrl.storage.checkpoints import load_state, save_state
from prefrl.types import Segment

SETTINGS: dict[str, dict[str, Any]] = {
    "mlp": {"hidden": (8,)},
    "cnn": {"image": (2, 3, 1), "channels": (4,), "hidden": (8,)},
    "gru": {"width": 8},
    "preference_transformer": {"width": 8},
    "linear": {"features": "quadratic"},
}
EACH = pytest.mark.parametrize("kind", SETTINGS)


class Task:
    """Enough of a control task to build a reward model for."""

    name, kind, observation_size, action_size, segment_steps, action_bounds = "planted", "control", 6, 2, 5, None


def _model(kind: str, seed: int = 0, members: int = 3, **options: Any) -> Any:
    settings: Any = settings_class("rewards", kind)
    return settings.model_validate({"kind": kind, "members": members, **SETTINGS[kind], **options}).build(
        Task(), np.random.default_rng(seed)
    )


def _segments(count: int, lengths: Sequence[int] = (5, 3, 8), seed: int = 1) -> list[Segment]:
    rng = np.random.default_rng(seed)
    sizes = [lengths[i % len(lengths)] for i in range(count)]
    return [
        Segment(rng.normal(size=(t, 6)).astype(np.float32), rng.normal(size=(t, 2)).astype(np.float32), "e", i)
        for i, t in enumerate(sizes)
    ]


def _loss(scores: torch.Tensor) -> torch.Tensor:
    return softplus(scores[:, 1::2] - scores[:, ::2]).sum(1)


def _settled(kind: str, seed: int = 0, **options: Any) -> Any:
    model, segments = _model(kind, seed, **options), _segments(12)
    model.settle(model.stack(segments), _loss)
    model.calibrate(2.0)
    return model


def _everything(model: Any, segments: list[Segment]) -> list[bytes]:
    found = [model.raw_member_scores(segments), model.member_scores(segments), model.score(segments)]
    rewards = [model.rewards(s.observations[None], s.actions[None]) for s in segments]
    return [x.tobytes() for x in [*found, model.features(segments), *rewards]]


def test_every_registered_kind_for_control_is_tested_here() -> None:
    modules = (".reward_models.text:", ".reward_models.functions:", ".reward_models.pictures:")
    others = {kind for kind, path in TABLE["rewards"].items() if any(module in path for module in modules)}
    assert set(SETTINGS) == set(TABLE["rewards"]) - others


@EACH
def test_shapes_are_as_the_protocol_says(kind: str) -> None:
    model, segments = _settled(kind), _segments(7)
    assert isinstance(model, StepRewardModel)
    stacked = model.stack(segments)
    assert all(len(x) == 7 for x in stacked.values())
    assert (model.members, model.memory) == (3, 1 if kind in ("mlp", "cnn", "linear") else 5)
    assert model.scores(stacked).shape == (3, 7)
    assert model.raw_member_scores(segments).shape == model.member_scores(segments).shape == (3, 7)
    assert model.score(segments).shape == (7,)
    assert model.features(segments).shape == (7, 16)
    rng = np.random.default_rng(0)
    assert model.rewards(rng.normal(size=(4, 9, 6)), rng.normal(size=(4, 9, 2))).shape == (4, 9)


@EACH
def test_of_observations_alone_no_action_is_seen(kind: str) -> None:
    model, segments = _settled(kind, features="observations"), _segments(4)
    others = [replace(one, actions=one.actions + 1) for one in segments]
    assert _everything(model, segments) == _everything(model, others)
    assert _everything(model, segments) != _everything(
        model, [replace(one, observations=one.observations + 1) for one in segments]
    )


@EACH
def test_same_seed_same_bytes_and_another_seed_others(kind: str) -> None:
    segments = _segments(4)
    assert _everything(_settled(kind), segments) == _everything(_settled(kind), segments)
    assert _everything(_settled(kind), segments) != _everything(_settled(kind, seed=1), segments)


@EACH
def test_a_state_that_went_through_a_checkpoint_gives_the_same_bytes(kind: str, tmp_path: Path) -> None:
    model, other, segments = _settled(kind, combine={"optimism": 0.5}), _model(kind, 9), _segments(4)
    model.settle(model.stack(segments), _loss)
    save_state(tmp_path, "reward", model.state())
    other = _model(kind, 9, combine={"optimism": 0.5})
    other.load(load_state(tmp_path, "reward"))
    assert other.fitted
    assert _everything(model, segments) == _everything(other, segments)
    for one in (model, other):  # and what is done next is the same
        one.settle(one.stack(segments), _loss)
    assert _everything(model, segments) == _everything(other, segments)


@EACH
def test_a_state_does_not_change_with_the_model(kind: str) -> None:
    model, fresh, segments = _settled(kind), _model(kind), _segments(4)
    state, before = model.state(), _everything(model, segments)
    model.settle(model.stack(_segments(6, seed=8)), _loss)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(1.0)
    fresh.load(state)
    assert _everything(fresh, segments) == before


@EACH
def test_a_state_of_other_settings_is_refused_by_name_and_nothing_is_loaded(kind: str) -> None:
    model, other, segments = _settled(kind), _settled(kind, members=2), _segments(3)
    before = _everything(model, segments)
    with pytest.raises(ValueError, match=r"has shape .* expected .*: other settings"):
        model.load(other.state())
    with pytest.raises(ValueError, match="shift has shape no shape, it is missing"):
        model.load({name: x for name, x in model.state().items() if name != "shift"})
    assert _everything(model, segments) == before


@EACH
def test_a_score_does_not_hang_on_what_else_is_in_the_batch_or_on_padding(kind: str) -> None:
    model, segments = _settled(kind), _segments(7)
    together, raw = model.member_scores(segments), model.raw_member_scores(segments)
    alone = np.concatenate([model.member_scores([s]) for s in segments], 1)
    np.testing.assert_allclose(together, alone, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(together, model.member_scores(segments[::-1])[:, ::-1], rtol=1e-4, atol=1e-5)
    stacked = dict(model.stack(segments))
    stacked = {name: torch.cat([x, x.new_full((7, 4, *x.shape[2:]), 3.0)], 1) for name, x in stacked.items()}
    stacked["mask"][:, -4:] = 0.0
    np.testing.assert_allclose(model.scores(stacked).detach().numpy() / 2.0, raw, rtol=1e-3, atol=1e-4)
    features = model.features(segments)
    np.testing.assert_allclose(features, np.concatenate([model.features([s]) for s in segments]), rtol=1e-4, atol=1e-5)


@EACH
@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_what_a_member_does_not_use_changes_nothing_that_it_does(kind: str, share: float) -> None:
    model = _settled(kind)
    stacked = model.stack(_segments(9, lengths=(5, 3)))
    used = torch.rand(9, 3, generator=torch.Generator().manual_seed(0)) < share
    every, some = model.scores(stacked), model.scores({**stacked, "used": used})
    assert some.shape == (3, 9)
    assert some.isfinite().all()
    torch.testing.assert_close(some[used.T], every[used.T], rtol=1e-4, atol=1e-5)


@EACH
@pytest.mark.parametrize("combine", [{}, {"by": "lower", "caution": 0.5}, {"by": "worst", "optimism": 0.3}])
@pytest.mark.parametrize("members", [1, 3])
def test_a_score_is_the_sum_of_the_rewards_of_its_steps(kind: str, members: int, combine: dict[str, Any]) -> None:
    model, segments = _settled(kind, members=members, combine=combine), _segments(6)
    sums = [model.rewards(s.observations[None], s.actions[None]).sum() for s in segments]
    np.testing.assert_allclose(model.score(segments), sums, rtol=1e-4, atol=1e-4)
    if members == 1 or not combine:
        np.testing.assert_allclose(model.score(segments), model.member_scores(segments).mean(0), rtol=1e-4, atol=1e-4)


@EACH
def test_rows_that_hold_several_episodes_are_scored_as_if_each_were_alone(kind: str) -> None:
    model, segments = _settled(kind), _segments(3)
    observations, actions = (np.concatenate([getattr(s, n) for s in segments]) for n in ("observations", "actions"))
    begins = np.zeros((1, len(observations)), bool)
    begins[0, [0, 5, 8]] = True
    alone = [model.rewards(s.observations[None], s.actions[None])[0] for s in segments]
    found = model.rewards(observations[None], actions[None], begins)[0]
    np.testing.assert_allclose(found, np.concatenate(alone), rtol=1e-4, atol=1e-5)
    assert begins.sum() == 3  # what was passed is left as it was


@EACH
def test_settling_gives_each_member_mean_0_and_spread_1_over_the_steps_it_was_fitted_on(kind: str) -> None:
    segments = _segments(12)
    for e in range(3):
        model = _settled(kind)
        state, at = model.state(), f"member {e}"
        alone = _model(kind, members=1)
        narrow = {}
        for name, own in alone.state().items():
            wide = state[name]
            cut = isinstance(wide, torch.Tensor) and wide.shape != own.shape
            size = len(own) if cut else 0
            narrow[name] = wide[e * size : (e + 1) * size] if cut else wide
        alone.load(narrow)
        rewards = np.concatenate([alone.rewards(s.observations[None], s.actions[None])[0] for s in segments])
        assert rewards.mean() == pytest.approx(0.0, abs=1e-3), at
        assert rewards.std() == pytest.approx(1.0, abs=1e-3), at


@EACH
def test_gold_states_time_and_episode_are_never_read(kind: str) -> None:
    plain = _segments(6)
    other = [
        replace(s, gold=np.full(len(s), np.nan), states=np.full((len(s), 2), np.nan), start=99, episode="x")
        for s in plain
    ]
    found = []
    for segments in (plain, other):
        model = _model(kind)
        model.settle(model.stack(segments), _loss)
        found.append(_everything(model, segments))
    assert found[0] == found[1]


@EACH
def test_asking_changes_nothing(kind: str) -> None:
    model, segments = _settled(kind), _segments(5)
    state = model.state()
    before = {name: torch.as_tensor(value).clone() for name, value in state.items()}
    _everything(model, segments)
    assert all(torch.equal(before[name], torch.as_tensor(value)) for name, value in model.state().items())


@EACH
def test_gradients_reach_every_parameter(kind: str) -> None:
    model = _model(kind)
    if not list(model.parameters()):
        assert kind == "linear"
        return
    model.scores(model.stack(_segments(6)))[:, ::2].square().sum().backward()
    assert all(p.grad is not None and p.grad.abs().sum() > 0 for p in model.parameters())


@EACH
@pytest.mark.parametrize("sizes", [(5, 2), (6, 3)])
def test_a_segment_of_another_task_is_refused_with_both_sizes(kind: str, sizes: tuple[int, int]) -> None:
    model = _settled(kind)
    wrong = Segment(np.zeros((5, sizes[0]), np.float32), np.zeros((5, sizes[1]), np.float32), "e", 0)
    expected = rf"observations \(\.\.\., 6\) and actions \(\.\.\., 2\).* got \(5, {sizes[0]}\) and \(5, {sizes[1]}\)"
    for ask in (model.stack, model.score, model.raw_member_scores, model.features):
        with pytest.raises(ValueError, match=expected):
            ask([wrong])


@EACH
def test_shapes_and_dtypes_that_cannot_be_are_refused(kind: str) -> None:
    model, zeros = _settled(kind), np.zeros
    with pytest.raises(ValueError, match=r"rewards need observations \(B, T, O\)"):
        model.rewards(zeros((5, 6)), zeros((5, 2)))
    with pytest.raises(ValueError, match=r"begins \(B, T\), got"):
        model.rewards(zeros((1, 5, 6)), zeros((1, 5, 2)), zeros((1, 4), bool))
    with pytest.raises(ValueError, match="rewards need observations"):
        model.rewards(zeros((1, 5, 6)), zeros((1, 4, 2)))
    with pytest.raises(ValueError, match="real numbers, got dtype complex128"):
        model.rewards(zeros((1, 5, 6), complex), zeros((1, 5, 2)))
    with pytest.raises(ValueError, match="at least one step"):
        model.score([Segment(zeros((0, 6)), zeros((0, 2)), "e", 0)])
    for ask in (model.stack, model.score, model.raw_member_scores, model.features):
        with pytest.raises(ValueError, match="at least one segment"):
            ask([])


@EACH
def test_nan_is_not_hidden_and_spoils_its_own_segment_only(kind: str) -> None:
    model, segments = _settled(kind), _segments(5)
    segments[3].observations[0, 2] = np.nan
    assert np.isfinite(model.score(segments)).tolist() == [True, True, True, False, True]
    scores = model.scores(model.stack(segments))
    assert scores.isfinite().all(0).tolist() == [True, True, True, False, True]


@EACH
def test_a_task_of_text_is_refused(kind: str) -> None:
    class Text:
        name, kind = "reviews", "text"

    settings: Any = settings_class("rewards", kind)
    with pytest.raises(ConfigError, match=f"{kind!r} scores control segments, but the task is of kind 'text'"):
        settings.model_validate({"kind": kind, **SETTINGS[kind]}).build(Text(), np.random.default_rng(0))
