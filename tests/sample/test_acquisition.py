from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.special import softmax

from prefrl.sample.acquisition import SCORES, disagreement, entropy, information, joint_information
from prefrl.types import Floats

UNDECIDED_AND_SURE = np.array([[[0.0, 0.0]], [[100.0, -100.0]]])
OPPOSED = np.array([[[50.0, -50.0]], [[-50.0, 50.0]]])
AGREED_TIE = np.zeros((2, 1, 2))
SCORED = arrays(np.float64, (3, 4, 3), elements=st.floats(-30, 30))


def test_disagreement_is_the_spread_of_the_preference_by_hand() -> None:
    np.testing.assert_allclose(disagreement(UNDECIDED_AND_SURE), [0.25])
    np.testing.assert_allclose(disagreement(OPPOSED), [0.5])


def test_entropy_is_that_of_the_mean_prediction_by_hand() -> None:
    np.testing.assert_allclose(entropy(OPPOSED), [np.log(2)])
    np.testing.assert_allclose(entropy(AGREED_TIE), [np.log(2)])
    np.testing.assert_allclose(entropy(UNDECIDED_AND_SURE), [-0.75 * np.log(0.75) - 0.25 * np.log(0.25)])


def test_information_is_what_members_disagree_about_not_what_they_all_find_hard() -> None:
    np.testing.assert_allclose(information(OPPOSED), [np.log(2)])
    np.testing.assert_allclose(information(AGREED_TIE), [0.0], atol=1e-12)
    np.testing.assert_allclose(information(UNDECIDED_AND_SURE), entropy(UNDECIDED_AND_SURE) - 0.5 * np.log(2))


def test_information_is_the_mutual_information_of_member_and_answer(rng: np.random.Generator) -> None:
    scores = rng.normal(size=(4, 5, 3))
    joint = softmax(scores, -1).transpose(1, 0, 2) / 4  # (Q, member, answer)
    product = joint.sum(1, keepdims=True) * joint.sum(2, keepdims=True)
    np.testing.assert_allclose(information(scores), (joint * np.log(joint / product)).sum((1, 2)))


def test_the_best_of_three_tells_no_more_than_the_whole_ranking(rng: np.random.Generator) -> None:
    scores = rng.normal(size=(4, 20, 3)) * 2
    assert (information(scores) <= ranking_information(scores) + 1e-12).all()


def ranking_information(scores: Floats) -> Floats:
    """(Q,): the same for the Plackett-Luce ranking of three, by enumeration."""
    chances = []
    for first, second, third in permutations(range(3)):
        best = softmax(scores, -1)[..., first]
        chances.append(best * softmax(scores[..., [second, third]], -1)[..., 0])
    p = np.stack(chances, -1)
    mean = p.mean(0)
    values: Floats = (-mean * np.log(mean)).sum(-1) - (-p * np.log(p)).sum(-1).mean(0)
    return values


@given(SCORED, arrays(np.float64, (3, 4, 1), elements=st.floats(-30, 30)))
def test_scores_of_queries_do_not_depend_on_a_members_shift_or_the_candidates_order(
    scores: Floats, shift: Floats
) -> None:
    for score in SCORES.values():
        np.testing.assert_allclose(score(scores + shift), score(scores), atol=1e-9)
        np.testing.assert_allclose(score(scores[:, :, ::-1]), score(scores), atol=1e-9)


@given(SCORED)
def test_information_lies_between_nothing_and_what_tells_members_apart(scores: Floats) -> None:
    assert (information(scores) > -1e-12).all()
    assert (information(scores) <= min(np.log(3), np.log(len(scores))) + 1e-12).all()
    assert (information(scores) <= entropy(scores) + 1e-12).all()


@pytest.mark.parametrize("size", [2, 3])
def test_joint_information_picks_greedily_by_the_full_determinant(size: int, rng: np.random.Generator) -> None:
    scores = rng.normal(size=(4, 9, size)) * 2
    chosen: list[int] = []
    for _ in range(6):
        values = [gain(scores, [*chosen, q]) if q not in chosen else -np.inf for q in range(9)]
        chosen.append(int(np.argmax(values)))
    assert joint_information(scores, 6).tolist() == chosen


def gain(scores: Floats, queries: list[int]) -> float:
    """log det(I + C F) with the members' covariance of all scores and the block-diagonal information of the answers."""
    members, size = len(scores), scores.shape[2]
    flat = scores[:, queries].reshape(members, -1)
    fisher = np.zeros((flat.shape[1],) * 2)
    for at, q in enumerate(queries):
        p = softmax(scores[:, q], -1).mean(0)
        part = slice(at * size, (at + 1) * size)
        fisher[part, part] = np.diag(p) - np.outer(p, p)
    return float(np.linalg.slogdet(np.eye(flat.shape[1]) + np.cov(flat.T) @ fisher)[1])


def test_joint_information_does_not_ask_the_same_thing_twice() -> None:
    same = np.array([[3.0, 0.0], [-3.0, 0.0], [0.0, 0.0]])  # members 0 and 1 differ
    other = np.array([[0.0, 0.0], [2.0, 0.0], [-2.0, 0.0]])  # members 1 and 2 differ, by less
    scores = np.stack([same, same, other], axis=1)
    assert joint_information(scores, 2).tolist() == [0, 2]
    np.testing.assert_allclose(information(scores)[0], information(scores)[1])
    assert information(scores)[2] < information(scores)[1]
