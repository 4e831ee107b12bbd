"""The policy over maps, and masks in every policy of discrete actions, on a small floorplan."""

from functools import cache
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch

from prefrl.components import ConfigError
from prefrl.envs.floorplan import FloorplanSettings, FloorplanTask
from prefrl.envs.plans import CELLS, random_plans
from prefrl.envs.tabular import GridworldSettings
from prefrl.improve.control import ControlLearner, ControlLearnerSettings
from prefrl.improve.gradient import Batch, adam, step
from prefrl.improve.objectives import Objective
from prefrl.policies.acting import Acting
from prefrl.policies.maps import MappedDecisions, MapsPolicy, MapsPolicySettings
from prefrl.policies.mlp import MLPPolicySettings
from prefrl.policies.rollout import Rollout, collect, whole_episodes
from prefrl.protocols import StepRewardModel
from prefrl.reward_models.linear import LinearSettings
from prefrl.storage.checkpoints import load_state, save_state
from prefrl.store import Store
from prefrl.types import Bools, Floats, Segment


@cache
def plan() -> FloorplanTask:
    return FloorplanSettings(macros=4, grid=12).build()


POLICIES: dict[str, dict[str, Any]] = {
    "mlp": {"kind": "mlp", "hidden": (8,)},
    "torch": {"kind": "cnn", "image": (1, 1, 21), "filters": ((4, 1, 1),), "width": 8},
    "gru": {"kind": "gru"},
    "transformer": {"kind": "transformer"},
    "maps": {"kind": "maps", "hidden": (8,)},
}


def acted(policy: MapsPolicy, seed: int) -> Rollout:
    envs, rng = plan().environments(6), np.random.default_rng(seed)
    return collect(envs, envs.reset(rng), plan().horizon, Acting(policy.decide(), rng))[0]


def moved() -> MapsPolicy:
    """Some way from its start, where every action is as probable."""
    policy = MapsPolicySettings(hidden=(7, 5), gain=2.0).build(plan(), np.random.default_rng(0))
    policy.observe(acted(policy, 3).observations)
    order = torch.Generator().manual_seed(1)
    for p in policy.parameters():
        p.data += 0.3 * torch.randn(p.shape, generator=order)
    return policy


@pytest.mark.parametrize("kind", POLICIES)
def test_no_policy_takes_an_illegal_action_and_its_ratio_starts_at_one(kind: str, store: Store[Segment]) -> None:
    task, rng = plan(), np.random.default_rng(0)
    assert task.observation_size == 21
    settings = ControlLearnerSettings(
        environments=8, steps_per_round=80, rollout_steps=5, epochs=2, policy=POLICIES[kind], discount=1.0
    )
    learner = settings.build(task, rng)
    reward = LinearSettings(members=2).build(task, rng)
    for _ in range(2):
        metrics = learner.improve(reward, store, rng)
        assert metrics["ratio_error"] < 1e-5
        recent = learner.state()["recent"]
        assert (recent["choices"] * ~recent["legal"]).sum() == 0
        np.testing.assert_array_equal(
            recent["legal"].reshape(-1, 144), task.legal(recent["observations"].reshape(-1, 21))
        )
    assert_legal_without_a_simulator(learner)


def assert_legal_without_a_simulator(learner: ControlLearner) -> None:
    """As a saved policy acts: nobody tells it what is legal, and observations do."""
    task, act, memory = plan(), learner.actor(), None
    envs, rng = task.environments(5), np.random.default_rng(1)
    observations = envs.reset(rng)
    for _ in range(task.horizon):
        actions, memory = act(observations, rng, memory)
        last = observations
        observations = envs.step(actions).observations  # which refuses what is not legal
    assert (task.world.seen(last)[:, CELLS:] >= 0).all()


def test_at_first_every_legal_action_is_as_probable() -> None:
    policy = MapsPolicySettings().build(plan(), np.random.default_rng(0))
    rollout = acted(policy, 0)
    reading = policy.read(rollout, None, rollout.ends)
    logp, entropy = policy.log_prob(reading.inputs)
    assert rollout.legal is not None
    expected = np.log(rollout.legal.sum(-1)).reshape(-1, 1)
    np.testing.assert_allclose(logp.detach(), -expected, atol=1e-5)
    np.testing.assert_allclose(entropy.detach(), expected, atol=1e-5)


def test_logits_are_what_the_maps_count_for_and_what_is_added_for_each_action() -> None:
    policy = moved()
    rollout = acted(policy, 0)
    inputs = policy.read(rollout, None, rollout.ends).inputs
    named = {name: p.detach().numpy() for name, p in policy.named().items()}
    x = inputs.seen.observations.numpy()
    for i in range(2):
        x = np.tanh(x @ named[f"actor_{i}"] + named[f"actor_bias_{i}"])
    outputs = x @ named["actor_2"] + named["actor_bias_2"]
    told = plan().told(rollout.observations.reshape(-1, 21))
    count = len(plan().maps)
    logits = outputs[:, count:] + 2 * np.einsum("baf,bf->ba", told, outputs[:, :count])
    assert rollout.legal is not None
    logits = np.where(rollout.legal.reshape(-1, 144), logits, -np.inf)
    logits -= np.log(np.exp(logits).sum(1, keepdims=True))
    expected = (np.where(np.isfinite(logits), logits, 0) * inputs.seen.choices.numpy()).sum(1)
    np.testing.assert_allclose(policy.log_prob(inputs)[0].detach()[:, 0], expected, atol=1e-4)


def test_acting_and_learning_read_the_same_logits() -> None:
    policy, rng = moved(), np.random.default_rng(0)
    rollout = acted(policy, 0)
    mode = whole_episodes(plan(), Acting(policy.decide(), None), 3, rng)
    inputs = policy.read(mode, None, mode.ends).inputs
    logp = policy.log_prob(inputs)[0].detach()
    every = [policy.log_prob(with_choice(inputs, action))[0].detach() for action in range(plan().action_size)]
    legal = inputs.seen.legal
    assert legal is not None
    best = torch.where(legal, torch.cat(every, 1), -torch.inf).amax(1, keepdim=True)
    torch.testing.assert_close(logp, best)
    assert rollout.choices.shape == (6, 5, 144)


def with_choice(inputs: MappedDecisions, action: int) -> MappedDecisions:
    seen = inputs.seen
    choices = torch.zeros_like(seen.choices)
    choices[:, action] = 1.0
    return MappedDecisions(type(seen)(seen.observations, choices, seen.legal), inputs.maps)


def test_nothing_is_learned_of_what_was_not_legal() -> None:
    """The gradient of an action's own logit is zero where it was never legal."""
    policy = moved()
    rollout = acted(policy, 0)
    reading = policy.read(rollout, None, rollout.ends)
    logp = policy.log_prob(reading.inputs)[0].detach()
    advantages = torch.randn(logp.shape, generator=torch.Generator().manual_seed(0))
    batch = Batch(reading.inputs, logp, advantages)
    step(policy, adam(policy.parameters(), 0.0), batch, Objective(clip=0.2, entropy=0.1), None)
    slope = policy.named()["actor_bias_2"].grad
    assert slope is not None
    assert rollout.legal is not None
    ever = torch.from_numpy(rollout.legal.reshape(-1, 144).any(0))
    own = slope[0, len(plan().maps) :]
    assert own[~ever].abs().sum() == 0
    assert (own[ever] != 0).sum() > 10
    assert not ever.all()


def test_what_was_seen_does_not_change_what_it_does() -> None:
    policy = moved()
    rollout = acted(policy, 0)
    before = policy.log_prob(policy.read(rollout, None, rollout.ends).inputs)[0].detach()
    policy.observe(rollout.observations + 0.1)
    after = policy.log_prob(policy.read(rollout, None, rollout.ends).inputs)[0].detach()
    torch.testing.assert_close(before, after, atol=1e-4, rtol=1e-4)


def test_saved_and_loaded_it_is_the_same_policy() -> None:
    policy, other = moved(), MapsPolicySettings(hidden=(7, 5), gain=2.0).build(plan(), np.random.default_rng(5))
    other.load(policy.state())
    for one, another in zip(policy.parameters(), other.parameters(), strict=True):
        torch.testing.assert_close(one, another, rtol=0, atol=0)
    np.testing.assert_array_equal(acted(policy, 1).choices, acted(other, 1).choices)
    with pytest.raises(ValueError, match="other settings or task"):
        MapsPolicySettings(hidden=(6,)).build(plan(), np.random.default_rng(0)).load(policy.state())


def test_a_task_that_tells_nothing_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"learner\.policy\.kind=maps is for tasks that tell .* gridworld does not"):
        MapsPolicySettings().build(GridworldSettings().build(), np.random.default_rng(0))


def test_examples_for_a_clone_know_what_was_legal() -> None:
    rng, task = np.random.default_rng(0), plan()
    policy = MLPPolicySettings(hidden=(8,)).build(task, rng)
    rollout = whole_episodes(task, Acting(policy.decide(), rng), 2, rng)
    segments = [Segment(rollout.observations[i], rollout.actions[i], f"e{i}", 0, context="") for i in range(2)]
    examples = policy.examples(segments)
    assert rollout.legal is not None
    assert examples.legal is not None
    np.testing.assert_array_equal(examples.legal, rollout.legal.reshape(-1, 144))
    # Nearly even at first: the likelihood of a choice among the legal ones, and not among all.
    logp = policy.log_prob(examples)[0].detach().numpy()
    np.testing.assert_allclose(logp, -np.log(rollout.legal.sum(-1)).reshape(-1, 1), atol=0.2)


class Truth:
    """The gold of a step, seen in the next one's observation; as a reward for tests."""

    members, memory, fitted = 1, 1, True

    def rewards(self, observations: Floats, actions: Floats, begins: Bools | None = None) -> Floats:
        found: Floats = -10 * observations[..., :2].sum(-1)
        return found


def built(seed: int) -> ControlLearner:
    settings = ControlLearnerSettings.model_validate(
        {
            "environments": 32,
            "steps_per_round": 640,
            "rollout_steps": 5,
            "epochs": 4,
            "discount": 1.0,
            "target_kl": 0.05,
        }
        | {"minibatch": 80, "policy": {"kind": "maps", "hidden": [16]}}
    )
    return settings.build(plan(), np.random.default_rng(seed))


def improved(learner: ControlLearner, store: Store[Segment], seed: int) -> None:
    learner.improve(cast("StepRewardModel", Truth()), store, np.random.default_rng(seed))


def test_it_learns_where_to_place_macros(store: Store[Segment], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("prefrl.improve.control.step_rewards", lambda reward: reward)
    learner, totals = built(0), []
    for number in range(8):
        improved(learner, store, number)
        recent = learner.state()["recent"]
        totals.append(recent["final_observations"][recent["terminated"]][:, 2:4].sum(1).mean())
    assert totals[0] > 1.8  # random plans have 2
    assert totals[-1] < 1.7


def test_a_saved_learner_goes_on_bit_for_bit(
    store: Store[Segment], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr("prefrl.improve.control.step_rewards", lambda reward: reward)
    learner, other = built(0), built(1)
    improved(learner, store, 0)
    save_state(tmp_path, "learner", learner.state())
    other.load(load_state(tmp_path, "learner"))
    for one in (learner, other):
        improved(one, store, 1)
    for mine, theirs in zip(learner.policy.parameters(), other.policy.parameters(), strict=True):
        torch.testing.assert_close(mine, theirs, rtol=0, atol=0)


def test_what_is_seen_does_not_hang_on_how_the_gold_is_weighed() -> None:
    states = random_plans(plan().world, 3, np.random.default_rng(0))
    other = FloorplanSettings(macros=4, grid=12, wire_weight=0.0, congestion_weight=7.0).build()
    np.testing.assert_array_equal(plan().world.observe(states), other.world.observe(states))
    np.testing.assert_array_equal(plan().world.maps(states), other.world.maps(states))
