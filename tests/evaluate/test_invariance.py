"""A score that hangs on more than its candidate is found out."""

from collections.abc import Sequence

import numpy as np
import pytest
from linear_reward import LinearReward, segment

from prefrl.evaluate.invariance import self_test
from prefrl.types import Candidate, Floats, Response

WEIGHTS = (1.0, -1.0, 0.5)


def test_an_honest_model_passes(rng: np.random.Generator) -> None:
    segments = [segment(rng, i) for i in range(30)]
    found = self_test(LinearReward(WEIGHTS).raw_member_scores, segments, [(0, 1), (2, 3)])
    assert found.passed
    assert (found.alone.value, found.reversed.value, found.padding.value) == pytest.approx((0, 0, 0), abs=1e-12)
    assert found.swap.value == pytest.approx(0.0, abs=1e-12)
    assert found.alone.count == 16


def test_a_model_that_looks_at_the_batch_fails(rng: np.random.Generator) -> None:
    segments = [segment(rng, i) for i in range(4)]
    found = self_test(LinearReward(WEIGHTS, leak=0.1).raw_member_scores, segments, [(0, 1)])
    assert not found.passed
    assert found.alone.value == pytest.approx(0.1 * 4 * 3)  # the last of four, less what it is alone
    assert found.reversed.value == pytest.approx(0.1 * 4 * 3)
    there = segments[0].observations @ WEIGHTS - segments[1].observations @ WEIGHTS
    p = 1 / (1 + np.exp(-there.sum() + 0.2)), 1 / (1 + np.exp(there.sum() + 0.2))
    assert found.swap.value == pytest.approx(abs(sum(p) - 1), abs=1e-6)


def test_a_model_that_counts_padding_fails() -> None:
    def padded(candidates: Sequence[Candidate]) -> Floats:
        longest = max(len(c.tokens) for c in candidates if isinstance(c, Response))
        return np.array([[len(c.tokens) + 0.01 * longest for c in candidates if isinstance(c, Response)]])

    texts = [Response("p", str(i), tokens=tuple(range(8 + i % 2))) for i in range(6)]
    found = self_test(padded, texts, [])
    assert not found.passed
    assert found.padding.value == pytest.approx(0.01 * (8 - 4))
    assert found.swap.why == "no comparisons"


def test_texts_of_one_length_without_tokens_cannot_be_cut() -> None:
    texts = [Response("p", chr(97 + i)) for i in range(3)]
    assert "cannot be cut" in self_test(LinearReward(WEIGHTS).raw_member_scores, texts, []).padding.why
