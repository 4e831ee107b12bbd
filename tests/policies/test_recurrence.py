"""Recurrent units by hand: the states and the gradients of automatic differentiation."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from prefrl.policies.recurrence import differentiable, recurrence

L, E, B, H = 7, 2, 5, 4


def arguments() -> list[Tensor]:
    """Gates, start, weight and bias; in float64, so that nothing else than the formula counts."""
    generator, shapes = torch.Generator().manual_seed(0), ((L, E, B, 3 * H), (E, B, H), (E, H, 3 * H), (E, 1, 3 * H))
    return [torch.randn(s, generator=generator, dtype=torch.float64).requires_grad_() for s in shapes]


def of(given: list[Tensor], function: Callable[..., Tensor], begins: Tensor) -> Tensor:
    return function(*given, begins)


def test_states_and_gradients_are_those_of_automatic_differentiation() -> None:
    generator = torch.Generator().manual_seed(1)
    begins = torch.rand(L, B, generator=generator) < 0.2
    assert begins.any()
    direction, found = torch.randn(L, E, B, H, generator=generator, dtype=torch.float64), []
    for function in (recurrence, differentiable):
        given = arguments()
        states = of(given, function, begins)
        (states * direction).sum().backward()  # type: ignore[no-untyped-call]
        found.append([states.detach(), *(x.grad for x in given)])
    for ours, theirs in zip(*found, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-10, atol=1e-10)


def test_it_is_the_unit_of_torch() -> None:
    gates, start, weight, bias = arguments()
    theirs = torch.nn.GRU(3 * H, H, dtype=torch.float64)
    with torch.no_grad():
        own = {"weight_ih_l0": torch.eye(3 * H), "bias_ih_l0": torch.zeros(3 * H)}
        own |= {"weight_hh_l0": weight[0].T, "bias_hh_l0": bias[0, 0]}
        for name, parameter in theirs.named_parameters():
            parameter.copy_(own[name])
    expected = theirs(gates[:, 0], start[:1])[0]
    found = recurrence(gates, start, weight, bias, torch.zeros(L, B, dtype=torch.bool))[:, 0]
    torch.testing.assert_close(found, expected, rtol=1e-10, atol=1e-10)
