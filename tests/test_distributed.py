"""Several ranks compute what one does, and nobody waits for one that has ended."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch
from rank_cases import Work, controls, on_ranks, pieces, policies, rewards, spread_out

from prefrl import distributed
from prefrl.distributed import World
from prefrl.envs.text import Reviews

NOISE = 1e-4


def test_a_process_by_itself_is_a_world_of_one_that_changes_nothing() -> None:
    rows = torch.arange(6.0).view(3, 2)
    weight = torch.nn.Parameter(torch.ones(2))
    with distributed.together() as world:
        assert world == World() == distributed.world() == distributed.joined()
        assert world.whole(rows[world.mine], 3) is not None
        assert torch.equal(world.whole(rows[world.mine], 3), rows)
        assert world.gathered("a") == ["a"]
        assert world.first(lambda: 7) == 7
        world.sum_gradients([weight])
    assert weight.grad is None


def test_ranks_share_rows_sum_gradients_and_hear_what_the_first_has_to_say(tmp_path: Path) -> None:
    found = on_ranks(3, tmp_path / "three", pieces)
    for rank, one in enumerate(found):
        for count in (0, 1, 2, 3, 7):  # fewer rows than ranks, and a rest
            assert torch.equal(one[f"whole {count}"], torch.arange(2 * count).view(count, 2)), (rank, count)
        assert one["mine"].tolist() == list(range(7))[rank::3]
        assert one["gradient"].tolist() == [0 + 1 + 2, 10.0]  # the second of rank 0 alone
        assert one["untouched"].all()  # by any rank
        assert one["ranks"].tolist() == [0, 1, 2]
        assert one["first"].tolist() == [40, 0]  # rank 0 says it, in a world of its own
        assert bytes(one["error"].tolist()) == b"said by rank 0"
        assert one["calls"].tolist() == [2 if rank == 0 else 0]
        assert one["share"].tolist() == [[0, 1], [2, 3], [4, 5, 6]][rank]  # neighbours
        assert one["each"].tolist() == [[0, 1], [1, 1], [2, 1]]  # each in a world of its own
        assert bytes(one["error of one"].tolist()) == b"said by rank 2"


@pytest.mark.parametrize("size", [2, pytest.param(4, marks=pytest.mark.slow)])
@pytest.mark.parametrize("work", [policies, rewards])
def test_an_update_is_the_same_on_any_number_of_ranks(
    work: Work, size: int, toy_reviews: Reviews, models: Path, tmp_path: Path
) -> None:
    alone = work(models)
    found = on_ranks(size, tmp_path / "ranks", work, models)
    for name, expected in alone.items():
        assert all(torch.equal(found[0][name], one[name]) for one in found), f"{name}: ranks differ"
        # Adam's first step is about as long for any gradient: where that is 0 but for rounding, it goes either way.
        slope = alone.get(name.replace("parameters", "gradient"), expected).abs()
        known = slope > NOISE * slope.max()
        apart = float(((found[0][name] - expected) * known).norm() / expected.norm())
        # Float32 itself: the gradient with adapters is 2e-6 from the one in float64, on one rank as on two.
        assert apart <= 5e-6, f"{name}: {apart:.2g} from one rank"


def test_control_is_the_same_to_the_bit_on_two_ranks_that_have_two_and_three_environments(tmp_path: Path) -> None:
    alone = controls()
    assert b"environment 4 in step 0 of the rollout" in bytes(alone["fault"].tolist())
    ranks, whole = on_ranks(2, tmp_path / "ranks", controls), alone.pop("own").tolist()
    assert [found.pop("own").tolist() for found in ranks] == [whole[:2], whole[2:]]
    for found in ranks:
        assert found.keys() == alone.keys()
        for name, expected in alone.items():
            assert torch.equal(found[name], expected), name


def test_weights_that_are_spread_over_ranks_learn_as_whole_ones_do(
    toy_reviews: Reviews, models: Path, tmp_path: Path
) -> None:
    alone = spread_out(models)
    found = on_ranks(2, tmp_path / "ranks", spread_out, models)
    for name, expected in alone.items():
        first, second = (one[name] for one in found)
        if name.endswith("held"):
            assert int(first + second) == int(expected)
            assert float(first / expected) == pytest.approx(0.5, abs=0.01)
        else:
            assert torch.equal(first, second), name
            assert float((first - expected).norm() / expected.norm()) <= 1e-5, name
