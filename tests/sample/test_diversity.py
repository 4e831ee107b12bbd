from collections.abc import Callable
from itertools import combinations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.distance import cdist

from prefrl.sample.diversity import dpp, k_center, k_medoids
from prefrl.types import Floats, Integers

CLOUDS = np.array([[0.0, 0.0], [0.1, 0.0], [0.0, 0.1], [5.0, 5.0], [5.1, 5.0], [5.0, 5.1], [0.0, 9.0]])


def test_k_center_equals_the_naive_greedy(rng: np.random.Generator) -> None:
    points = rng.normal(size=(60, 4))
    chosen = [0]
    while len(chosen) < 25:
        chosen.append(int(cdist(points, points[chosen]).min(1).argmax()))
    assert k_center(points, 25).tolist() == chosen


def test_k_center_is_within_twice_the_smallest_radius(rng: np.random.Generator) -> None:
    points = rng.normal(size=(12, 2))
    radius = cdist(points, points[k_center(points, 3)]).min(1).max()
    best = min(cdist(points, points[list(some)]).min(1).max() for some in combinations(range(12), 3))
    assert best <= radius <= 2 * best


def test_k_medoids_takes_one_point_of_each_cluster() -> None:
    assert {i // 3 for i in k_medoids(CLOUDS, 3).tolist()} == {0, 1, 2}


def test_k_medoids_are_in_the_middle_where_centres_are_at_the_edge() -> None:
    line = np.array([[-1.0], [0.0], [1.0], [9.0], [10.0], [11.0]])
    assert sorted(k_medoids(line, 2).tolist()) == [1, 4]
    assert k_center(line, 2).tolist() == [0, 5]


def test_dpp_picks_greedily_by_the_full_determinant(rng: np.random.Generator) -> None:
    points, quality = rng.normal(size=(10, 3)), rng.uniform(0.5, 1.5, 10)
    squared = cdist(points, points, "sqeuclidean")
    kernel = np.exp(-squared / (2 * np.median(squared[squared > 0]))) * np.outer(quality, quality)
    chosen: list[int] = []
    for _ in range(6):
        sets = {i: [*chosen, i] for i in range(10) if i not in chosen}
        chosen.append(max(sets, key=lambda i: float(np.linalg.det(kernel[np.ix_(sets[i], sets[i])]))))
    assert dpp(points, quality, 6).tolist() == chosen


def test_dpp_weighs_how_good_a_point_is() -> None:
    assert dpp(CLOUDS, np.array([1, 9, 1, 1, 1, 9, 1.0]), 2).tolist() == [1, 5]


@given(arrays(np.float64, (9, 2), elements=st.sampled_from([0.0, 1.0, 2.0])), st.integers(1, 8))
def test_the_chosen_are_distinct_even_where_points_are_equal(points: Floats, count: int) -> None:
    for chosen in (k_center(points, count), k_medoids(points, count), dpp(points, np.ones(9), count)):
        assert len(set(chosen.tolist())) == count


@pytest.mark.parametrize(
    "choose", [k_center, k_medoids, lambda points, count: dpp(points, np.ones(len(points)), count)]
)
def test_identical_points_are_taken_in_their_order(choose: Callable[[Floats, int], Integers]) -> None:
    assert choose(np.zeros((5, 2)), 3).tolist() == [0, 1, 2]
