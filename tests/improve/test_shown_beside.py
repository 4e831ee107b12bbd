"""Cloning inside a policy gradient: its gradient beside the surrogate, the clone that it starts as, what is refused."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import repeat
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from control_stubs import Known, point
from torch import Tensor

from prefrl import Config
from prefrl.components import ConfigError
from prefrl.improve.control import ControlLearner, ControlLearnerSettings
from prefrl.improve.gradient import Batch, Beside, _losses, adam, step, update
from prefrl.improve.objectives import Objective
from prefrl.improve.shown import Shown, again_and_again, once, steps_of
from prefrl.judgements import Demonstration
from prefrl.policies.acting import Decisions
from prefrl.policies.mlp import MLPPolicy, MLPPolicySettings
from prefrl.sample.segments import piece
from prefrl.store import Store
from prefrl.types import Query, Segment

SMALL: dict[str, Any] = {
    "environments": 4,
    "steps_per_round": 160,
    "rollout_steps": 20,
    "minibatch": 40,
    "evaluation_episodes": 4,
    "threads": None,
}


def shown(count: int = 4, steps: int = 20, discrete: bool = False) -> list[Segment]:
    """Of the point on a line: back to the middle."""
    found, rng = [], np.random.default_rng(0)
    for number in range(count):
        seen = rng.uniform(-1, 1, (steps, 1)).astype(np.float32)
        done = np.eye(2, dtype=np.float32)[(seen[:, 0] < 0).astype(int)] if discrete else np.clip(-5 * seen, -1, 1)
        found.append(Segment(seen, done.astype(np.float32), f"shown {number}", 0))
    return found


def recorded(path: Path, segments: Sequence[Segment]) -> Path:
    with Store[Segment](path) as store:
        show(store, segments)
    return path


def show(store: Store[Segment], segments: Sequence[Segment], weight: float = 1.0) -> None:
    queries = [Query((one,)) for one in segments]
    store.ask(queries)
    answers = [Demonstration(q.id, s.id, weight=weight) for q, s in zip(queries, segments, strict=True)]
    store.answer(answers)


def learner(clone: dict[str, Any], **settings: object) -> ControlLearner:
    return ControlLearnerSettings.model_validate(SMALL | settings | {"clone": clone}).build(
        point(), np.random.default_rng(0)
    )


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store[Segment]]:
    with Store[Segment](tmp_path / "store") as opened:
        yield opened


def batch_of(policy: MLPPolicy, rows: int) -> Batch[Decisions]:
    generator = torch.Generator().manual_seed(0)
    seen, done, advantages, returns, off = torch.randn(5, rows, 1, generator=generator)
    decisions = Decisions(seen, torch.eye(2)[(done[:, 0] > 0).long()] if policy.space.discrete else done)
    with torch.no_grad():
        logp = policy.log_prob(decisions)[0] + 0.3 * off
    return Batch(decisions, logp, advantages, returns)


@pytest.mark.parametrize("kept", [False, True], ids=["std learns", "std stays"])
@pytest.mark.parametrize("discrete", [False, True], ids=["box", "discrete"])
def test_the_gradient_of_both_is_the_sum_of_two_by_automatic_differentiation(discrete: bool, kept: bool) -> None:
    task, objective = point(discrete=discrete), Objective(clip=0.2, value=0.5, entropy=0.1)
    segments = shown(discrete=discrete)
    weights = {one.id: float(i + 1) for i, one in enumerate(segments)}
    found: list[Tensor] = []
    losses: list[float] = []
    for how in (update, step):
        policy = MLPPolicySettings(hidden=(8,)).build(task, np.random.default_rng(0))
        view = policy.with_std_kept() if kept else policy
        batch, steps = batch_of(policy, 24), steps_of(Shown(segments, weights), policy)
        beside = Beside(view, steps, 0.3, repeat(torch.arange(5, 60)))
        (parameter,) = policy.parameters()
        first, _ = _losses(policy, batch, objective, 24, 24)
        rows = steps.rows(torch.arange(5, 60))
        second = -(rows.advantages * view.log_prob(rows.inputs)[0]).mean()
        (expected,) = torch.autograd.grad(first + 0.3 * second, parameter)
        optimizer = adam([parameter], 1e-3)
        if how is update:
            (metrics,) = update(policy, optimizer, batch, [torch.arange(24)], objective, beside=beside)
        else:
            metrics = step(policy, optimizer, batch, objective, 10, beside)
        assert parameter.grad is not None
        torch.testing.assert_close(parameter.grad, expected, rtol=1e-4, atol=5e-6)
        assert metrics["shown_loss"] == pytest.approx(float(second.detach()), rel=1e-5)
        found.append(parameter.detach().clone())
        losses.append(metrics["loss"])
    torch.testing.assert_close(found[0], found[1], rtol=0, atol=2e-5)
    assert losses[0] == pytest.approx(losses[1], rel=1e-5)


def test_a_learner_is_a_clone_of_a_file_before_it_acts_and_sees_what_it_saw_then(tmp_path: Path) -> None:
    one = learner({"data": recorded(tmp_path / "file", shown()), "epochs": 60, "learning_rate": 1e-2})
    seen = np.linspace(-1, 1, 21, dtype=np.float32)[:, None]
    actions = one.actor()(seen, None, None)[0]
    assert np.abs(actions - np.clip(-5 * seen, -1, 1)).mean() < 0.2
    one.policy.observe(np.full((5000, 1), 50.0, np.float32))
    np.testing.assert_array_equal(one.actor()(seen, None, None)[0], actions)
    assert float(one.policy.state()["parameters"]["log_std"].exp()) == pytest.approx(1.0)  # to explore with


def test_what_only_the_store_shows_is_cloned_in_the_first_round_and_the_critic_alone_learns_beside(
    store: Store[Segment],
) -> None:
    one = learner({"epochs": 60, "learning_rate": 1e-2, "keep": 0.1})
    show(store, shown())
    first = one.improve(Known(), store, np.random.default_rng(0))
    weights = one.policy.state()["parameters"]["actor_0"].clone()
    assert first["demonstrations"] == 4
    assert "policy_loss" not in first
    assert "shown_loss" not in first
    again = learner({"epochs": 60, "keep": 0.1})
    again.load(one.state())
    second = again.improve(Known(), store, np.random.default_rng(0))
    assert "cloning_loss" not in second  # a resumed run does not clone again
    assert "policy_loss" in second
    assert "shown_loss" in second
    assert not torch.equal(again.policy.state()["parameters"]["actor_0"], weights)


def test_what_is_kept_decays_from_round_to_round(store: Store[Segment]) -> None:
    show(store, shown())
    one = learner({"keep": 0.5, "decay": 0.5})
    assert one._imitation is not None
    assert isinstance(one.policy, MLPPolicy)
    steps = one._imitation.shown(store)
    found = [one._imitation.beside(one.policy, steps, n, np.random.default_rng(0)) for n in (0, 2)]
    assert [beside.weight for beside in found if beside] == [0.5, 0.125]


def test_a_policy_with_what_is_shown_beside_it_stays_near_it_where_the_reward_pulls_away(tmp_path: Path) -> None:
    """The reward of the stub is for the middle; shown is always to push right."""
    seen = np.linspace(-1, 1, 40, dtype=np.float32)[:, None]
    data = recorded(tmp_path / "file", [Segment(seen, np.ones_like(seen), "right", 0)])
    means = []
    with Store[Segment](tmp_path / "store") as store:
        for keep in (0.0, 3.0):
            one = learner({"data": data, "epochs": 30, "learning_rate": 1e-2, "keep": keep})
            for _ in range(6):
                one.improve(Known(), store, np.random.default_rng(0))
            means.append(float(one.actor()(seen, None, None)[0].mean()))
    assert means[1] > 0.7
    assert means[0] < means[1] - 0.2


def test_a_minibatch_may_be_larger_than_all_that_is_shown() -> None:
    policy = MLPPolicySettings(hidden=(8,)).build(point(), np.random.default_rng(0))
    steps = steps_of(Shown(shown(1, 5), {}), policy)
    rows = again_and_again(steps, 64, np.random.default_rng(0))
    for _ in range(3):
        assert sorted(next(rows).tolist()) == [0, 1, 2, 3, 4]


def test_steps_that_are_shown_twice_are_learned_once() -> None:
    whole, other = shown(2)
    changed = Segment(whole.observations[:3], -whole.actions[:3], whole.episode, 0)
    parts = [piece(whole, 4, 1), whole, piece(whole, 4, 1), changed, piece(other, 2, 3), piece(other, 3, 1)]
    assert once(parts) == [whole, changed, parts[4]]


def test_without_anything_shown_it_is_refused_before_anybody_is_asked(tmp_path: Path, store: Store[Segment]) -> None:
    for name in ("keep=0.1", "epochs=2"):
        config = Config.load("control/toy", [f"learner.clone.{name}"])
        with pytest.raises(ConfigError, match=r"learner\.clone learns from demonstrations, and there are none"):
            config.build(store).check_shown()
    with pytest.raises(ValueError, match=r"there are none: set learner\.clone\.data"):
        learner({"keep": 0.1}).improve(Known(), store, np.random.default_rng(0))
    with pytest.raises(ConfigError, match=r"learner\.clone\.data: .*expected an \.npz"):
        learner({"keep": 0.1, "data": tmp_path / "nothing"})


def test_demonstrations_of_other_spaces_are_refused_by_name(tmp_path: Path, store: Store[Segment]) -> None:
    wide = Segment(np.zeros((3, 2), np.float32), np.zeros((3, 1), np.float32), "wide", 0)
    with pytest.raises(ConfigError, match=r"learner\.clone\.data: the demonstration 'wide' .* has"):
        learner({"keep": 0.1, "data": recorded(tmp_path / "wide", [wide])})
    far = Segment(np.zeros((3, 1), np.float32), np.full((3, 1), 2.0, np.float32), "far", 0)
    show(store, [far])
    with pytest.raises(ValueError, match=r"'far' .* outside of the bounds"):
        learner({"keep": 0.1}).improve(Known(), store, np.random.default_rng(0))


@pytest.mark.parametrize("policy", [{"kind": "gru"}, {"sde": True}])
def test_a_policy_that_cannot_be_cloned_here_is_refused(policy: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match="clone needs a policy of kind mlp without sde"):
        ControlLearnerSettings.model_validate({"policy": policy, "clone": {"keep": 0.1}})


def test_a_file_that_nothing_is_to_be_done_with_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"learner\.clone\.data: .* is of no use while epochs and keep are 0"):
        Config.load("control/pendulum", ["learner.clone.data=shown"])


def test_ranks_that_know_no_demonstrations_are_refused() -> None:
    with pytest.raises(ConfigError, match="demonstrations, which the first of 2 ranks alone has"):
        learner({"keep": 0.1}).check_ranks(2)
