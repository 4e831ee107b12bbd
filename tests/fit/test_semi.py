import math

import pytest
import torch

from prefrl.components import ConfigError
from prefrl.fit.semi import crop, pairs, pseudo_loss
from prefrl.types import Response


def test_pairs_are_of_one_context_and_count_from_where_they_are_told() -> None:
    candidates = [Response("p", "a"), Response("q", "b"), Response("p", "c"), Response("r", "d")]
    found = pairs(candidates, 10, 50, torch.Generator().manual_seed(0))
    assert found.shape == (50, 2)
    assert {frozenset(row) for row in found.tolist()} == {frozenset((10, 12))}
    assert pairs(candidates[:2], 0, 5, torch.Generator()).shape == (0, 2)


def test_only_sure_pairs_are_labelled_and_the_mean_is_over_all() -> None:
    scores = torch.tensor([[5.0, 0.0, 0.1]], requires_grad=True)
    loss = pseudo_loss(scores, torch.tensor([[1, 0], [1, 2]]), 0.95)
    assert loss.item() == pytest.approx(math.log1p(math.exp(-5)) / 2, rel=1e-5)
    loss.backward()  # type: ignore[no-untyped-call]
    assert scores.grad is not None
    assert scores.grad[0, 2] == 0
    assert scores.grad[0, 0] < 0 < scores.grad[0, 1]


def test_members_learn_from_the_label_of_all() -> None:
    scores = torch.tensor([[9.0, 0.0], [-0.5, 0.0], [9.0, 0.0]], requires_grad=True)
    pseudo_loss(scores, torch.tensor([[0, 1]]), 0.7).backward()  # type: ignore[no-untyped-call]
    assert scores.grad is not None
    assert scores.grad[1, 0] < -0.5


def test_a_crop_is_a_window_of_each_row_of_one_length() -> None:
    steps = torch.arange(20.0).expand(6, 20)
    order = torch.Generator().manual_seed(0)
    lengths = set()
    for _ in range(40):
        found = crop({"inputs": steps[..., None].clone(), "mask": torch.ones(6, 20), "again": steps}, 0.3, order)
        inputs = found["inputs"][..., 0]
        lengths.add(inputs.shape[1])
        assert (inputs.diff(dim=1) == 1).all()
        torch.testing.assert_close(inputs, found["again"])
    assert lengths == set(range(14, 21))


def test_a_crop_shows_no_padding_where_there_are_steps_enough() -> None:
    mask = (torch.arange(20) < torch.tensor([[20], [12], [3]])).float()
    order = torch.Generator().manual_seed(0)
    for _ in range(40):
        found = crop({"inputs": mask[..., None], "mask": mask}, 0.9, order)["mask"]
        size = torch.full((3,), float(found.shape[1]))
        torch.testing.assert_close(found.sum(1), size.minimum(torch.tensor([20.0, 12.0, 3.0])))


def test_texts_are_not_cropped() -> None:
    with pytest.raises(ConfigError, match="only segments can be cropped"):
        crop({"tokens": torch.zeros(2, 3)}, 0.2, torch.Generator())
