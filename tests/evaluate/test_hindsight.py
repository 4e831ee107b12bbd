"""All rounds by the newest reward."""

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from prefrl.evaluate import hindsight as module
from prefrl.evaluate.hindsight import hindsight, keep, read
from prefrl.protocols import RewardModel
from prefrl.stats.intervals import average
from prefrl.types import Response, Segment


class Sum:
    """Scores a segment by the sum of its observations, and a response by its length."""

    fitted = True

    def score(self, candidates: Any) -> np.ndarray:
        return np.array(
            [float(len(c.text)) if isinstance(c, Response) else float(c.observations.sum()) for c in candidates]
        )


def model(fitted: bool = True) -> RewardModel[Any]:
    made = Sum()
    made.fitted = fitted
    return cast(RewardModel[Any], made)


def segments(*values: float, steps: int = 4) -> list[Segment]:
    return [
        Segment(np.full((steps, 1), v / steps, np.float32), np.zeros((steps, 1), np.float32), f"e/{i}", 0, None, None)
        for i, v in enumerate(values)
    ]


def test_all_rounds_are_scored_by_one_reward_and_meet_the_start(tmp_path: Path) -> None:
    for number, values in enumerate([(0.0, 0.0, 0.0, 0.0), (1.0, 1.0, -1.0, 0.0), (2.0, 4.0, 3.0, 3.0)]):
        keep(tmp_path, number, segments(*values))
    found = hindsight(tmp_path, 2, 2, model(), np.random.default_rng(0))
    assert found is not None
    assert [seen.learned.value for seen in found.rounds] == [0.0, 0.25, 3.0]
    assert [seen.won.value for seen in found.rounds] == [None, 0.625, 1.0]  # a tie is half
    assert found.rounds[2].won.low == pytest.approx(0.51, abs=0.01)  # four of four, by Wilson


def test_a_round_that_is_done_again_is_not_counted_before_it_is_done(tmp_path: Path) -> None:
    for number in range(3):
        keep(tmp_path, number, segments(float(number)))
    found = hindsight(tmp_path, 1, None, model(), np.random.default_rng(0))
    assert found is not None
    assert [seen.round for seen in found.rounds] == [0, 1]


def test_responses_keep_their_tokens_and_only_those_to_the_same_prompts_meet(tmp_path: Path) -> None:
    keep(tmp_path, 0, [Response("p", "ab", (1,), (2, 3), gold=np.ones(1))])
    keep(tmp_path, 1, [Response("other", "abc", (1,), (2,))])
    (kept,) = read(tmp_path, 0)
    assert isinstance(kept, Response)
    assert (kept.tokens, kept.prompt_tokens, kept.gold) == ((2, 3), (1,), None)
    found = hindsight(tmp_path, 1, 1, model(), np.random.default_rng(0))
    assert found is not None
    assert found.rounds[1].won.value is None


def test_nothing_is_said_without_a_reward_or_of_a_run_that_kept_nothing(tmp_path: Path) -> None:
    assert hindsight(tmp_path, 1, None, model(), np.random.default_rng(0)) is None
    keep(tmp_path, 0, segments(1.0))
    assert hindsight(tmp_path, 0, None, model(fitted=False), np.random.default_rng(0)) is None


def test_no_gold_no_simulator_states_and_not_too_much_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = Segment(np.zeros((4, 1), np.float32), np.zeros((4, 1), np.float32), "e", 0, np.ones((4, 9)), np.ones(4))
    monkeypatch.setattr(module, "MOST", 40)  # each has 32 bytes
    keep(tmp_path, 0, [whole, *segments(1.0)])
    (kept,) = read(tmp_path, 0)
    assert isinstance(kept, Segment)
    assert kept.states is None
    assert kept.gold is None


def test_a_mean_has_students_interval() -> None:
    found = average(np.array([1.0, 2.0, 3.0]))
    assert found.value == 2.0
    assert found.low == pytest.approx(2.0 - 4.30265 / np.sqrt(3.0), abs=1e-4)
    assert average(np.array([1.0])).low is None
    assert average(np.zeros(0)).value is None
