"""Policies with a memory, of every kind: the update says what acting said, and an episode's start forgets."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from remembering_policies import KINDS, MAZE, PENDULUM, TASKS, made, two_rollouts

from prefrl.improve.control import ControlLearnerSettings
from prefrl.policies.acting import Acting, forgotten, in_chunks
from prefrl.policies.heads import density
from prefrl.policies.loaded import Loaded
from prefrl.policies.normaliser import CLIP, Normaliser
from prefrl.types import Segment


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("chunk", [4, 50])
@pytest.mark.parametrize("kind", KINDS)
def test_the_update_begins_with_the_log_probabilities_of_acting(kind: str, name: str, chunk: int) -> None:
    """Step by step, with what acting carries along; episodes end within chunks."""
    task = TASKS[name]
    policy = made(task, chunk, kind)
    rollout, memory = two_rollouts(policy, task)
    inputs = policy.read(rollout, memory, np.zeros((3, 17), bool)).inputs
    p, step = policy.named(), policy._networks.acting(policy.normaliser.now())
    recorded = []
    for t in range(17):
        before = forgotten(memory, rollout.ends[:, t - 1]) if t else memory
        assert before is not None
        features, memory = step(rollout.observations[:, t], before)
        outputs = torch.from_numpy(features) @ p["actor_weight"] + p["actor_bias"]
        recorded.append(density(outputs, torch.from_numpy(rollout.choices[:, t]), p.get("log_std"), None)[0])
    torch.testing.assert_close(policy.log_prob(inputs)[0], in_chunks(torch.cat(recorded, 1), chunk), atol=1e-5, rtol=0)


@pytest.mark.parametrize("kind", KINDS)
def test_the_parts_of_the_networks_alone_say_the_same_and_so_do_some_rows(kind: str) -> None:
    policy = made(MAZE, kind=kind)
    inputs = policy.read(*two_rollouts(policy, MAZE), np.zeros((3, 17), bool)).inputs
    logp, entropies, values = policy.log_prob_and_values(inputs)
    for one, other in zip(policy.log_prob(inputs), (logp, entropies), strict=True):
        torch.testing.assert_close(one, other)
    torch.testing.assert_close(policy.values(inputs), values)
    some = torch.tensor([7, 2])
    for one, whole in zip(policy.log_prob_and_values(inputs.rows(some)), (logp, entropies, values), strict=True):
        torch.testing.assert_close(one, whole[some])


@pytest.mark.parametrize("kind", KINDS)
def test_acting_forgets_where_an_episode_begins_and_nowhere_else(kind: str) -> None:
    decide, rng = made(PENDULUM, kind=kind).decide(), np.random.default_rng(0)
    act, observations = Acting(decide, None), rng.normal(size=(4, 2)).astype(np.float32)
    fresh, _ = act(observations, None, np.ones(4, bool))
    act(-observations, None, np.zeros(4, bool))
    begins = np.array([True, False, True, False])
    again, _ = act(observations, None, begins)
    np.testing.assert_allclose(again[begins], fresh[begins], atol=1e-6)
    assert np.abs(again - fresh)[~begins].min() > 1e-4


@pytest.mark.parametrize("kind", KINDS)
def test_a_loaded_policy_takes_its_memory_back_as_those_of_stable_baselines3_do(kind: str) -> None:
    task = PENDULUM
    settings = ControlLearnerSettings(policy=KINDS[kind])
    learner = settings.build(task, np.random.default_rng(0))
    learner.policy.load(made(task, kind=kind).state())
    policy = Loaded(learner.actor(), task.observation_size, task.action_size, task.action_bounds)
    first, state = policy.predict([0.1, 0.2])
    second, state = policy.predict([0.1, -0.2], state)
    third, _ = policy.predict([0.1, 0.2], state)
    fourth, _ = policy.predict([0.1, 0.2], state, episode_start=[True])
    assert first.shape == (1,)
    assert len({float(x[0]) for x in (first, second, third)}) == 3
    assert fourth == first


@pytest.mark.parametrize("kind", KINDS)
def test_new_statistics_do_not_change_what_the_policy_does(kind: str) -> None:
    policy, rng = made(PENDULUM, kind=kind), np.random.default_rng(5)
    observations = rng.normal(0.1, 0.5, (20, 2)).astype(np.float32)
    _, _, memory = policy.decide()(-observations, None, None, None)
    before = policy.decide()(observations, None, None, memory)
    policy.observe(rng.normal(0.5, 0.6, (20, 2)))
    for one, other in zip(before, policy.decide()(observations, None, None, memory), strict=True):
        assert one is not None
        assert other is not None
        np.testing.assert_allclose(one, other, atol=1e-5)


def test_an_input_that_never_changed_is_not_blown_up_and_what_follows_it_stays_the_same() -> None:
    """Of such an input a critic knows nothing; each new share of it is folded into the first layers."""
    calm, plain = Normaliser(1, calm=True), Normaliser(1)
    never, seldom = np.zeros((100, 1)), np.eye(1, 100).T
    for one in (calm, plain):
        one.observe(never)
    seen = np.ones((1, 1), np.float32)
    assert [float(one.now()(seen)[0, 0]) for one in (calm, plain)] == [1.0, CLIP]
    move = calm.observe(seldom)
    assert move is not None
    assert float((calm.now()(seen) * move.ratio + move.shift)[0, 0]) == pytest.approx(
        min(1.0, CLIP / calm.scale[0]), abs=0.01
    )
    for _ in range(5):
        before = calm.now()(seen) if calm.scale[0] < CLIP else None
        move = calm.observe(np.repeat([[0.0], [1.0]], 40, 0))
        assert move is not None
        if before is not None:
            np.testing.assert_allclose(calm.now()(seen) * move.ratio + move.shift, before, atol=1e-5)


def test_rows_are_cut_from_their_start_and_padded_at_their_end() -> None:
    found = in_chunks(torch.arange(10).view(2, 5), 3)
    assert found.tolist() == [[0, 1, 2], [3, 4, 0], [5, 6, 7], [8, 9, 0]]
    assert in_chunks(torch.arange(10).view(2, 5), 1).flatten().tolist() == list(range(10))


@pytest.mark.parametrize("kind", KINDS)
def test_demonstrations_are_read_in_pieces_as_the_policy_would_have_acted(kind: str) -> None:
    """Of what it does itself every action has the density of the mode, whatever it remembers from earlier pieces."""
    policy = made(PENDULUM, kind=kind)
    seen = np.random.default_rng(6).normal(0.1, 0.2, (17, 3, PENDULUM.observation_size)).astype(np.float32)
    act, none = Acting(policy.decide(), None), np.zeros(3, bool)
    actions = np.stack([act(step, None, none)[1] for step in seen])
    shown = [Segment(seen[:n, i], actions[:n, i], episode=f"{i}", start=0) for i, n in enumerate((17, 8, 3))]
    examples = policy.examples(shown)
    assert examples.mask.sum(1).tolist() == [4, 4, 4, 4, 1, 4, 4, 3]  # pieces of 4 steps
    drawn = policy.redrawn(examples, np.random.default_rng(0))
    logp = policy.with_std_kept().log_prob(drawn)[0][drawn.mask]
    assert np.abs(actions).max() < 2  # none was cut off at the bounds
    torch.testing.assert_close(logp, torch.full_like(logp, policy.with_std_kept().ceiling), atol=1e-4, rtol=0)
    forgetful = policy.log_prob(examples)[0]
    assert torch.equal(forgetful[5], policy.log_prob(drawn)[0][5])  # where a segment begins
    assert (forgetful[6] < logp.min() - 1e-3).any()
    # Weights that have moved remember otherwise.
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.data += 0.1
    again = policy.redrawn(examples, np.random.default_rng(0)).known
    assert (kind == "transformer") == torch.equal(again, drawn.known)  # which remembers observations
