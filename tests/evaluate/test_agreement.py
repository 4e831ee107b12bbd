"""Where a model agrees with what was judged, by hand."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import logit

from prefrl.evaluate.agreement import Pairs, against_gold, buckets, hits, kappa, labeler_part, member_part
from prefrl.evaluate.drift import drift, first_judged
from prefrl.fit.metrics import accuracy
from prefrl.judgements import Comparison, Judged
from prefrl.types import Query, Response


def pairs(predicted: list[float], preference: list[float], **more: list[float]) -> Pairs:
    count = len(predicted)
    known = {name: np.array(more.get(name, [np.nan] * count)) for name in ("gold", "length")}
    return Pairs(
        logits=logit(np.array([predicted])),
        preference=np.array(preference),
        labeler=np.array(["ann", "bob"] * count)[:count],
        cluster=np.arange(count),
        clusters="comparisons",
        **known,
    )


def test_accuracy_leaves_ties_out_and_halves_even_predictions_as_the_fit_does(rng: np.random.Generator) -> None:
    p, y = [0.9, 0.2, 0.5, 0.7, 0.6], [1.0, 0.0, 1.0, 0.5, 0.2]
    found = pairs(p, y).accuracy(rng)
    assert found.value == accuracy(np.array(p), np.array(y)) == 2.5 / 4
    assert found.count == 4


def test_margins_stay_right_where_probabilities_round_to_one() -> None:
    certain = replace(pairs([0.5, 0.5], [1.0, 1.0]), logits=np.array([[800.0, -60.0]]))
    assert certain.margin.tolist() == [800.0, 60.0]


def test_buckets_are_quarters_of_the_decided_comparisons(rng: np.random.Generator) -> None:
    some = pairs([0.9] * 9, [1, 1, 0, 1, 0, 0, 1, 1, 0.5])
    found = buckets(some, np.array([1.0, 2, 3, 4, 5, 6, 7, 8, 9]), rng)
    assert [(b.low, b.high, b.accuracy.value) for b in found] == [(1, 2, 1.0), (3, 4, 0.5), (5, 6, 0.0), (7, 8, 1.0)]
    one = buckets(some, np.ones(9), rng)
    assert [(b.low, b.high, b.accuracy.count) for b in one] == [(1, 1, 8)]
    assert buckets(some, np.full(9, np.nan), rng) == []


def test_lengths_are_told_beside_accuracy(rng: np.random.Generator) -> None:
    some = pairs([0.9, 0.9, 0.9, 0.9], [1.0, 0.0, 1.0, 1.0], length=[3.0, 3.0, -3.0, 0.0])
    (only,) = buckets(some, np.ones(4), rng, lengths=True)
    assert only.longer is not None
    assert (only.accuracy.value, only.longer.value) == (0.75, (1 + 0 + 0 + 0.5) / 4)


def test_agreement_with_gold_leaves_out_what_is_equal_or_unknown(rng: np.random.Generator) -> None:
    some = pairs([0.9, 0.9, 0.1, 0.9], [1.0] * 4, gold=[2.0, -1.0, 0.0, np.nan])
    found = against_gold(some, some.predicted - 0.5, rng)
    assert (found.value, found.count) == (0.5, 2)
    assert against_gold(pairs([0.9], [1.0]), np.ones(1), rng).why == "no gold is known"
    assert against_gold(pairs([0.9], [1.0], gold=[0.0]), np.ones(1), rng).why == "all golds are equal"


def test_kappa_by_hand() -> None:
    one = np.array([True] * 5 + [False] * 5)
    other = np.array([True] * 4 + [False] * 5 + [True])
    assert kappa(one, other).value == pytest.approx(0.6)  # 8 of 10 agree, 5 of 10 would by chance
    assert kappa(np.ones(3, bool), np.ones(3, bool)).why == "both always name the same side"
    assert kappa(one[:0], one[:0]).why == "no comparison of this sort"


def test_each_labeler_is_told_apart(rng: np.random.Generator) -> None:
    some = pairs([0.9, 0.9, 0.9, 0.9], [1.0, 0.0, 1.0, 0.5], gold=[1.0, 1.0, 1.0, 1.0])
    ann, bob = (labeler_part(some, name, rate, rng) for name, rate in (("ann", 0.1), ("bob", None)))
    assert (ann.accuracy.value, ann.gold.value, ann.error_rate.value) == (1.0, 1.0, 0.1)
    assert (bob.accuracy.value, bob.gold.value, bob.error_rate.value) == (0.0, 0.0, None)


def test_members_that_name_different_winners_are_counted(rng: np.random.Generator) -> None:
    some = replace(pairs([0.9] * 3, [1.0] * 3), logits=np.array([[1.0, 1, -1], [1.0, -1, -1]]))
    found = member_part(some, rng)
    assert [e.value for e in found.accuracy] == pytest.approx([2 / 3, 1 / 3])
    assert found.unanimous.value == pytest.approx(2 / 3)
    assert "one member" in member_part(pairs([0.9], [1.0]), rng).unanimous.why


def test_hits_of_signs() -> None:
    assert hits(np.array([2.0, -1, 0, 3]), np.array([1.0, 1, 1, 0])).tolist() == [1.0, 0.0, 0.5, 0.5]


def test_drift_by_hand() -> None:
    rows = [{"round": 1, "scores": [1.0, 2.0, 3.0]}, {"round": 2, "scores": [2.0, 4.0, 3.0]}]
    (step,) = drift(rows)
    assert step.round == 2
    assert step.spearman.value == pytest.approx(0.5)
    assert step.shift.value == pytest.approx(1.0 / np.std([1, 2, 3]))
    (flat,) = drift([{"round": 1, "scores": [1.0] * 3}, rows[1]])
    assert (flat.spearman.value, flat.shift.value) == (None, None)
    assert drift(rows[:1]) == []


def test_probes_are_the_first_candidates_that_were_judged() -> None:
    queries = [Query((Response("p", "a"), Response("p", str(i)))) for i in range(80)]
    judged = [Judged(q, Comparison(q.id, 1.0)) for q in queries]
    found = first_judged(judged)
    assert len(found) == len(set(found)) == 64
    assert found == first_judged(judged[:70])
    assert set(found[:2]) == {c.id for c in queries[0].candidates}
