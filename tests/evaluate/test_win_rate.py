"""Win rates by hand, and labelers whose faults are known."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import pytest

from prefrl.evaluate.win_rate import Asked, WinRate, by_labeler, by_scores, in_order, win_rate
from prefrl.judgements import Answer, Choice, Comparison, Ranking, Rating, Skip
from prefrl.label.oracle import OracleSettings
from prefrl.protocols import Labeler
from prefrl.protocols import Store as AnyStore
from prefrl.store import Store
from prefrl.types import Floats, Query, Response

NAN = np.nan
GOOD, BAD = "good", "bad, and longer"
Say = Callable[[Query[Response]], Answer]


def answers(*texts: str, samples: int = 1) -> list[Response]:
    """Responses to prompts p0, p1 ..., so many to each."""
    return [Response(f"p{i // samples}", text, tokens=(1,) * len(text.split())) for i, text in enumerate(texts)]


def counted(*won: float, samples: int = 1, seed: int = 0) -> WinRate:
    ours, theirs = (answers(*[side] * len(won), samples=samples) for side in ("we", "they said"))
    return win_rate(ours, theirs, np.array(won), np.random.default_rng(seed))


def better(query: Query[Response]) -> float:
    """1 where the first candidate says GOOD."""
    return float(query.candidates[0].text == GOOD)


@dataclass(frozen=True)
class Says:
    """A labeler that shows queries as they come."""

    say: Say
    name: str = "it"

    def answer(self, store: AnyStore[Response], rng: np.random.Generator) -> None:
        store.answer([self.say(query) for query in store.open_queries(self.name)])


def asked(say: Say, store: Store[Response], *texts: str) -> Asked:
    """About pairs in which our side says GOOD, or these texts."""
    ours = answers(*(texts or (GOOD, GOOD, GOOD)))
    return by_labeler(ours, answers(*[BAD] * len(ours)), Says(say), store, np.random.default_rng(0))


def test_ties_are_half_a_win_and_what_was_not_judged_counts_nowhere() -> None:
    found = counted(1, 1, 1, 0.5, 0, NAN)
    assert (found.wins, found.ties, found.losses, found.unjudged) == (3, 1, 1, 1)
    assert (found.prompts, found.pairs, found.rate.count) == (6, 6, 5)
    assert found.rate.value == pytest.approx(3.5 / 5)
    assert (found.tokens, found.other_tokens) == (1, 2)


def test_a_pair_that_was_decided_says_whether_the_longer_one_won() -> None:
    found = counted(1, 1, 0, 0.5, NAN)  # theirs are longer
    assert found.longer_won.value == pytest.approx(1 / 3)
    assert found.longer_won.count == 3


def test_wins_and_losses_alone_have_wilsons_interval() -> None:
    found = counted(*[1.0] * 8, *[0.0] * 2).rate
    assert (found.low, found.high) == pytest.approx((0.4902, 0.9433), abs=1e-4)  # Wilson 1927, 8 of 10


def test_the_interval_takes_all_responses_to_a_prompt_as_one() -> None:
    won = np.repeat(np.arange(40) % 2, 8).astype(float)  # a prompt is won eight times, or lost eight times
    together, apart = counted(*won, samples=8).rate, counted(*won).rate
    assert together.value == apart.value == 0.5
    widths = [one.high - one.low for one in (together, apart) if one.high is not None and one.low is not None]
    assert widths[0] / widths[1] == pytest.approx(np.sqrt(8), rel=0.15)
    assert "40 prompts" in together.how


def test_intervals_hold_the_truth_about_as_often_as_they_say() -> None:
    rng, held = np.random.default_rng(0), 0
    for repetition in range(200):
        each = rng.beta(2, 1, size=40)  # how probable a win is hangs on the prompt; 2/3 on the mean
        found = counted(*rng.binomial(1, np.repeat(each, 3)), samples=3, seed=repetition).rate
        assert found.low is not None
        assert found.high is not None
        held += found.low <= 2 / 3 <= found.high
    assert 0.90 <= held / 200 <= 0.985


def test_nothing_judged_has_no_rate() -> None:
    found = counted(NAN, NAN)
    assert (found.rate.value, found.unjudged) == (None, 2)


def test_the_same_text_ties_whatever_is_said_of_it() -> None:
    found = win_rate(answers("a", "b", "c"), answers("a", "b", "d"), np.array([1, NAN, 0]), np.random.default_rng(0))
    assert (found.wins, found.ties, found.losses, found.unjudged) == (0, 2, 1, 0)


@pytest.mark.parametrize("theirs", [[], answers("a"), [Response("p1", "a"), Response("p0", "b")]])
def test_sides_that_answer_other_prompts_are_refused(theirs: list[Response]) -> None:
    with pytest.raises(ValueError, match="to one prompt each"):
        win_rate(answers("a", "b") if theirs else [], theirs, np.zeros(2), np.random.default_rng(0))


def test_the_higher_score_wins_and_a_missing_one_leaves_the_pair_unjudged() -> None:
    found = by_scores(np.array([2, 1, 1, NAN, 0], np.float32), np.array([1, 1, 2, 0, NAN], np.float32))
    np.testing.assert_array_equal(found, [1, 0.5, 0, NAN, NAN])


def test_infinite_scores_are_compared_like_all_others() -> None:
    assert by_scores(np.array([np.inf, np.inf, -np.inf]), np.array([np.inf, 0.0, 0.0])).tolist() == [0.5, 1, 0]


# --- labelers ---------------------------------------------------------------------------------------------------------


def test_a_query_holds_two_texts_in_the_order_asked_for() -> None:
    for a, b in zip(answers(*map(str, range(20))), answers(*map(str, range(20, 40))), strict=True):
        assert [one.text for one in in_order(a, b).candidates] == [a.text, b.text]
        assert [one.text for one in in_order(b, a).candidates] == [b.text, a.text]
        assert {one.tokens for one in in_order(a, b).candidates} == {()}  # so a text is asked about once


def test_a_labeler_that_knows_better_wins_every_pair_in_both_orders(text_store: Store[Response]) -> None:
    found = asked(lambda q: Comparison(q.id, better(q), "it"), text_store)
    assert found.ours.tolist() == [[1, 1]] * 3
    assert found.won.tolist() == [1, 1, 1]
    assert (found.order.position_bias, found.order.flipped) == (0, 0)
    assert text_store.counts()["asked"] == 6


def test_a_labeler_that_always_prefers_the_first_ties_all_and_its_bias_is_seen(text_store: Store[Response]) -> None:
    found = asked(lambda q: Comparison(q.id, 1.0, "it"), text_store)
    assert found.ours.tolist() == [[1, 0]] * 3
    assert found.won.tolist() == [0.5] * 3
    assert (found.order.position_bias, found.order.flipped) == (0.5, 1)


def test_the_second_place_has_a_bias_below_zero(text_store: Store[Response]) -> None:
    found = asked(lambda q: Comparison(q.id, 0.2 if better(q) else 0.1, "it"), text_store)
    assert found.order.position_bias == pytest.approx((0.2 + 0.1) / 2 - 0.5)
    assert found.won.tolist() == [1, 1, 1]  # on the mean of 0.2 and 0.9


@pytest.mark.parametrize(
    "say",
    [
        lambda q: Choice(q.id, int(1 - better(q)), "it"),
        lambda q: Ranking(q.id, (0, 1) if better(q) else (1, 0), "it"),
        lambda q: Rating(q.id, (4, 2) if better(q) else (2, 4), 5, "it"),
    ],
    ids=["choice", "ranking", "rating"],
)
def test_every_form_of_judgement_is_understood(text_store: Store[Response], say: Say) -> None:
    assert asked(say, text_store).ours.tolist() == [[1, 1]] * 3


def test_the_place_that_counts_is_the_one_where_it_was_shown(text_store: Store[Response]) -> None:
    found = asked(lambda q: Comparison(q.id, 0.0, "it", shown=(1, 0)), text_store)  # prefers what it showed first
    assert (found.order.position_bias, found.won.tolist()) == (0.5, [0.5] * 3)


def test_a_pair_skipped_in_one_order_is_not_judged(text_store: Store[Response]) -> None:
    found = asked(lambda q: Comparison(q.id, 1.0, "it") if better(q) else Skip(q.id, "skip", "it"), text_store)
    assert np.isnan(found.won).all()
    assert (found.order.position_bias, found.order.flipped) == (None, None)


def test_equal_texts_are_not_asked_about(text_store: Store[Response]) -> None:
    found = asked(lambda q: Comparison(q.id, better(q), "it"), text_store, BAD, GOOD)
    np.testing.assert_array_equal(found.won, [NAN, 1])
    assert text_store.counts()["asked"] == 2


def test_preferences_that_differ_from_a_tie_by_rounding_alone_are_ties() -> None:
    both = np.array([[0.9, 0.1 + 1e-8], [0.9, 0.1 - 1e-8], [0.9, 0.2], [0.5 + 1e-8, 0.4]])
    found = Asked(both, both)
    assert found.won.tolist() == [0.5, 0.5, 1, 0]
    assert found.order.flipped == 0.75  # the last did not change its winner: it had none at first


@dataclass(frozen=True)
class Told:
    forward: float
    backward: float


@dataclass(frozen=True)
class Swaps:
    """A labeler that asks in both orders itself, as a judge does."""

    name: str = "swaps"

    def compare(self, pairs: Sequence[tuple[Response, Response]], /) -> list[Told]:
        return [Told(0.9, 0.3 if a.text == GOOD else NAN) for a, _ in pairs]

    def answer(self, store: AnyStore[Response], rng: np.random.Generator) -> None:
        raise AssertionError("it was asked twice")


def test_a_labeler_that_swaps_by_itself_is_asked_once(text_store: Store[Response]) -> None:
    labeler: Labeler[Response] = Swaps()
    found = by_labeler(answers(GOOD, "odd", BAD), answers(BAD, BAD, BAD), labeler, text_store, np.random.default_rng(0))
    np.testing.assert_array_equal(found.won, [1, NAN, NAN])
    assert found.order.position_bias == pytest.approx((0.9 + 0.7) / 2 - 0.5)
    assert found.order.flipped == 1
    assert text_store.counts()["asked"] == 0


def test_an_oracle_is_asked_by_its_gold_and_its_noise_is_drawn_for_each_order(text_store: Store[Response]) -> None:
    def worth(texts: Sequence[str], gold: float) -> list[Response]:
        return [Response(f"p{i}", text, gold=np.array([gold])) for i, text in enumerate(texts)]

    ours, theirs = worth([f"a{i}" for i in range(80)], 1), worth([f"b{i}" for i in range(80)], 0)
    rng = np.random.default_rng(0)
    noisy = by_labeler(ours, theirs, OracleSettings(mistake_rate=0.2).build(Texts()), text_store, rng)
    shares: Floats = np.array([(noisy.won == outcome).mean() for outcome in (1, 0.5, 0)])
    np.testing.assert_allclose(shares, [0.64, 0.32, 0.04], atol=0.15)
    assert noisy.order.flipped == shares[1]


@dataclass(frozen=True)
class Texts:
    name: str = "texts"
    kind: str = "text"
