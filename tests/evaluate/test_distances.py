"""EPIC and Pearson distances, on rewards whose distance is known."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from linear_reward import LinearReward, segment

from prefrl.evaluate.distances import (
    Reward,
    Transitions,
    canonical,
    distance_part,
    epic,
    monomials,
    pearson_distance,
    regress,
    transitions,
)
from prefrl.types import Floats, Segment

GAMMA = 0.9


@pytest.fixture
def steps(rng: np.random.Generator) -> Transitions:
    return Transitions(*(rng.normal(size=(300, width)) for width in (3, 2, 3)))


def cost(states: Floats, actions: Floats, following: Floats) -> Floats:
    """Some reward of all three."""
    found: Floats = states[:, 0] * actions[:, 0] + np.sin(actions[:, 1]) + following[:, 2] ** 2
    return found


def shaped(reward: Reward, potential: Callable[[Floats], Floats]) -> Reward:
    """Ng, Harada and Russell 1999: optimal policies stay."""
    return lambda s, a, x: reward(s, a, x) + GAMMA * potential(x) - potential(s)


@given(st.floats(0.01, 100), st.floats(-100, 100))
def test_epic_is_zero_for_a_positive_affine_map(scale: float, shift: float) -> None:
    rng = np.random.default_rng(0)
    some = Transitions(*(rng.normal(size=(40, width)) for width in (3, 2, 3)))
    found = epic(cost, lambda s, a, x: scale * cost(s, a, x) + shift, some, GAMMA, rng, (40, 20))
    assert found == pytest.approx(0.0, abs=1e-3)


def test_epic_is_blind_to_potential_shaping_and_the_direct_distance_is_not(
    steps: Transitions, rng: np.random.Generator
) -> None:
    other = shaped(cost, lambda s: 5 * np.cos(s).sum(1))
    assert epic(cost, other, steps, GAMMA, rng) == pytest.approx(0.0, abs=1e-6)
    rows = steps.observations, steps.actions, steps.following
    direct = pearson_distance(cost(*rows), other(*rows))
    assert direct is not None
    assert direct > 0.3


def test_shaping_alone_is_the_zero_reward(steps: Transitions) -> None:
    alone = shaped(lambda s, a, x: np.zeros(len(s)), lambda s: s[:, 0] ** 3)
    found = canonical(alone, steps, steps.observations[:50], steps.actions[:50], GAMMA)
    np.testing.assert_allclose(found, 0.0, atol=1e-12)


def test_a_shaped_constant_has_no_distance(steps: Transitions, rng: np.random.Generator) -> None:
    alone = shaped(lambda s, a, x: np.ones(len(s)), lambda s: s[:, 0])
    assert epic(cost, alone, steps, GAMMA, rng) is None


def test_opposite_rewards_are_one_apart_and_unrelated_ones_about_sqrt_half(
    steps: Transitions, rng: np.random.Generator
) -> None:
    assert epic(cost, lambda s, a, x: -cost(s, a, x), steps, GAMMA, rng) == pytest.approx(1.0)
    one, other = (lambda s, a, x: a[:, 0]), (lambda s, a, x: a[:, 1])
    assert epic(one, other, steps, GAMMA, rng) == pytest.approx(np.sqrt(0.5), abs=0.05)


def test_canonical_shaping_by_hand() -> None:
    def reward(s: Floats, a: Floats, x: Floats) -> Floats:
        found: Floats = s[:, 0] + 10 * a[:, 0] + 100 * x[:, 0]
        return found

    one = Transitions(np.array([[1.0]]), np.array([[2.0]]), np.array([[3.0]]))
    # means: actions 3, states 1; R = 321, from s' = 3: 133, from s = 1: 131, from the mean state: 131
    found = canonical(reward, one, np.array([[0.0], [2.0]]), np.array([[2.0], [4.0]]), 0.5)
    assert found == pytest.approx([321 + 0.5 * 133 - 131 - 0.5 * 131])


def test_the_pearson_distance_by_hand() -> None:
    # rho of (1, 2, 3) and (1, 3, 2) is 1/2
    assert pearson_distance(np.array([1.0, 2, 3]), np.array([1.0, 3, 2])) == pytest.approx(np.sqrt(0.25))
    assert pearson_distance(np.ones(3), np.arange(3.0)) is None


def test_the_next_state_is_the_next_row_of_the_same_segment(rng: np.random.Generator) -> None:
    one, other = segment(rng, 0, steps=4), segment(rng, 1, steps=3)
    found = transitions([one, other])
    assert len(found) == 5
    np.testing.assert_array_equal(found.following[:3], one.observations[1:])
    np.testing.assert_array_equal(found.following[3:], other.observations[1:])


def test_all_products_up_to_a_degree() -> None:
    assert monomials(np.array([[2.0, 3.0]]), 2).tolist() == [[1, 2, 3, 4, 6, 9]]


def test_gold_is_found_again_between_stored_steps_where_it_is_smooth(rng: np.random.Generator) -> None:
    found = regress([segment(rng, i) for i in range(40)], rng)
    assert found is not None
    stand_in, explained = found
    assert explained == pytest.approx(1.0)
    rows = rng.normal(size=(5, 3))
    np.testing.assert_allclose(stand_in(rows, rng.normal(size=(5, 2)), rows), rows @ [1, -1, 0.5], atol=1e-5)


def test_the_right_reward_is_at_no_distance_and_a_wrong_one_is(rng: np.random.Generator) -> None:
    segments = [segment(rng, i) for i in range(40)]
    right = distance_part(LinearReward([2.0, -2.0, 1.0]), segments, (), GAMMA, rng)
    wrong = distance_part(LinearReward([-1.0, 1.0, -0.5]), segments, (), GAMMA, rng)
    assert (right.epic.value, right.direct.value) == pytest.approx((0.0, 0.0), abs=1e-3)
    assert (wrong.epic.value, wrong.direct.value) == pytest.approx((1.0, 1.0), abs=1e-3)


def test_no_distance_is_claimed_where_gold_cannot_be_guessed(rng: np.random.Generator) -> None:
    noise = [Segment(s.observations, s.actions, s.episode, 0, gold=rng.normal(size=6)) for s in many(rng)]
    found = distance_part(LinearReward([1.0, 0.0, 0.0]), noise, (), GAMMA, rng)
    assert "a polynomial explains" in found.epic.why
    assert found.direct.value is not None
    reward = LinearReward([1.0, 0.0, 0.0], memory=4)
    assert "looks back" in distance_part(reward, many(rng), (), GAMMA, rng).epic.why
    assert "fewer than 10" in distance_part(LinearReward([1.0, 0, 0]), noise[:9], (), GAMMA, rng).direct.why


def many(rng: np.random.Generator) -> list[Segment]:
    return [segment(rng, i) for i in range(40)]
