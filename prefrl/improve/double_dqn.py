"""Double DQN (van Hasselt et al. 2016): what learns chooses the next action, and its target says what that is worth.

Variant: stable-baselines3's DQN but for the target, y = r + gamma Q_target(s', argmax_a Q(s', a)) (their equation 4).
DQN takes the highest of Q_target(s', a), and so the highest of its errors: its values run high. What has been learned
acts and is saved as DQN's is, and `DQN.load` reads it. What is left out: prioritised replay and duelling networks.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from stable_baselines3 import DQN
from torch.nn.functional import smooth_l1_loss
from torch.nn.utils import clip_grad_norm_


class DoubleDQN(DQN):  # type: ignore[misc]  # its types are unknown
    """DQN of stable-baselines3 with another target, for which it has no setting: hence a subclass."""

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """Make `gradient_steps` steps of Adam, each on `batch_size` replayed steps."""
        self.policy.set_training_mode(True)
        self._update_learning_rate(self.policy.optimizer)
        losses = [self._step(batch_size) for _ in range(gradient_steps)]
        self._n_updates += gradient_steps
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        self.logger.record("train/loss", np.mean(losses))

    def _step(self, batch_size: int) -> float:
        assert self.replay_buffer is not None
        batch = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
        found = self.q_net(batch.observations).gather(1, batch.actions.long())
        loss = smooth_l1_loss(found, self.targets(batch))
        self.policy.optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        clip_grad_norm_(self.policy.parameters(), self.max_grad_norm)
        self.policy.optimizer.step()
        return float(loss.detach())

    @torch.no_grad()
    def targets(self, batch: Any) -> torch.Tensor:
        """(B, 1) values that those of the actions taken should have; `batch` is the replay buffer's."""
        best = self.q_net(batch.next_observations).argmax(1, keepdim=True)
        worth = self.q_net_target(batch.next_observations).gather(1, best)
        # Sums of rewards over n steps are followed by the discount to the power of n.
        discounts = self.gamma if batch.discounts is None else batch.discounts
        after: torch.Tensor = batch.rewards + (1 - batch.dones) * discounts * worth
        return after
