"""Wire length, congestion and masks of plans, against sums by hand."""

import numpy as np
import pytest

from prefrl.envs.bookshelf import BOARD, Netlist, Pin
from prefrl.envs.chips import Chip
from prefrl.envs.floorplan import generated
from prefrl.envs.plans import CELLS, Floorplan, random_plans
from prefrl.types import Floats, Integers

TWO = Netlist(
    "two",
    ("a", "b"),
    np.array([[3.0, 2.0], [2.0, 2.0]]),
    (
        (Pin(0, 0.0, 0.0), Pin(1, 0.5, -1.0)),
        (Pin(BOARD, 8.0, 8.0), Pin(0, 1.5, 1.0)),
        (Pin(0, -1.5, 0.0), Pin(0, 1.5, 0.0), Pin(1, 0.0, 0.0)),
    ),
)
CHIP = Chip(TWO, 8.0, 8.0, grid=4)


def cells(*places: tuple[int, int] | None) -> Integers:
    """(1, M) from columns and rows."""
    return np.array([[-1 if place is None else place[1] * CHIP.grid + place[0] for place in places]])


def by_hand(places: Floats) -> float:
    """The wire length of `TWO` with its corners at these places."""
    a, b = places + TWO.sizes / 2
    nets = (
        np.array([a, b + np.array([0.5, -1.0])]),
        np.array([[8.0, 8.0], a + np.array([1.5, 1.0])]),
        np.array([a - np.array([1.5, 0]), a + np.array([1.5, 0]), b]),
    )
    return float(sum(np.ptp(net, 0).sum() for net in nets))


def test_macros_take_every_cell_that_they_touch() -> None:
    assert CHIP.spans.tolist() == [[2, 1], [1, 1]]
    assert CHIP.middles(cells((1, 2), (0, 3))).tolist() == [[[3.5, 5.0], [1.0, 7.0]]]


@pytest.mark.parametrize("places", [((0, 0), (2, 0)), ((1, 3), (0, 0)), ((2, 2), (3, 0))])
def test_the_wire_length_is_half_of_the_nets_perimeters(places: tuple[tuple[int, int], ...]) -> None:
    expected = by_hand(np.array(places) * 2.0)
    assert CHIP.wire(CHIP.boxes(cells(*places))) == pytest.approx([expected])


def test_what_does_not_lie_anywhere_adds_no_wire() -> None:
    assert CHIP.wire(CHIP.boxes(cells(None, None))).tolist() == [0.0]
    # a alone: from its pin at (5, 2) to the board's at (8, 8), and 3 between its own two pins of the third net.
    assert CHIP.wire(CHIP.boxes(cells((1, 0), None))) == pytest.approx([3 + 6 + 3])


def test_the_wire_mask_is_what_a_macro_at_each_cell_adds() -> None:
    for lying, macro in ((None, 1), ((1, 2), 1)):
        before = cells(lying, None)
        mask = CHIP.added(macro, CHIP.boxes(before))[0]
        for row in range(4):
            for column in range(4):
                after = cells(lying, (column, row))
                grown = CHIP.wire(CHIP.boxes(after)) - CHIP.wire(CHIP.boxes(before))
                assert mask[row, column] == pytest.approx(grown[0])


def test_a_macro_without_nets_adds_no_wire_anywhere() -> None:
    alone = Chip(Netlist("alone", ("a", "b"), TWO.sizes, ((Pin(0, 0, 0), Pin(BOARD, 8, 8)),)), 8.0, 8.0, 4)
    assert not alone.added(1, alone.boxes(cells(None, None))).any()


def test_a_macro_fits_where_it_is_inside_and_touches_no_other() -> None:
    free = CHIP.free(0, cells(None, (2, 1)))[0]
    expected = np.ones((4, 4), bool)
    expected[:, 3] = False  # two columns wide
    expected[1, 1:3] = False  # b lies there
    np.testing.assert_array_equal(free, expected)


def test_masks_leave_no_overlap_in_any_plan() -> None:
    world = Floorplan(Chip(generated(6), 520.0, 520.0, 20))
    plans = random_plans(world, 40, np.random.default_rng(0))[:, CELLS:].astype(int)
    chip = world.chip
    for plan in plans:
        taken = np.zeros((20, 20), int)
        for macro, cell in enumerate(plan):
            if cell >= 0:
                column, row = cell % 20, cell // 20
                width, height = chip.spans[macro]
                assert column + width <= 20
                assert row + height <= 20
                taken[row : row + height, column : column + width] += 1
        assert taken.max() == 1


def test_wire_is_spread_evenly_over_a_nets_box() -> None:
    """One net from the middle of the chip to a corner: all of its length lies in the bins that it covers."""
    one = Netlist("one", ("a",), np.array([[2.0, 2.0]]), ((Pin(0, 0, 0), Pin(BOARD, 8, 8)),))
    chip = Chip(one, 8.0, 8.0, grid=4, bins=4)
    boxes = chip.boxes(np.array([[1 * 4 + 1]]))  # its middle is at (3, 3)
    demand = chip.demand(boxes)[0]
    assert demand.sum() * 2.0 == pytest.approx(10.0)  # bins are 2 wide, the wire 10 long
    share = np.array([0.0, 0.5, 1.0, 1.0]) / 2.5
    np.testing.assert_allclose(demand, np.outer(share, share) * 10 / 2.0)
    # The fullest tenth of 16 bins are two of them.
    assert chip.congestion(boxes) == pytest.approx([10 / 2.0 / 2.5**2])


def test_straight_wires_run_through_one_bins_width() -> None:
    one = Netlist("one", ("a",), np.array([[2.0, 2.0]]), ((Pin(0, 0, -0.5), Pin(BOARD, 8, 2.5)),))
    chip = Chip(one, 8.0, 8.0, grid=4, bins=4)
    demand = chip.demand(chip.boxes(np.array([[1 * 4 + 1]])))[0]  # from (3, 2.5) to (8, 2.5)
    # Of two units of width, half a unit is in the lowest bins.
    np.testing.assert_allclose(demand.sum(1), [0.25 * 2.5, 0.75 * 2.5, 0.0, 0.0])


def test_a_macro_larger_than_the_chip_is_refused() -> None:
    with pytest.raises(ValueError, match=r"macro a is 3 x 2, and the chip 8 x 1\.5: make the chip larger"):
        Chip(TWO, 8.0, 1.5, 4)
