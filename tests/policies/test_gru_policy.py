"""A policy with a memory: chunks say what single steps say, and an episode's start forgets."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from prefrl.envs.control import ControlSettings
from prefrl.envs.toys import TMazeSettings
from prefrl.improve import control
from prefrl.improve.control import ControlLearner, ControlLearnerSettings
from prefrl.policies.acting import Acting, forgotten, in_chunks
from prefrl.policies.gru import GRUPolicy, GRUPolicySettings
from prefrl.policies.heads import density
from prefrl.policies.loaded import Loaded
from prefrl.policies.rollout import Rollout, collect
from prefrl.protocols import ControlTask
from prefrl.types import Floats

PENDULUM = ControlSettings(env="Pendulum-v1", hide=(2,), horizon=10, segment_steps=3).build()
MAZE = TMazeSettings(length=6).build()
TASKS: dict[str, ControlTask] = {"box": PENDULUM, "discrete": MAZE}


def made(task: ControlTask, chunk: int = 4) -> GRUPolicy:
    """Some way from its start, so that outputs differ from step to step."""
    policy = GRUPolicySettings(width=5, hidden=6, chunk=chunk).build(task, np.random.default_rng(0))
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.data += 0.3 * torch.randn(parameter.shape, generator=generator)
    policy.observe(np.random.default_rng(2).normal(0.1, 0.7, (50, task.observation_size)))
    return policy


def two_rollouts(policy: GRUPolicy, task: ControlTask) -> tuple[Rollout, Floats]:
    """The second of two rollouts of 17 steps that follow one another, and what was remembered where it begins."""
    envs, act = task.environments(3), Acting(policy.decide(), np.random.default_rng(4))
    first, observations = collect(envs, envs.reset(np.random.default_rng(3)), 17, act)
    begins = first.ends[:, -1]
    memory = forgotten(act.memory, begins)
    assert memory is not None
    return collect(envs, observations, 17, act, begins)[0], memory


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("chunk", [4, 17, 50])
def test_chunks_say_what_a_pass_step_by_step_says(name: str, chunk: int) -> None:
    """Log-probabilities, entropies, values, and values of final observations; episodes end within chunks."""
    task = TASKS[name]
    policy = made(task, chunk)
    rollout, memory = two_rollouts(policy, task)
    asked = rollout.ends | (np.arange(17) == 16)
    reading = policy.read(rollout, memory, asked)
    logp, entropies, values = policy.log_prob_and_values(reading.inputs)
    p, normalise = policy.named(), policy.normaliser.now()

    def said(net: int, name: str, state: torch.Tensor) -> torch.Tensor:
        return (
            torch.tanh(state @ p["hidden_weight"][net] + p["hidden_bias"][net, 0]) @ p[f"{name}_weight"]
            + p[f"{name}_bias"]
        )

    def step(state: torch.Tensor, observation: Floats, net: int) -> torch.Tensor:
        cell = torch.nn.GRUCell(task.observation_size, 5)
        weights = {"weight_ih": p["input_weight"], "weight_hh": p["state_weight"]}
        biases = {"bias_ih": p["input_bias"], "bias_hh": p["state_bias"]}
        named = {k: x[net].T for k, x in weights.items()} | {k: x[net, 0] for k, x in biases.items()}
        found: torch.Tensor = torch.func.functional_call(cell, named, (torch.from_numpy(normalise(observation)), state))
        return found

    mask, finals = reading.inputs.mask, list[float]()
    for row in range(3):
        states = [torch.from_numpy(memory[row, :5]), torch.from_numpy(memory[row, 5:])]
        for t in range(17):
            if t and rollout.ends[row, t - 1]:
                states = [torch.zeros(5), torch.zeros(5)]
            states = [step(states[net], rollout.observations[row, t], net) for net in (0, 1)]
            choice = torch.from_numpy(rollout.choices[row, t])
            expected = density(said(0, "actor", states[0]), choice, p.get("log_std"), None)
            at = row * (-(-17 // chunk)) + t // chunk, t % chunk
            assert mask[at]
            assert float(logp[at].detach()) == pytest.approx(float(expected[0].detach()), abs=1e-5, rel=1e-5)
            assert float(entropies[at].detach()) == pytest.approx(float(expected[1].detach()), abs=1e-5)
            value = float(said(1, "critic", states[1]).detach())
            assert float(values[at].detach()) == pytest.approx(value, abs=1e-5)
            assert float(reading.values[row, t]) == pytest.approx(value, abs=1e-5)
            if asked[row, t]:
                later = step(states[1], rollout.final_observations[row, t], 1)
                finals.append(float(said(1, "critic", later).detach()))
    assert reading.final.tolist() == pytest.approx(finals, abs=1e-5)
    assert int(mask.sum()) == 3 * 17
    assert not logp[~mask].any()
    assert not entropies[~mask].any()


def test_the_parts_of_the_networks_alone_say_the_same_and_so_do_some_rows() -> None:
    policy = made(MAZE)
    inputs = policy.read(*two_rollouts(policy, MAZE), np.zeros((3, 17), bool)).inputs
    logp, entropies, values = policy.log_prob_and_values(inputs)
    for one, other in zip(policy.log_prob(inputs), (logp, entropies), strict=True):
        torch.testing.assert_close(one, other)
    torch.testing.assert_close(policy.values(inputs), values)
    some = torch.tensor([7, 2])
    for one, whole in zip(policy.log_prob_and_values(inputs.rows(some)), (logp, entropies, values), strict=True):
        torch.testing.assert_close(one, whole[some])


def test_acting_forgets_where_an_episode_begins_and_nowhere_else() -> None:
    decide, rng = made(PENDULUM).decide(), np.random.default_rng(0)
    act, observations = Acting(decide, None), rng.normal(size=(4, 2)).astype(np.float32)
    fresh, _ = act(observations, None, np.ones(4, bool))
    act(-observations, None, np.zeros(4, bool))
    begins = np.array([True, False, True, False])
    again, _ = act(observations, None, begins)
    np.testing.assert_allclose(again[begins], fresh[begins], atol=1e-6)
    assert np.abs(again - fresh)[~begins].min() > 1e-4


def test_a_loaded_policy_takes_its_memory_back_as_those_of_stable_baselines3_do() -> None:
    task = PENDULUM
    settings = ControlLearnerSettings(policy=GRUPolicySettings(width=5, hidden=6, chunk=4))
    learner = settings.build(task, np.random.default_rng(0))
    learner.policy.load(made(task).state())
    policy = Loaded(learner.actor(), task.observation_size, task.action_size, task.action_bounds is None)
    first, state = policy.predict([0.1, 0.2])
    second, state = policy.predict([0.1, 0.2], state)
    third, _ = policy.predict([0.1, 0.2], state, episode_start=[True])
    assert first.shape == (1,)
    assert second != first
    assert third == first


def test_new_statistics_do_not_change_what_the_policy_does() -> None:
    policy, rng = made(PENDULUM), np.random.default_rng(5)
    observations = rng.normal(0.1, 0.5, (20, 2)).astype(np.float32)
    before = policy.decide()(observations, None, None, None)
    policy.observe(rng.normal(0.5, 0.6, (20, 2)))
    for one, other in zip(before, policy.decide()(observations, None, None, None), strict=True):
        assert one is not None
        assert other is not None
        np.testing.assert_allclose(one, other, atol=1e-5)


def test_rows_are_cut_from_their_start_and_padded_at_their_end() -> None:
    found = in_chunks(torch.arange(10).view(2, 5), 3)
    assert found.tolist() == [[0, 1, 2], [3, 4, 0], [5, 6, 7], [8, 9, 0]]
    assert in_chunks(torch.arange(10).view(2, 5), 1).flatten().tolist() == list(range(10))


def learned(policy: dict[str, Any], rounds: int, monkeypatch: pytest.MonkeyPatch, seed: int) -> float:
    """The gold of a T-maze of 5 steps, learned from the gold itself."""
    monkeypatch.setattr(control, "step_rewards", lambda reward: reward)
    monkeypatch.setattr(control, "learned_rewards", lambda reward, rollout: rollout.gold)
    settings = {"environments": 16, "steps_per_round": 1600, "rollout_steps": 50, "evaluation_episodes": 40}
    learner: ControlLearner = ControlLearnerSettings.model_validate(
        settings | {"policy": policy, "critic_epochs": 0, "learning_rate": 3e-3, "minibatch": 200}
    ).build(TMazeSettings(length=5).build(), np.random.default_rng(seed))
    nothing: Any = None
    for number in range(rounds):
        metrics = learner.improve(nothing, nothing, np.random.default_rng([seed, number]))
        assert metrics["ratio_error"] < 1e-4
    task: ControlTask = learner._task
    rollout, _ = collect(envs := task.environments(40), envs.reset(np.random.default_rng(9)), 5, learner._act(None))
    return float(rollout.gold.sum(1).mean())


@pytest.mark.slow
def test_who_remembers_gets_out_of_a_maze(monkeypatch: pytest.MonkeyPatch) -> None:
    remembering = learned({"kind": "gru", "chunk": 5, "width": 16, "hidden": 16}, 12, monkeypatch, 0)
    assert remembering == pytest.approx(1.0)
    assert learned({"kind": "mlp"}, 12, monkeypatch, 0) < 0.75
