"""Adam by torch's fused kernel, without what torch.optim puts around it.

Variant: AdamW (Loshchilov and Hutter 2019), which without weight decay is Adam (Kingma and Ba 2015, algorithm 1). The
numbers are torch.optim's to the bit, and so is the state. Left out: AMSGrad, hooks, closures, scaled gradients. For a
small network torch.optim takes several times as long as its kernel, and the first of its optimisers in a process loads
torch's compiler, which takes more than a second.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any, TypeAlias

import torch
from torch import Tensor

from prefrl.types import State

Group: TypeAlias = dict[str, Any]
"""Tensors, `params`, and what they learn with: `lr`, `betas`, `eps` and `weight_decay`."""
DEFAULTS = {"betas": (0.9, 0.999), "eps": 1e-8, "weight_decay": 0.0}


class Adam:
    """An optimiser of one or several groups of tensors; those without a gradient stay as they are."""

    def __init__(self, groups: Iterable[Mapping[str, Any]], learning_rate: float) -> None:
        """`groups` of `params`, and of what is not to be as in `DEFAULTS`."""
        self.param_groups: list[Group] = [DEFAULTS | {"lr": learning_rate} | dict(group) for group in groups]
        self._moments: dict[Tensor, dict[str, Tensor]] = {}

    def zero_grad(self) -> None:
        for parameter in self._parameters():
            parameter.grad = None

    @torch.no_grad()
    def step(self) -> None:
        for group in self.param_groups:
            for some in _alike([p for p in group["params"] if p.grad is not None]):
                self._step(some, group)

    def state_dict(self) -> State:
        """In torch.optim's form. Its tensors are live: the next step changes them."""
        numbers = {parameter: number for number, parameter in enumerate(self._parameters())}
        groups = [group | {"params": [numbers[p] for p in group["params"]]} for group in self.param_groups]
        return {"state": {numbers[p]: dict(m) for p, m in self._moments.items()}, "param_groups": groups}

    def load_state_dict(self, state: State) -> None:
        """Also one of torch.optim's Adam or AdamW. Steps will write into the tensors that are given."""
        parameters = self._parameters()
        for own, saved in zip(self.param_groups, state["param_groups"], strict=True):
            own |= {name: saved[name] for name in (*DEFAULTS, "lr")}
        self._moments = {
            parameters[number]: {name: x.to(parameters[number].device) for name, x in moments.items()}
            for number, moments in state["state"].items()
        }

    def _parameters(self) -> list[Tensor]:
        return [parameter for group in self.param_groups for parameter in group["params"]]

    def _step(self, some: list[Tensor], group: Group) -> None:
        moments = [self._moments.get(p) or self._first(p) for p in some]
        counts = [m["step"] for m in moments]
        torch._foreach_add_(counts, 1)
        slow, slower = group["betas"]
        torch._fused_adamw_(
            some,
            [p.grad for p in some],  # type: ignore[misc]  # `step` has chosen those that have one
            [m["exp_avg"] for m in moments],
            [m["exp_avg_sq"] for m in moments],
            [],
            counts,
            lr=group["lr"],
            beta1=slow,
            beta2=slower,
            weight_decay=group["weight_decay"],
            eps=group["eps"],
            amsgrad=False,
            maximize=False,
        )

    def _first(self, parameter: Tensor) -> dict[str, Tensor]:
        moments = {name: torch.zeros_like(parameter) for name in ("exp_avg", "exp_avg_sq")}
        self._moments[parameter] = {"step": torch.zeros((), device=parameter.device), **moments}
        return self._moments[parameter]


def _alike(tensors: list[Tensor]) -> list[list[Tensor]]:
    """Those of one device and one type together: the kernel takes no others at once."""
    found: dict[Any, list[Tensor]] = {}
    for tensor in tensors:
        found.setdefault((tensor.device, tensor.dtype), []).append(tensor)
    return list(found.values())
