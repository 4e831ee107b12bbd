"""Bookshelf files: what is read, what is left out, and how a fault is told."""

from pathlib import Path

import numpy as np
import pytest

from prefrl.envs.bookshelf import BOARD, Netlist, Pin, read

BLOCKS = """UCSC blocks 1.0
# a comment
NumHardRectilinearBlocks : 2
NumTerminals : 2

big hardrectilinear 4 (0, 0) (0, 30) (20, 30) (20, 0)
soft softrectangular 100 0.25 0.25
small\thardrectilinear 4 (1, 1) (1, 5) (9, 5) (9, 1)
p1 terminal
p2 terminal
"""
NETS = """NumNets : 3
NumPins : 7
NetDegree : 3
p1 B
big B : %50.0 %-50.0
small # no offset: its middle
NetDegree : 2
small B : %0 %25
p2
NetDegree : 2
big
soft B : %-50 %50
"""


@pytest.fixture
def blocks(tmp_path: Path) -> Path:
    (tmp_path / "chip.nets").write_text(NETS)
    (tmp_path / "chip.pl").write_text("p1 0 40\nsmall 3 3\n")
    path = tmp_path / "chip.blocks"
    path.write_text(BLOCKS)
    return path


def test_headers_of_both_universities_are_passed_over(blocks: Path) -> None:
    plain = read(blocks)
    for end, university in ((".blocks", "UCLA"), (".nets", "UCLA"), (".pl", "UCSC")):
        file = blocks.with_suffix(end)
        file.write_text(f"{university} {end[1:]} 1.0\n{file.read_text()}")
    assert read(blocks).nets == plain.nets


def test_blocks_nets_and_places_are_read(blocks: Path) -> None:
    found = read(blocks)
    assert found.name == "chip"
    assert found.macros == ("big", "soft", "small")
    np.testing.assert_allclose(found.sizes, [[20, 30], [5, 20], [8, 4]])
    assert found.nets == ((Pin(BOARD, 0, 40), Pin(0, 10, -15), Pin(2, 0, 0)), (Pin(0, 0, 0), Pin(1, -2.5, 10)))
    assert found.notes == (
        "1 of 2 terminals have no position, and are left out of the wire length, and 1 nets with them, which join "
        "nothing else",
    )
    assert found.outline is None  # one terminal in a corner goes around nothing


def test_the_largest_macros_come_first_and_keep_their_pins(blocks: Path) -> None:
    whole, ordered = read(blocks), read(blocks).by_size()
    assert ordered.macros == ("big", "soft", "small")
    back = Netlist(
        whole.name,
        whole.macros[::-1],
        whole.sizes[::-1],
        ((Pin(0, 1, 2), Pin(BOARD, 3, 4)), (Pin(1, 0, 0), Pin(2, 5, 6))),
    ).by_size()
    assert back.macros == ("big", "soft", "small")
    assert [*back.nets] == [(Pin(2, 1, 2), Pin(BOARD, 3, 4)), (Pin(1, 0, 0), Pin(0, 5, 6))]
    assert back.outline == pytest.approx((3, 4))
    nets, macros, offsets = back.pins()
    np.testing.assert_array_equal(nets, [0, 0, 1, 1])
    np.testing.assert_array_equal(macros, [2, BOARD, 1, 0])
    np.testing.assert_array_equal(offsets, [[1, 2], [3, 4], [0, 0], [5, 6]])


def test_terminals_of_the_places_file_need_no_line_among_the_blocks(blocks: Path) -> None:
    blocks.write_text(BLOCKS.replace("p1 terminal\np2 terminal\n", ""))
    blocks.with_suffix(".pl").write_text("p1 0 40\np2 50 0\n")
    found = read(blocks)
    assert (found.notes, len(found.nets), found.outline) == ((), 3, (50, 40))


FAULTS = {
    "a net of one pin": (".nets", "NetDegree : 3", "NetDegree : 1", "line 3: expected a net of at least two pins"),
    "other pins than told": (
        ".nets",
        "NetDegree : 3",
        "NetDegree : 4",
        "line 3: .* pins as follow, which are 3",
    ),
    "no number": (".nets", "NetDegree : 3", "NetDegree : many", "line 3: expected NetDegree : COUNT, got"),
    "pins of no net": (".nets", "NetDegree : 3\n", "", "line 3: expected NetDegree : COUNT before the first pin"),
    "unknown block": (".nets", "small #", "smal #", "line 6: expected a block or a terminal that the blocks' file has"),
    "half an offset": (".nets", "%50.0 %-50.0", "%50.0", r"line 5: expected NAME \[B\] \[: %X %Y\], got"),
    "three corners": (".blocks", " (20, 0)", "", r"line 6: expected a rectangle, of four corners \(x, y\), got 'big"),
    "flat": (".blocks", "(0, 30) (20, 30)", "(0, 0) (20, 0)", "line 6: expected a rectangle with a width and a height"),
    "no area": (".blocks", "100 0.25", "-1 0.25", "line 7: expected an area above 0"),
    "twice": (
        ".blocks",
        "p2 terminal",
        "big terminal",
        "line 10: .* differ, and big is there already",
    ),
    "unknown kind": (".blocks", "p2 terminal", "p2 pad", "line 10: expected NAME hardrectilinear"),
    "no place": (".pl", "0 40", "0", "line 1: expected NAME X Y, got 'p1 0'"),
    "not finite": (".pl", "0 40", "0 nan", "line 1: expected NAME X Y"),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_fault_is_told_with_its_file_and_line(blocks: Path, fault: str) -> None:
    suffix, old, new, message = FAULTS[fault]
    path = blocks.with_suffix(suffix)
    text = path.read_text()
    assert text.count(old) == 1
    path.write_text(text.replace(old, new))
    with pytest.raises(ValueError, match=rf"chip\{suffix}, {message}"):
        read(blocks)


def test_files_that_are_not_there_or_hold_nothing_are_told(blocks: Path, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"expected a Bookshelf file NAME\.blocks or NAME\.hardblocks"):
        read(blocks.with_suffix(".nets"))
    with pytest.raises(ValueError, match=r"other\.blocks: there is no such file; a netlist has other\.blocks"):
        read(tmp_path / "other.blocks")
    blocks.with_suffix(".nets").write_text("NumNets : 0\n")
    with pytest.raises(ValueError, match=r"chip\.nets: expected at least one net"):
        read(blocks)
    blocks.write_text("NumTerminals : 0\n")
    with pytest.raises(ValueError, match=r"chip\.blocks: expected at least one block"):
        read(blocks)
    blocks.write_bytes(b"\xff\xfe")
    with pytest.raises(ValueError, match="expected a text file"):
        read(blocks)


def test_a_netlist_made_by_hand_is_checked_as_well() -> None:
    sizes = np.ones((1, 2))
    with pytest.raises(ValueError, match="net 2 of own has 1 pin"):
        Netlist("own", ("a",), sizes, ((Pin(0, 0, 0), Pin(BOARD, 1, 1)), (Pin(0, 0, 0),)))
    with pytest.raises(ValueError, match="expected at least one macro, each with a width and a height above 0"):
        Netlist("own", ("a",), 0 * sizes, ())
