import numpy as np
import pytest

from prefrl.types import Query, Response, Segment, Steps, gold_score


def response(text: str, prompt: str = "p", gold: float | None = None) -> Response:
    return Response(prompt, text, gold=None if gold is None else np.array([gold]))


def test_the_id_of_a_candidate_is_its_content_and_not_its_gold() -> None:
    assert response("a", gold=1.0).id == response("a", gold=2.0).id == response("a").id
    assert response("a").id != response("b").id != response("b", prompt="q").id
    x = np.ones((2, 3), np.float32)
    segment = Segment(x, x, "e", 0)
    assert segment.id == Segment(x.copy(order="F"), x, "e", 0, gold=np.ones(2)).id
    assert segment.id != Segment(x.astype(np.float64), x, "e", 0).id


def test_text_that_is_no_valid_unicode_still_has_an_id() -> None:
    assert len(response("\ud800").id) == 64


def test_a_query_does_not_depend_on_the_order_in_which_it_was_made() -> None:
    a, b = response("a"), response("b")
    assert Query((a, b)).candidates == Query((b, a)).candidates
    assert Query((a, b)).id == Query((b, a)).id


@pytest.mark.parametrize(
    ("candidates", "message"),
    [
        ((), "at least one"),
        ((response("a"), response("a")), "with itself"),
        ((response("a"), response("b", prompt="q")), "one context"),
    ],
)
def test_queries_that_make_no_sense_are_refused(candidates: tuple[Response, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Query(candidates)


def test_a_segment_with_unequal_lengths_is_refused() -> None:
    with pytest.raises(ValueError, match="equal length"):
        Segment(np.zeros((3, 1)), np.zeros((2, 1)), "e", 0)


def test_gold_is_only_there_where_it_was_attached() -> None:
    assert gold_score(response("a", gold=0.5)) == 0.5
    with pytest.raises(ValueError, match="carries no gold"):
        gold_score(response("a"))


def test_steps_add_up_by_purpose() -> None:
    assert Steps(1, 2, 3).add(learn=10).add(query=20, evaluate=30, imagined=4) == (11, 22, 33, 4)


def test_no_two_responses_share_an_id_by_where_a_prompt_ends() -> None:
    ids = {response(text, prompt).id for prompt, text in (("", "\0"), ("\0", ""), ("a\0", "b"), ("a", "\0b"))}
    assert len(ids) == 4
