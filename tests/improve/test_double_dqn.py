"""Double DQN: its target by hand, and DQN's own step where both networks agree."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import torch
from stable_baselines3 import DQN
from stable_baselines3.common.vec_env import DummyVecEnv

from prefrl.improve.double_dqn import DoubleDQN


def test_the_network_that_learns_chooses_the_next_action_and_its_target_says_its_worth() -> None:
    model = _model(DoubleDQN)
    model.q_net = _says([[1.0, 2.0], [5.0, 0.0], [1.0, 2.0]])
    model.q_net_target = _says([[30.0, 10.0], [40.0, 90.0], [7.0, 7.0]])
    batch = SimpleNamespace(
        next_observations=torch.zeros(3, 4), rewards=torch.ones(3, 1), dones=torch.tensor([[0.0], [0.0], [1.0]])
    )
    batch.discounts = None
    assert model.targets(batch).flatten().tolist() == [1 + 0.5 * 10, 1 + 0.5 * 40, 1]  # DQN: 1 + 0.5 * 30, 0.5 * 90
    batch.discounts = torch.full((3, 1), 0.25)
    assert model.targets(batch).flatten().tolist() == [1 + 0.25 * 10, 1 + 0.25 * 40, 1]


def test_where_both_networks_are_the_same_it_makes_the_steps_of_dqn() -> None:
    weights = []
    for kind in (DQN, DoubleDQN):
        model = _model(kind).learn(40)
        model.q_net_target = model.q_net
        torch.manual_seed(0), np.random.seed(0)
        model.train(gradient_steps=1, batch_size=8)
        weights.append(torch.cat([p.flatten() for p in model.q_net.parameters()]))
    torch.testing.assert_close(weights[0], weights[1], rtol=0, atol=0)


def _model(kind: type[DQN]) -> Any:
    import gymnasium

    env = DummyVecEnv([lambda: gymnasium.make("CartPole-v1")])
    small = {"net_arch": [4]}
    return kind(
        "MlpPolicy", env, policy_kwargs=small, gamma=0.5, buffer_size=50, learning_starts=40, seed=0, device="cpu"
    )


def _says(values: list[list[float]]) -> Any:
    return lambda _: torch.tensor(values)
