"""Warnings from a round's numbers: each where it is due, and nowhere else."""

from __future__ import annotations

import math

import pytest

from prefrl.evaluate.health import warnings


@pytest.mark.parametrize(
    ("round", "metrics", "warned"),
    [
        (3, {"improve/explained": 0.01}, ["critic"]),
        (3, {"improve/explained": -0.5}, ["critic"]),
        (3, {"improve/explained": 0.3}, []),
        (2, {"improve/explained": 0.01}, []),  # it is still new
        (9, {"improve/explained": math.nan}, []),
        (1, {"improve/equal_groups": 1.0}, ["reward"]),
        (1, {"improve/equal_groups": 0.99}, []),
        (1, {"improve/equal_groups": 0.3, "improve/reward_std": 0.0}, ["reward"]),
        (1, {"improve/reward_std": 0.1}, []),
        (1, {"label/position_bias": 0.5}, ["judge"]),
        (1, {"label/position_bias": -0.3}, ["judge"]),
        (1, {"label/position_bias": 0.1}, []),
        (1, {"label/refused": 1.0}, ["refused"]),
        (1, {"label/refused": 0.2}, []),
        (9, {}, []),
    ],
)
def test_what_is_wrong_is_said(round: int, metrics: dict[str, float], warned: list[str]) -> None:
    assert list(warnings(round, metrics)) == warned


def test_equal_rewards_are_said_in_words_that_fit_pictures_too() -> None:
    said = warnings(1, {"improve/equal_groups": 1.0})["reward"]
    assert "all candidates of each group" in said
    assert "learner.responses" not in said
