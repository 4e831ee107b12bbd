"""Recurrent networks: chunks say what single steps say."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from remembering_policies import TASKS, made, two_rollouts

from prefrl.envs.toys import TMazeSettings
from prefrl.improve import control
from prefrl.improve.control import ControlLearner, ControlLearnerSettings
from prefrl.policies.heads import density
from prefrl.policies.rollout import collect
from prefrl.protocols import ControlTask
from prefrl.types import Floats


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


def learned(policy: dict[str, Any], rounds: int, monkeypatch: pytest.MonkeyPatch, rate: float) -> float:
    """The gold of a T-maze of 5 steps, learned from the gold itself."""
    monkeypatch.setattr(control, "step_rewards", lambda reward: reward)
    monkeypatch.setattr(control, "learned_rewards", lambda reward, rollout: rollout.gold)
    settings: dict[str, Any] = {"environments": 16, "steps_per_round": 1600, "rollout_steps": 50}
    settings |= {"evaluation_episodes": 40, "target_kl": None, "entropy": 0.03}
    learner: ControlLearner = ControlLearnerSettings.model_validate(
        settings | {"policy": policy, "critic_epochs": 0, "learning_rate": rate, "minibatch": 200}
    ).build(TMazeSettings(length=5).build(), np.random.default_rng(0))
    nothing: Any = None
    for number in range(rounds):
        metrics = learner.improve(nothing, nothing, np.random.default_rng([0, number]))
        assert metrics["ratio_error"] < 1e-4
    task: ControlTask = learner._task
    rollout, _ = collect(envs := task.environments(40), envs.reset(np.random.default_rng(9)), 5, learner._act(None))
    return float(rollout.gold.sum(1).mean())


@pytest.mark.slow
def test_who_remembers_gets_out_of_a_maze(monkeypatch: pytest.MonkeyPatch) -> None:
    small = {"chunk": 5, "width": 16, "hidden": 16}
    attentive = {"kind": "transformer", "context": 5, "heads": 2}
    assert learned({"kind": "gru"} | small, 12, monkeypatch, 3e-3) == pytest.approx(1.0)
    assert learned(attentive | small, 12, monkeypatch, 1e-3) == pytest.approx(1.0)
    assert learned({"kind": "mlp"}, 12, monkeypatch, 3e-3) < 0.75
