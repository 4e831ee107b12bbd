"""Gradients through the world: they are those of finite differences, they teach, and they stop where they must."""

from __future__ import annotations

from copy import deepcopy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from control_stubs import Ageing, Known, point
from test_loop import leaves

from prefrl.components import ConfigError
from prefrl.improve.backprop import Backprop, BackpropSettings
from prefrl.improve.through import follow, returns, traced_rewards
from prefrl.policies.mlp import MLPPolicy
from prefrl.reward_models.ensemble import Ensemble, combine, combine_traced
from prefrl.reward_models.linear import LinearSettings
from prefrl.reward_models.mlp import MLPSettings
from prefrl.reward_models.sequence import GRUSettings
from prefrl.store import Store
from prefrl.types import Floats, Segment, Steps

WORLD: dict[str, Any] = {"members": 2, "hidden": (16,), "fit_steps": 200, "minibatch": 64, "learning_rate": 1e-2}
SMALL: dict[str, Any] = {
    "world": WORLD, "episodes": 4, "steps": 10, "branches": 8, "updates": 25, "learning_rate": 1e-2, "discount": 0.9,
    "policy": {"hidden": (16, 16), "squash": True, "initial_std": 0.3}, "evaluation_episodes": 5, "device": "cpu",
}  # fmt: skip
PLACES = np.linspace(-1, 1, 9, dtype=np.float32)[:, None]


@pytest.fixture
def store(tmp_path: Path) -> Store[Segment]:
    return Store[Segment](tmp_path / "store")


def backprop(task: Any = None, **settings: Any) -> Backprop:
    return BackpropSettings.model_validate(SMALL | settings).build(task or point(), np.random.default_rng(0))


def rounds(learner: Backprop, store: Store[Segment], numbers: range) -> dict[str, float]:
    for number in numbers:
        learner.sample(8, np.random.default_rng([number, 0]))
        found = learner.improve(Known(), store, np.random.default_rng([number, 1]))
    return found


@pytest.mark.parametrize(("mean", "noisy"), [(False, True), (True, False)])
def test_the_gradient_is_that_of_finite_differences(mean: bool, noisy: bool) -> None:
    learner = backprop()
    learner.sample(8, np.random.default_rng(0))
    learner.ground.learn(np.random.default_rng(1))
    assert learner.ground.data is not None
    learner.policy.observe(learner.ground.data.observations)
    rng, policy, reward = np.random.default_rng(2), learner.policy, MLPSettings(hidden=(8,)).build(point(), _rng(3))
    starts = torch.from_numpy(PLACES[:8] * 0.05 + 0.2)  # well within what was seen: its bounds are kinks
    noise = torch.from_numpy(rng.standard_normal((6, 8, 1), np.float32)) if noisy else None

    def worth() -> torch.Tensor:
        found = follow(policy, learner.ground.world, starts, noise, 6, mean)
        rewards, end = reward.traced(found.observations[:, :-1], found.actions), policy.worth(found.observations[:, -1])
        return returns(rewards, found.going, end, 0.9)[:, 0].sum()

    (weights,) = policy.parameters()
    with torch.no_grad():  # the starting actor does about the same everywhere
        weights.add_(torch.from_numpy(rng.standard_normal(weights.shape, np.float32)), alpha=0.1)
    (slope,) = torch.autograd.grad(worth(), weights)
    named = dict(zip(policy.named(), [*_split(policy, slope)], strict=True))
    assert not named["log_std"].any()
    assert not any(part.any() for name, part in named.items() if name.startswith("critic"))
    for _ in range(3):
        way = slope / slope.norm() + torch.from_numpy(rng.standard_normal(slope.shape, np.float32)) * 0.02
        way[-sum(part.numel() for name, part in named.items() if not name.startswith("actor")) :] = 0.0
        both = []
        for step in (1e-3, -1e-3):
            with torch.no_grad():
                weights.add_(way, alpha=step)
                both.append(float(worth()))
                weights.sub_(way, alpha=step)
        assert (both[0] - both[1]) / 2e-3 == pytest.approx(float(slope @ way), rel=0.02)


def _rng(seed: int) -> np.random.Generator:
    return np.random.default_rng(seed)


def _split(policy: MLPPolicy, flat: torch.Tensor) -> list[torch.Tensor]:
    return list(flat.split([part.numel() for part in policy.named().values()]))  # type: ignore[no-untyped-call]


@pytest.mark.parametrize(
    "settings", [MLPSettings(combine=Ensemble(by="lower")), GRUSettings(), MLPSettings(features="observations")]
)
def test_traced_rewards_are_the_rewards(settings: Any) -> None:
    reward, rng = settings.build(point(), _rng(0)), _rng(1)
    seen, done = (rng.standard_normal((3, 7, 1), np.float32) for _ in range(2))
    places = torch.from_numpy(seen).requires_grad_()
    found = traced_rewards(reward).traced(places, torch.from_numpy(done))
    np.testing.assert_allclose(found.detach().numpy(), reward.rewards(seen, done), rtol=1e-4, atol=1e-6)
    (slope,) = torch.autograd.grad(found[1, 2], places)
    assert slope[1, 2].abs().sum() > 0
    assert not slope[[0, 2]].any()
    assert not slope[1, 3:].any()


@pytest.mark.parametrize(
    "ensemble", [Ensemble(), Ensemble(by="worst", optimism=1.0), Ensemble(by="lower", caution=0.5)]
)
def test_members_are_put_together_in_torch_as_in_numpy(ensemble: Ensemble) -> None:
    values = _rng(0).standard_normal((3, 5))
    np.testing.assert_allclose(combine_traced(torch.from_numpy(values), ensemble, 2), combine(values, ensemble, 2))


def test_one_member_has_a_gradient_though_it_has_no_spread() -> None:
    values = torch.ones(1, 4, requires_grad=True)
    combine_traced(values, Ensemble(by="lower"), 1).sum().backward()  # type: ignore[no-untyped-call]
    assert values.grad is not None
    assert values.grad.tolist() == [[1.0] * 4]


def test_nothing_is_earned_after_an_end() -> None:
    rewards, going = torch.tensor([[1.0, 2.0], [1.0, 2.0]]), torch.tensor([[1.0, 1.0, 1.0], [1.0, 0.0, 0.0]])
    end = torch.tensor([8.0, 8.0])
    assert returns(rewards, going, end, 0.5).tolist() == [[4.0, 6.0], [1.0, 0.0]]
    assert returns(rewards, going, None, 0.5).tolist() == [[2.0, 2.0], [1.0, 0.0]]


@pytest.mark.parametrize("settings", [{}, {"value": False, "noise": False, "follow": "mean"}])
def test_it_learns_in_its_world_to_stay_at_the_origin(store: Store[Segment], settings: dict[str, Any]) -> None:
    learner = backprop(**settings)
    before = learner.evaluate(Known(), _rng(9)).metrics
    metrics = rounds(learner, store, range(3))
    after = learner.evaluate(Known(), _rng(9)).metrics
    assert before["gold"] < -8.0
    assert after["gold"] > -2.5
    assert after["imagined"] == pytest.approx(after["learned"], abs=1.5)  # the same policy, from the same states
    assert metrics["branch"] == 10
    assert metrics["grad_norm"] > 0
    assert ("value_loss" in metrics) == (not settings)


def test_real_and_imagined_steps_are_counted_apart(store: Store[Segment]) -> None:
    spent: list[int] = []
    learner = backprop(point(spent=spent), updates=3, world=WORLD | {"members": 3})
    learner.sample(8, _rng(0))
    first = sum(spent)
    learner.improve(Known(), store, _rng(1))
    assert learner.steps == Steps(learn=first, imagined=3 * 10 * 9)  # 8 branches are 9 of three members
    learner.evaluate(Known(), _rng(5))
    assert learner.steps == Steps(learn=first, evaluate=100, imagined=370)
    assert sum(spent) == first + 100


def test_gold_never_touches_what_is_learned(store: Store[Segment]) -> None:
    states = []
    for hide in (False, True):
        learner = backprop(point(hide_gold=hide), updates=3)
        rounds(learner, store, range(2))
        state = learner.state()
        for one in state["ground"]["plays"]:
            del one["gold"]  # of what was done, for oracles
        states.append([*leaves(state)])
    assert states[0] == states[1]


def test_a_saved_learner_goes_on_to_equal_bytes(store: Store[Segment]) -> None:
    first = backprop(updates=5)
    rounds(first, store, range(2))
    again = backprop(updates=5)
    again.load(deepcopy(first.state()))
    for one in (first, again):
        one.pace(0.6, 0.8)
        rounds(one, store, range(2, 3))
    assert [*leaves(first.state())] == [*leaves(again.state())]
    assert first.steps == again.steps


def test_what_the_gradient_goes_through_stays_and_learns_again(store: Store[Segment]) -> None:
    learner, reward = backprop(updates=3), MLPSettings(hidden=(8,)).build(point(), _rng(3))
    learner.sample(8, _rng(0))
    kept = [one.detach().clone() for one in reward.parameters()]
    learner.improve(reward, store, _rng(1))
    for before, after in zip(kept, reward.parameters(), strict=True):
        assert torch.equal(before, after)
        assert after.grad is None
    assert all(one.requires_grad for one in (*learner.ground.world.parameters(), *reward.parameters()))


def test_it_says_that_it_has_stopped_dreaming_and_its_policy_stays(store: Store[Segment]) -> None:
    learner = backprop(updates=3)
    rounds(learner, store, range(1))
    acted, imagined = learner.actor()(PLACES, None, None)[0], learner.steps.imagined
    real = learner.ground.data
    assert real is not None
    learner.ground.data = replace(real, following=_rng(0).permutation(real.following))
    learner.ground.fresh = True
    metrics = learner.improve(Known(), store, _rng(1))
    assert (metrics["reach"], metrics["branch"], learner.steps.imagined) == (0, 0, imagined)
    assert acted.tobytes() == learner.actor()(PLACES, None, None)[0].tobytes()
    assert "has stopped dreaming" in learner.evaluate(Known(), _rng(2)).notes[0]


def test_discrete_actions_and_rewards_without_a_gradient_are_refused_with_what_to_do() -> None:
    with pytest.raises(ConfigError, match=r"those of Point are discrete: use learner\.kind=dyna"):
        backprop(point(discrete=True))
    with pytest.raises(ConfigError, match=r"\(Ageing\) has no gradient .*use reward\.kind=mlp"):
        backprop().check_reward(Ageing())  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"policy\.sde: .*leave it out"):
        backprop(policy={"sde": True})
    backprop().check_reward(LinearSettings().build(point(), _rng(0)))


def test_the_policy_in_torch_acts_as_it_does_in_numpy() -> None:
    for squash in (False, True):
        policy = backprop(policy={"squash": squash, "hidden": (8,)}).policy
        policy.observe(PLACES * 3)
        found: Floats = policy.traced(torch.from_numpy(PLACES * 9)).detach().numpy()
        np.testing.assert_allclose(found, policy.numpy_actor()(PLACES * 9, None)[1], atol=1e-6)


def test_real_steps_grow_by_episodes_and_work_by_gradient_steps() -> None:
    settings = BackpropSettings(episodes=3, updates=10, branches=4, steps=5)
    assert (settings.work(), settings.real_work()) == (200, 3)
