"""Answers that go round in a circle."""

from itertools import combinations, permutations

import numpy as np
import pytest

from prefrl.stats import triads
from prefrl.stats.triads import circular_triads

Generator = np.random.Generator


def test_a_circle_is_found_whatever_way_round_it_is_told(rng: Generator) -> None:
    for a, b, c in permutations(range(3)):
        edges = np.array([[a, b], [b, c], [a, c]])
        assert circular_triads(edges, np.array([1.0, 1.0, 0.0]), rng).value == 1.0
        assert circular_triads(edges, np.array([1.0, 1.0, 1.0]), rng).value == 0.0


def test_circles_are_counted_as_by_trying_all_triads(rng: Generator) -> None:
    edges = rng.integers(25, size=(220, 2))
    edges = edges[edges[:, 0] != edges[:, 1]]
    preference = rng.choice([0.0, 0.3, 0.5, 1.0], size=len(edges))
    net = np.zeros((25, 25))
    for (a, b), p in zip(edges, preference, strict=True):
        net[a, b] += np.sign(p - 0.5)
        net[b, a] -= np.sign(p - 0.5)
    full = [t for t in combinations(range(25), 3) if all(net[i, j] for i, j in combinations(t, 2))]
    around = sum(net[a, b] * net[b, c] > 0 and net[a, b] * net[c, a] > 0 for a, b, c in full)
    found = circular_triads(edges, preference, rng)
    assert len(full) > 20
    assert found.value == pytest.approx(around / len(full))
    assert found.count == len(full)


def test_coin_flips_make_a_quarter_circular_and_a_scale_none(rng: Generator) -> None:
    edges = np.array([(3 * t + i, 3 * t + j) for t in range(800) for i, j in ((0, 1), (0, 2), (1, 2))])
    flips = circular_triads(edges, rng.integers(2, size=len(edges)).astype(np.float64), rng)
    assert flips.low is not None
    assert flips.low < 0.25 < (flips.high or 0)
    sure = circular_triads(edges, (edges[:, 0] < edges[:, 1]).astype(np.float64), rng)
    assert sure.value == sure.low == 0.0
    assert 0 < (sure.high or 0) < 0.01


def test_triads_that_share_a_comparison_are_no_independent_evidence(rng: Generator) -> None:
    edges = np.array(list(combinations(range(12), 2)))
    found = circular_triads(edges, rng.integers(2, size=len(edges)).astype(np.float64), rng)
    assert found.count == 220
    assert (found.low, found.how) == (None, "no interval: only 1 clusters")


def test_many_triads_are_sampled_evenly(rng: Generator, monkeypatch: pytest.MonkeyPatch) -> None:
    edges = np.array(list(combinations(range(60), 2)))
    preference = rng.integers(2, size=len(edges)).astype(np.float64)
    everything = circular_triads(edges, preference, rng)
    monkeypatch.setattr(triads, "MOST_TRIADS", 5000)
    some = circular_triads(edges, preference, rng)
    assert (everything.count, some.count) == (34_220, 5000)
    assert some.value == pytest.approx(everything.value, abs=0.03)


@pytest.mark.parametrize("edges", [np.zeros((0, 2), int), np.array([[0, 1], [1, 2]]), np.array([[0, 1], [0, 2]])])
def test_without_triads_there_is_nothing_to_say(rng: Generator, edges: np.ndarray) -> None:
    found = circular_triads(edges, np.ones(len(edges)), rng)
    assert (found.value, found.why) == (None, "no three candidates were all compared with one another")
