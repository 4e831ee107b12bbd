"""What a language model is expected to score, token by token: the critic of PPO.

Variant: one linear layer on the hidden state that predicts a token, so a value is of what stands before its token. The
states are the policy's own, whose trunk then learns from both losses, or those of a network that starts as a copy of
the policy and learns from the critic's alone.
"""

from __future__ import annotations

import torch
from torch import Tensor
from transformers import PreTrainedModel

from prefrl.policies.logprobs import Shortcuts, response_states
from prefrl.policies.responses import Responses


class Critic(torch.nn.Module):
    """A value for each token of a response; 0 everywhere at first."""

    def __init__(self, width: int, trunk: PreTrainedModel | None, shortcuts: Shortcuts) -> None:
        """`width`: of the hidden states; `trunk`: the network they come from, None for the policy's own."""
        super().__init__()
        self.head = torch.nn.Linear(width, 1)
        torch.nn.init.zeros_(self.head.weight)
        torch.nn.init.zeros_(self.head.bias)
        self.trunk = trunk
        self._shortcuts = shortcuts

    def forward(self, model: PreTrainedModel, responses: Responses) -> Tensor:
        """(B, L) values, 0 on padding; `model` is run where there is no trunk of its own."""
        states = response_states(self.trunk or model, responses, self._shortcuts)
        return self.of_states(states, responses.mask)

    def of_states(self, states: Tensor, mask: Tensor) -> Tensor:
        """(n, d) states that predict the n real tokens, row by row -> (B, L) values."""
        found: Tensor = self.head(states.float()).squeeze(-1)
        return found.new_zeros(mask.shape).masked_scatter(mask, found)
