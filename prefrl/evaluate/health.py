"""What a round's numbers warn of."""

from __future__ import annotations

from collections.abc import Mapping

PATIENCE = 3
"""Rounds that a critic is given."""
FORESEEN = 0.05
"""The share of the returns' variance below which it explains nothing."""
OFTEN = 0.5
"""How many of the pairs, as a share, a judge may leave without a verdict."""
UNFAIR = 0.2
"""How much more than half a judge may give to what it is shown first, or last."""


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
    if metrics.get("improve/reward_std", 1.0) == 0:
        found["reward"] = (
            "the reward gave one score to all that was sampled in the round, so it taught nothing: look at the reward "
            "(is it constant?)"
        )
    elif metrics.get("improve/equal_groups", 0.0) == 1:
        found["reward"] = (
            "all candidates of each group (responses to a prompt, pictures for a caption) had one reward, in every "
            "group of the round: nothing was learned from it; look at the reward (is it constant?), or let groups be "
            "larger"
        )
    if (refused := metrics.get("label/refused", 0.0)) > OFTEN:
        found["refused"] = (
            f"the judge gave no verdict on {refused:.0%} of the round's pairs, so that their queries are skipped: it "
            "refuses, says something else, or comes too late; look at its model and criterion, and at "
            "labeler.timeout_seconds where it stands behind an address"
        )
    if abs(bias := metrics.get("label/position_bias", 0.0)) > UNFAIR:
        first = "first" if bias > 0 else "last"
        found["judge"] = (
            f"the judge prefers what it is shown {first}: asked in both orders, the one shown first gets "
            f"{0.5 + bias:.0%} on average, where half would be fair; its answers are means over both orders, and know "
            "little: try another judge, or other words"
        )
    return found
