"""A flow of actions: its loss and its field by hand, plans and where they end, both modes of a target with two."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch

from prefrl.components import ConfigError
from prefrl.envs.toys import PointSettings, TMazeSettings
from prefrl.improve.control import ControlLearnerSettings
from prefrl.improve.gradient import Batch, adam, update
from prefrl.improve.objectives import Objective
from prefrl.policies.acting import Acting, forgotten
from prefrl.policies.flow import WAVES, FlowPolicy, FlowPolicySettings
from prefrl.policies.loaded import Loaded
from prefrl.policies.rollout import Rollout, collect
from prefrl.types import Floats, Segment

TASK = PointSettings(horizon=10, segment_steps=3).build()
SMALL: dict[str, Any] = {"hidden": (7, 5), "critic_hidden": (6,), "chunk": 4, "execute": 3, "draws": 3}


def made(**changes: Any) -> FlowPolicy:
    """Some way from its start, so that velocities differ."""
    policy = FlowPolicySettings.model_validate(SMALL | changes).build(TASK, np.random.default_rng(0))
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.data += 0.3 * torch.randn(parameter.shape, generator=generator)
    policy.observe(np.random.default_rng(2).normal(0.1, 0.7, (50, 2)))
    return policy


def played(policy: FlowPolicy, lengths: tuple[int, ...], seed: int = 3) -> list[Rollout]:
    """Rollouts that follow one another, with what is remembered from one to the next."""
    envs, rng, memory, begins = TASK.environments(3), np.random.default_rng(seed), None, None
    observations, found = envs.reset(np.random.default_rng(4)), []
    for steps in lengths:
        act = Acting(policy.decide(), rng, memory)
        rollout, observations = collect(envs, observations, steps, act, begins)
        found.append(rollout)
        begins = rollout.ends[:, -1]
        memory = forgotten(act.memory, begins)
    return found


def test_plans_are_executed_one_action_after_another_and_a_new_one_begins_with_each_episode() -> None:
    """Episodes of 10 steps and 3 of 4 planned actions executed: plans begin at 0, 3, 6 and 9, and 10 is another one."""
    (rollout,) = played(made(), (25,))
    decides = rollout.choices[0, :, 0] == 3
    assert np.flatnonzero(decides).tolist() == [0, 3, 6, 9, 10, 13, 16, 19, 20, 23]
    plans = rollout.choices[..., 2:].reshape(3, 25, 4, 2)
    begins = [*np.flatnonzero(decides).tolist(), 25]
    for begin, end in pairwise(begins):
        for t in range(begin, end):
            np.testing.assert_array_equal(plans[:, t], plans[:, begin])
            expected = np.clip(plans[:, begin, t - begin], -1, 1)
            np.testing.assert_allclose(rollout.actions[:, t], expected, atol=1e-6)


def test_a_rollout_may_end_within_a_plan_and_the_next_goes_on_with_it() -> None:
    (whole,), parts = played(made(), (24,)), played(made(), (5, 8, 11))
    joined = np.concatenate([part.actions for part in parts], 1)
    np.testing.assert_array_equal(joined, whole.actions)
    np.testing.assert_array_equal(played(made(), (24,), seed=3)[0].actions, whole.actions)
    assert not np.array_equal(played(made(), (24,), seed=5)[0].actions, whole.actions)


def test_the_update_reads_plans_and_counts_of_each_what_was_executed_in_its_episode_and_rollout() -> None:
    first, second = played(made(), (8, 5))
    policy, nothing = made(), np.zeros((3, 8), bool)
    reading = policy.read(first, None, nothing)
    assert reading.decides is not None
    assert np.flatnonzero(reading.decides[0]).tolist() == [0, 3, 6]
    assert reading.inputs.counted[:3].tolist() == [[True, True, True, False]] * 2 + [[True, True, False, False]]
    np.testing.assert_array_equal(reading.inputs.plans[1].flatten(), first.choices[0, 3, 2:])
    later = policy.read(second, None, np.zeros((3, 5), bool))  # steps 8 to 12; the plan that 8 ends is not learned from
    assert later.decides is not None
    assert np.flatnonzero(later.decides[0]).tolist() == [1, 2]
    assert later.inputs.counted[:2].tolist() == [[True, False, False, False], [True, True, True, False]]
    again = policy.read(first, None, nothing)
    for name in ("noise", "times"):  # the same draws, whenever it is read
        assert torch.equal(getattr(again.inputs, name), getattr(reading.inputs, name))


def test_the_loss_is_that_of_the_paper_worked_out_one_draw_after_another() -> None:
    (rollout,), policy = played(made(), (8,)), made()
    inputs = policy.read(rollout, None, np.zeros((3, 8), bool)).inputs
    layers, row = policy._layers(), 2
    expected = []
    for noise, time in zip(inputs.noise[row].numpy(), inputs.times[row].numpy(), strict=True):
        plan = inputs.plans[row].numpy()
        x = np.concatenate([inputs.observations[row], ((1 - time) * noise + time * plan).ravel(), np.cos(WAVES * time)])
        for i, (weight, bias) in enumerate(layers):
            x = x @ weight + bias[0]
            x = x / (1 + np.exp(-x)) if i < len(layers) - 1 else x
        apart = (x.reshape(4, 2) - (plan - noise)) ** 2
        expected.append(apart[:2].sum())  # the rollout ends after two of its actions
    assert float(policy.log_prob(inputs)[0][row].detach()) == pytest.approx(-np.mean(expected), rel=1e-5)
    assert policy.log_prob(inputs)[1] is None


def test_what_is_shown_becomes_a_plan_from_each_step_whose_end_does_not_count() -> None:
    policy, actions = made(chunk=3, execute=1), np.array([[0.1, 0], [0.2, 0], [0.3, 0]], np.float32)
    segments = [Segment(np.zeros((n, 2), np.float32), actions[:n], f"e{n}", 0) for n in (3, 1)]
    found = policy.examples(segments)
    assert found.counted.tolist() == [[True] * 3, [True, True, False], [True, False, False], [True, False, False]]
    np.testing.assert_allclose(
        found.plans[:, :, 0], [[0.1, 0.2, 0.3], [0.2, 0.3, 0.3], [0.3] * 3, [0.1] * 3], atol=1e-6
    )


def test_new_statistics_do_not_change_what_the_policy_does() -> None:
    policy, seen = made(), np.random.default_rng(5).normal(0.1, 0.5, (20, 2)).astype(np.float32)
    before = policy.decide()(seen, None, None, None)
    policy.observe(np.random.default_rng(6).normal(0.5, 0.6, (20, 2)))
    for one, other in zip(before, policy.decide()(seen, None, None, None), strict=True):
        assert one is not None
        assert other is not None
        np.testing.assert_allclose(one, other, atol=1e-4)


def test_a_loaded_policy_takes_its_plan_back_and_answers_alike_to_one_observation() -> None:
    learner = ControlLearnerSettings(policy=FlowPolicySettings(**SMALL)).build(TASK, np.random.default_rng(0))
    learner.policy.load(made().state())
    policy = Loaded(learner.actor(), 2, 2, TASK.action_bounds)
    first, state = policy.predict([0.1, 0.2])
    second, state = policy.predict([0.5, -0.2], state)
    assert state is not None
    np.testing.assert_array_equal(policy.predict([0.1, 0.2])[0], first)
    np.testing.assert_array_equal(policy.predict([-0.9, 0.9], policy.predict([0.1, 0.2])[1])[0], second)  # of the plan
    np.testing.assert_array_equal(policy.predict([0.1, 0.2], state, episode_start=[True])[0], first)


def test_what_it_cannot_be_is_said() -> None:
    maze = TMazeSettings(length=4).build()
    with pytest.raises(ConfigError, match="flow is for continuous actions, and those of tmaze are discrete"):
        FlowPolicySettings().build(maze, np.random.default_rng(0))
    with pytest.raises(ValueError, match="execute must be at most chunk, got 5 of 4"):
        FlowPolicySettings(execute=5)
    flow = {"policy": {"kind": "flow"}}
    settings = ControlLearnerSettings.model_validate(flow)
    assert (settings.entropy, settings.target_kl) == (0.0, None)
    assert "r = exp(L_old(a|s) - L(a|s))" in settings.formula()
    assert "H[pi]" not in settings.formula()
    for name, value in (("entropy", 0.1), ("target_kl", 0.01)):
        with pytest.raises(ValueError, match=rf"\.{name}: expected .* with policy.kind=flow, got {value}"):
            ControlLearnerSettings.model_validate(flow | {name: value})
    with pytest.raises(ValueError, match=r"rollout_steps: a rollout has 2 steps, and a plan of 4"):
        ControlLearnerSettings.model_validate(flow | {"environments": 4, "steps_per_round": 16, "rollout_steps": 2})


@pytest.fixture(scope="module")
def trained() -> FlowPolicy:
    """Where the first number of an observation is -1 one number's target is N(0.3, 0.2^2), and where it is 1 it is -0.8
    or 0.8; the other number's is 0."""
    settings = FlowPolicySettings(hidden=(64, 64), chunk=1, execute=1, steps=20, draws=4)
    policy, rng = settings.build(TASK, np.random.default_rng(0)), np.random.default_rng(1)
    optimizer, count = adam(policy.parameters(), 3e-3), 4000
    seen = np.repeat([[-1.0, 0.0], [1.0, 0.0]], count // 2, 0).astype(np.float32)
    one = np.where(seen[:, 0] < 0, 0.3 + 0.2 * rng.standard_normal(count), 0.8 * rng.choice([-1.0, 1.0], count))
    actions = np.stack([one, np.zeros(count)], 1).astype(np.float32)
    examples = policy.examples([Segment(seen, actions, "e", 0)])
    ones = torch.ones(count, 1)
    for number in range(40):
        optimizer.param_groups[0]["lr"] = 3e-3 if number < 25 else 5e-4
        batch = Batch(policy.redrawn(examples, rng), 0 * ones, ones)
        rows = torch.from_numpy(rng.permutation(count)).tensor_split(16)
        update(policy, optimizer, batch, rows, Objective(clip=None, value=0.0, entropy=0.0, max_grad_norm=1.0))
    return policy


def test_the_velocity_field_of_a_gaussian_target_is_the_closed_one(trained: FlowPolicy) -> None:
    """E[a - e | (1 - t) e + t a = x] of a ~ N(m, s^2) is m + (t s^2 - (1 - t)) (x - t m) / ((1 - t)^2 + t^2 s^2)."""
    m, s = 0.3, 0.2
    for t in (0.1, 0.4, 0.7):
        spread = np.sqrt((1 - t) ** 2 + t**2 * s**2)
        x = t * m + spread * np.linspace(-1.5, 1.5, 13)
        expected = m + (t * s**2 - (1 - t)) / spread**2 * (x - t * m)
        rows = np.stack([-np.ones(13), np.zeros(13), x, np.zeros(13)], 1)
        rows = np.concatenate([rows, np.cos(np.broadcast_to(WAVES * t, (13, len(WAVES))))], 1)
        with torch.no_grad():
            found = trained._net("velocity", torch.from_numpy(rows.astype(np.float32)))[:, 0].numpy()
        np.testing.assert_allclose(found, expected, atol=0.25)


def test_what_is_drawn_has_the_targets_modes_and_its_spread(trained: FlowPolicy) -> None:
    def drawn(side: float) -> Floats:
        seen = np.broadcast_to(np.array([side, 0.0], np.float32), (2000, 2))
        return trained.decide()(seen, np.random.default_rng(7), None, None)[1]

    one, two = drawn(-1.0)[:, 0], drawn(1.0)
    assert (one.mean(), one.std()) == pytest.approx((0.3, 0.2), abs=0.05)
    assert (np.abs(np.abs(two[:, 0]) - 0.8) < 0.2).mean() > 0.8
    assert (two[:, 0] > 0).mean() == pytest.approx(0.5, abs=0.1)
    assert np.abs(two[:, 1]).mean() < 0.1


def test_its_answers_without_chance_go_both_ways_over_many_observations(trained: FlowPolicy) -> None:
    """The same that is drawn from, from noise of the observation's own."""
    seen = np.stack([np.ones(300), np.linspace(-0.01, 0.01, 300)], 1).astype(np.float32)
    actions = trained.decide()(seen, None, None, None)[1]
    np.testing.assert_array_equal(trained.decide()(seen, None, None, None)[1], actions)
    assert 0.3 < (actions[:, 0] > 0).mean() < 0.7
    assert (np.abs(np.abs(actions[:, 0]) - 0.8) < 0.2).mean() > 0.8
