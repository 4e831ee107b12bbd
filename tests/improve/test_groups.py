from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from prefrl.improve.groups import Weighing, by_group, check_ratio, finite, kl_advantages, minibatches, rewarded

DEVICE = torch.tensor(0.0).device
ALL = torch.ones(4, 2, dtype=torch.bool)


def test_the_kl_of_all_steps_is_taken_off_the_score_before_the_baseline() -> None:
    kl = torch.tensor([[0.1, 0.3], [0.0, 0.0], [0.2, 0.2], [0.5, 0.5]])
    scores = torch.tensor([1.0, 2.0, 3.0, 5.0])
    found = by_group(scores, kl, ALL, 2, Weighing("leave_one_out", "reward", 0.5))
    torch.testing.assert_close(found, torch.tensor([[-1.2, 1.2], [-1.7, 1.7]]))
    elsewhere = by_group(scores, kl, ALL, 2, Weighing("leave_one_out", "loss", 0.5))
    torch.testing.assert_close(elsewhere, torch.tensor([[-1.0, 1.0], [-2.0, 2.0]]))


def test_the_kl_of_what_was_not_scored_teaches_nothing() -> None:
    """However far such a one is from the start: it has no advantage, and is in no baseline."""
    kl = torch.tensor([[0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [9.0, 9.0]])
    scores = torch.tensor([1.0, 1.0, 1.0, math.nan])
    for place in ("reward", "advantage"):
        found = by_group(scores, kl, ALL, 4, Weighing("group_normalised", place, 0.5))
        assert torch.equal(found, torch.zeros(1, 4))
    kls = torch.tensor([[1.0, 3.0, math.nan]])
    found = torch.as_tensor(kl_advantages(kls, Weighing("group_normalised", "advantage", 0.5)))
    torch.testing.assert_close(found, torch.tensor([[-1.0, 1.0, 0.0]]))


def test_each_epoch_has_all_rows_once_in_another_order() -> None:
    parts = minibatches(10, 2, 3, np.random.default_rng(0), DEVICE)
    assert [len(part) for part in parts] == [4, 4, 2] * 2
    first, second = torch.cat(parts[:3]), torch.cat(parts[3:])
    assert first.sort().values.tolist() == second.sort().values.tolist() == list(range(10))
    assert not torch.equal(first, second)


def test_what_is_wrong_with_a_batch_is_told() -> None:
    with pytest.raises(FloatingPointError, match="the reward of update 7 is not finite"):
        finite("reward", torch.tensor([1.0, math.inf]), 7)
    with pytest.raises(FloatingPointError, match=r"update 7: .*ratio off by 0.5\); do this, and report it"):
        check_ratio(0.5, 0.4, 7, "do this")
    check_ratio(0.4, 0.4, 7, "do this")


def test_rewards_are_means_over_what_was_scored() -> None:
    raw = torch.tensor([1.0, 3.0, math.nan])
    assert rewarded(raw, torch.tensor([1.0, math.nan, math.nan])) == {
        "reward": 2.0,
        "reward_std": 1.0,
        "unscored": pytest.approx(2 / 3),
    }
