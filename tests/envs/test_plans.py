"""Floorplans as a world: what a step does, what is seen of it, and what is legal."""

import numpy as np
import pytest

from prefrl.envs.bookshelf import BOARD, Netlist, Pin
from prefrl.envs.chips import Chip
from prefrl.envs.fast.vectorised import Vectorised
from prefrl.envs.floorplan import FloorplanSettings, generated
from prefrl.envs.plans import (
    ADDED_WIRE,
    AGE,
    CELLS,
    CONGESTION,
    MAPS,
    WIRE,
    Floorplan,
    Units,
    greedy_plans,
    random_plans,
)
from prefrl.types import Floats

WORLD = Floorplan(Chip(generated(4), 520.0, 520.0, 10), Units(20_000.0, 5.0), (1.0, 0.25))


def one_hot(cells: list[int]) -> Floats:
    return np.eye(WORLD.actions, dtype=np.float32)[cells]


def played(world: Floorplan, count: int, seed: int) -> tuple[list[Floats], list[Floats]]:
    """The states of some random plans, one more than there are steps, and the gold of each step."""
    rng = np.random.default_rng(seed)
    golds: list[Floats] = []
    states = [world.start(count, rng)]
    for _ in range(world.horizon):
        chosen = (rng.random((count, world.actions)) * world.legal(states[-1])).argmax(1)
        following, gold, ended = world.advance(states[-1], np.eye(world.actions)[chosen], rng)
        assert ended.tolist() == [len(golds) == world.horizon - 1] * count
        states.append(following)
        golds.append(gold)
    return states, golds


def test_the_golds_of_an_episode_add_up_to_its_plans() -> None:
    states, golds = played(WORLD, 7, 0)
    cells = states[-1][:, CELLS:].astype(int)
    boxes, empty = WORLD.chip.boxes(cells), WORLD.chip.boxes(np.full((1, 4), -1))
    wire = (WORLD.chip.wire(boxes) - WORLD.chip.wire(empty)) / 20_000.0
    congestion = (WORLD.chip.congestion(boxes) - WORLD.chip.congestion(empty)) / 5.0
    np.testing.assert_allclose(np.sum(golds, 0), -(wire + 0.25 * congestion))
    assert (cells >= 0).all()
    assert not golds[-1].any()  # the look at the whole plan adds nothing
    assert np.ptp(np.sum(golds, 0)) > 0


def test_an_action_places_the_next_macro_and_nothing_else() -> None:
    start = WORLD.start(2, np.random.default_rng(0))
    after, _, _ = WORLD.advance(start, one_hot([23, 0]), np.random.default_rng(0))
    assert after[:, CELLS:].tolist() == [[23, -1, -1, -1], [0, -1, -1, -1]]
    assert after[:, AGE].tolist() == [1, 1]
    assert (start[:, CELLS:] == -1).all()  # which are not written into


def test_observations_say_all_that_a_state_does() -> None:
    states, _ = played(WORLD, 5, 1)
    for one in states:
        seen = WORLD.observe(one)
        assert seen.dtype == np.float32
        assert seen.shape == (5, WORLD.observation_size)
        np.testing.assert_allclose(WORLD.seen(seen), one, atol=1e-5)
        np.testing.assert_array_equal(WORLD.legal(WORLD.seen(seen)), WORLD.legal(one))


def test_the_first_numbers_seen_are_what_the_last_step_added() -> None:
    states, golds = played(WORLD, 5, 2)
    for after, gold in zip(states[1:], golds, strict=True):
        np.testing.assert_allclose(WORLD.observe(after)[:, :2] @ [1.0, 0.25], -gold, atol=1e-5)


def test_rows_of_different_ages_are_told_apart() -> None:
    states, _ = played(WORLD, 3, 3)
    mixed = np.stack([states[3][0], states[0][1], states[4][2], states[2][1]])
    legal, maps = WORLD.legal(mixed), WORLD.maps(mixed)
    for row, (age, which) in enumerate([(3, 0), (0, 1), (4, 2), (2, 1)]):
        np.testing.assert_array_equal(legal[row], WORLD.legal(states[age])[which])
        np.testing.assert_allclose(maps[row], WORLD.maps(states[age])[which], atol=1e-6)


def test_in_the_last_step_there_is_one_action() -> None:
    states, _ = played(WORLD, 3, 4)
    assert WORLD.legal(states[-2]).sum(1).tolist() == [1, 1, 1]
    assert WORLD.legal(states[-2])[:, 0].all()
    assert not WORLD.maps(states[-2]).any()


def test_the_wire_map_is_what_a_step_adds_beyond_the_best_one() -> None:
    states, _ = played(WORLD, 1, 5)
    here, rng = states[2], np.random.default_rng(0)
    legal = np.flatnonzero(WORLD.legal(here)[0])
    after, _, _ = WORLD.advance(np.repeat(here, len(legal), 0), one_hot(legal.tolist()), rng)
    added = after[:, ADDED_WIRE]
    told = WORLD.maps(here)[0, legal]
    np.testing.assert_allclose(told[:, 0], (added - added.min()) * WORLD.chip.macros, atol=1e-4)
    middles = WORLD.observe(after).reshape(len(legal), -1)[:, 4 + WORLD.horizon + 4 + 4 :][:, :2]  # the third macro's
    np.testing.assert_allclose(told[:, 1:3], middles, atol=1e-5)
    np.testing.assert_allclose(
        told[:, 3:6], np.stack([middles[:, 0] ** 2, middles[:, 1] ** 2, middles.prod(1)], 1), atol=1e-5
    )
    assert set(told[:, MAPS.index("edges")].tolist()) == {0.0, 1.0, 2.0}


def test_greedy_plans_take_the_place_that_adds_least() -> None:
    rng = np.random.default_rng(0)
    greedy, random = (make(WORLD, 30, rng)[:, WIRE].mean() for make in (greedy_plans, random_plans))
    assert greedy < 0.9 * random
    states = WORLD.start(1, rng)
    least = min(
        WORLD.advance(states, one_hot([int(cell)]), rng)[0][0, WIRE] for cell in np.flatnonzero(WORLD.legal(states)[0])
    )
    after = greedy_plans(WORLD, 1, rng)[:, CELLS:].astype(int)
    after[:, 1:] = -1
    assert WORLD.chip.wire(WORLD.chip.boxes(after)) / WORLD.units.wire == pytest.approx([least])


def test_a_macro_that_fits_nowhere_is_left_out_and_counts_as_a_random_plan() -> None:
    tight = Netlist("tight", ("a", "b"), np.full((2, 2), 4.0), ((Pin(0, 0, 0), Pin(1, 0, 0), Pin(BOARD, 0, 0)),))
    world = Floorplan(Chip(tight, 8.0, 8.0, 8), Units(10.0, 1.0), (1.0, 0.0))
    rng = np.random.default_rng(0)
    state, _, _ = world.advance(world.start(1, rng), np.eye(64)[[2 * 8 + 2]], rng)  # in the middle
    assert world.legal(state)[0].nonzero()[0].tolist() == [0]
    after, gold, _ = world.advance(state, np.eye(64)[[0]], rng)
    assert after[0, CELLS:].tolist() == [18, -1]
    assert gold.tolist() == [-1.0]
    assert world.maps(state).shape == (1, 64, len(MAPS))
    assert np.isfinite(world.maps(state)).all()


def test_all_of_it_is_stepped_side_by_side_by_the_one_vectoriser() -> None:
    envs = Vectorised(WORLD, 3, WORLD.horizon)
    envs.reset(np.random.default_rng(0))
    for age in range(2 * WORLD.horizon):
        legal, states = envs.legal(), envs.states()
        assert legal is not None
        assert states is not None
        assert states[:, AGE].tolist() == [age % WORLD.horizon] * 3
        step = envs.step(np.eye(WORLD.actions, dtype=np.float32)[legal.argmax(1)])
        assert not step.truncated.any()
    with pytest.raises(ValueError, match="is not legal there"):
        envs.step(np.eye(WORLD.actions, dtype=np.float32)[[99, 99, 99]])


def test_pictures_show_macros_where_they_lie() -> None:
    world = FloorplanSettings(macros=4, grid=10).build().world
    states, _ = played(world, 1, 0)
    first, whole = (world.picture(states[age][0], 100) for age in (0, 4))
    assert whole.shape == (100, 100, 3)
    assert whole.dtype == np.uint8
    assert (first == world.picture(states[0][0], 100)).all()
    column, row = world.chip.middles(states[4][:, CELLS:].astype(int))[0, 3] / world.chip.extent
    at = round(100 * (0.97 - 0.94 * row)), round(100 * (0.03 + 0.94 * column))
    near = np.s_[at[0] - 3 : at[0] + 3, at[1] - 3 : at[1] + 3]
    assert (first[near].mean((0, 1)) > whole[near].mean((0, 1)) + 20).all()  # a macro, where there was paper
    before, after = (
        (one[..., 0].astype(int) - one[..., 2] > 50).sum() for one in (world.picture(states[3][0], 100), whole)
    )
    assert before > 4 * after  # the newest stands out in orange, and not in the whole plan
    assert states[4][0, CONGESTION] > 0
