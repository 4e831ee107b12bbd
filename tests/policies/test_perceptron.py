"""The hand-written gradient is the one that automatic differentiation finds."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import pytest
import torch
from torch import Tensor

from prefrl.policies import perceptron
from prefrl.policies.perceptron import perceptrons

REFERENCES: dict[str, Any] = {"tanh": torch.tanh, "relu": torch.relu, "silu": torch.nn.functional.silu}
EACH = pytest.mark.parametrize("activation", REFERENCES)


def _layers(members: int, sizes: tuple[int, ...]) -> tuple[list[Tensor], list[Tensor]]:
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64).requires_grad_()

    pairs = list(pairwise(sizes))
    return [normal(members, i, o) for i, o in pairs], [normal(members, 1, o) for _, o in pairs]


def _reference(x: Tensor, weights: list[Tensor], biases: list[Tensor], activation: str) -> Tensor:
    x = x.expand(len(weights[0]), -1, -1)
    for weight, bias in zip(weights[:-1], biases[:-1], strict=True):
        x = REFERENCES[activation](x @ weight + bias)
    return (x @ weights[-1] + biases[-1])[..., 0]


@EACH
@pytest.mark.parametrize("shape", [(7, 3), (2, 7, 3)], ids=["shared", "own"])
@pytest.mark.parametrize("numbers", [10, 1_000_000], ids=["in pieces", "at once"])
def test_outputs_and_gradients_are_those_of_automatic_differentiation(
    activation: Any, shape: tuple[int, ...], numbers: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(perceptron, "NUMBERS", numbers)
    weights, biases = _layers(2, (3, 5, 4, 1))
    x = torch.randn(shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64).requires_grad_()
    ours, theirs = perceptrons(x, weights, biases, activation), _reference(x, weights, biases, activation)
    torch.testing.assert_close(ours, theirs)
    with torch.no_grad():
        torch.testing.assert_close(perceptrons(x, weights, biases, activation), theirs)
    every, direction = [x, *weights, *biases], torch.arange(ours.numel(), dtype=torch.float64).view_as(ours)
    found = torch.autograd.grad(ours, every, direction)
    for one, other in zip(found, torch.autograd.grad(theirs, every, direction), strict=True):
        torch.testing.assert_close(one, other)


@EACH
def test_inputs_that_need_no_gradient_get_none_and_parameters_the_same(activation: Any) -> None:
    weights, biases = _layers(3, (2, 6, 1))
    x = torch.randn(5, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    parameters = [*weights, *biases]
    found = torch.autograd.grad(perceptrons(x, weights, biases, activation).square().sum(), parameters)
    wanted = torch.autograd.grad(_reference(x, weights, biases, activation).square().sum(), parameters)
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, other)


def test_numerical_differentiation_agrees() -> None:
    weights, biases = _layers(2, (2, 3, 1))
    x = torch.randn(4, 2, generator=torch.Generator().manual_seed(1), dtype=torch.float64).requires_grad_()
    assert torch.autograd.gradcheck(lambda x, *p: perceptrons(x, p[:2], p[2:], "tanh"), [x, *weights, *biases])
