"""What a round's numbers warn of."""

from __future__ import annotations

from collections.abc import Mapping

PATIENCE = 3
"""Rounds that a critic is given."""
FORESEEN = 0.05
"""The share of the returns' variance below which it explains nothing."""


def warnings(round: int, metrics: Mapping[str, float]) -> dict[str, str]:
    """Name -> what is wrong, and what to do about it; from a round's metrics, as `metrics.jsonl` has them.

    What was not measured, or is NaN, warns of nothing.
    """
    found = {}
    explained = metrics.get("improve/explained", 1.0)
    if round >= PATIENCE and explained < FORESEEN:
        found["critic"] = (
            f"after {round} rounds the critic explains {explained:.0%} of the returns' variance, which is hardly more "
            "than a constant would: let it learn more from each batch, or choose an algorithm without a critic"
        )
    if metrics.get("improve/equal_groups", 0.0) == 1:
        found["reward"] = (
            "all responses to a prompt had one reward, for every prompt of the round: nothing was learned from it; "
            "look at the reward (is it constant?), or raise learner.responses"
        )
    return found
