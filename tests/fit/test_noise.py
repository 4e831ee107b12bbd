import math

import pytest
import torch

from prefrl.fit.noise import Discriminator, flipped
from prefrl.fit.terms import terms
from prefrl.judgements import Comparison, Judged, Ranking
from prefrl.types import Query, Response


def test_a_model_that_knows_nothing_trusts_everybody() -> None:
    loss = torch.full((10,), math.log(2))
    verdict, after = Discriminator().judge(loss, torch.ones(10, dtype=torch.bool))
    assert verdict.keep.all()
    assert not verdict.flip.any()
    assert after.epochs == 1


def test_the_bound_is_that_of_the_paper() -> None:
    loss = torch.tensor([0.1, 0.1, 0.1, 0.1])
    ceiling = 0.4
    bound = -math.log(ceiling) + 0.5 * ceiling  # no spread: all losses are equal
    for value, trusted in ((bound - 0.01, True), (bound + 0.01, False)):
        verdict, _ = Discriminator(0, ceiling).judge(loss * 0 + value, torch.ones(4, dtype=torch.bool))
        assert verdict.keep.all().item() is trusted


def test_what_is_all_but_impossible_is_turned_round_where_it_is_a_pair() -> None:
    loss = torch.tensor([0.05] * 20 + [8.0, 8.0])
    pairs = torch.tensor([True] * 21 + [False])
    verdict, _ = Discriminator(200, 0.1).judge(loss, pairs)
    assert verdict.flip.tolist() == [False] * 20 + [True, False]
    assert verdict.keep.tolist() == [True] * 21 + [False]


def test_the_ceiling_follows_the_worst_trusted_loss() -> None:
    _, after = Discriminator(0, 0.5).judge(torch.tensor([0.2, 0.3]), torch.ones(2, dtype=torch.bool))
    assert after.ceiling == pytest.approx(0.9 * 0.5 + 0.1 * 0.3)


def test_turning_round_swaps_a_pairs_target_and_nothing_else() -> None:
    pool = sorted((Response("p", t) for t in "abc"), key=lambda c: c.id)
    two, three = Query(tuple(pool[:2])), Query(tuple(pool))
    some = [Judged(two, Comparison(two.id, 0.8)), Judged(three, Ranking(three.id, (0, 1, 2)))]
    made = terms(some, [c.id for c in pool], "half", "plackett_luce")
    turned = flipped(made, torch.tensor([True, False]))
    torch.testing.assert_close(turned.choices.target[0], torch.tensor([0.2, 0.8, 0.0]))
    torch.testing.assert_close(turned.choices.target[1:], made.choices.target[1:])
