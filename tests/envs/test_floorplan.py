"""The task of floorplans: what its settings refuse before a run is spent, and what it tells."""

from pathlib import Path

import numpy as np
import pytest

from prefrl.components import ConfigError
from prefrl.envs.floorplan import FloorplanSettings, FloorplanTask, generated
from prefrl.envs.plans import CELLS, random_plans
from prefrl.policies.rollout import whole_episodes
from prefrl.protocols import Mapped
from prefrl.sample.segments import cut
from prefrl.types import Bools, Floats

SHARED = Path(__file__).resolve().parents[3] / "shared" / "data" / "floorplan"


@pytest.fixture(scope="module")
def task() -> FloorplanTask:
    return FloorplanSettings(macros=5, grid=12, frame_size=48).build()


def first_legal(observations: Floats, legal: Bools | None, begins: Bools) -> tuple[Floats, Floats]:
    assert legal is not None
    actions = np.eye(legal.shape[1], dtype=np.float32)[legal.argmax(1)]
    return actions, actions


def test_a_segment_is_a_whole_plan_and_is_drawn_from_what_was_seen(task: FloorplanTask) -> None:
    rng = np.random.default_rng(0)
    rollout = whole_episodes(task, first_legal, 2, rng)
    segments = cut(rollout, task.segment_steps, 2, "round 0", rng)
    assert [len(one) for one in segments] == [6, 6]
    frames = task.frames(segments[0])
    assert frames.shape == (6, 48, 48, 3)
    final = task.world.seen(rollout.final_observations[:1, -1])
    np.testing.assert_array_equal(frames[-1], task.world.picture(task.world.seen(rollout.observations[0, -1:])[0], 48))
    assert (final[0, CELLS:] >= 0).all()


def test_what_it_tells_of_actions_is_what_its_world_does(task: FloorplanTask) -> None:
    assert isinstance(task, Mapped)
    states = random_plans(task.world, 3, np.random.default_rng(0))
    states[:, 0], states[:, -1] = 4, -1
    seen = task.world.observe(states)
    np.testing.assert_array_equal(task.legal(seen), task.world.legal(states))
    np.testing.assert_allclose(task.told(seen), task.world.maps(states), atol=1e-4)
    assert task.told(seen).shape == (3, task.action_size, len(task.maps))


def test_random_plans_are_the_unit(task: FloorplanTask) -> None:
    totals = random_plans(task.world, 64, np.random.default_rng(0))[:, 1:3].mean(0)
    np.testing.assert_allclose(totals, 1.0)


def test_the_same_number_of_macros_is_the_same_netlist() -> None:
    assert generated(6).nets == generated(6).nets
    assert generated(6).nets != generated(7).nets
    for macros in (4, 5, 7, 12):
        assert FloorplanSettings(macros=macros).build().notes == ()


BLOCKS = "a hardrectilinear 4 (0, 0) (0, 6) (6, 6) (6, 0)\nb hardrectilinear 4 (0, 0) (0, 5) (5, 5) (5, 0)\n"


def test_bad_input_is_refused_before_a_run_is_spent(tmp_path: Path) -> None:
    path, nets = tmp_path / "own.blocks", tmp_path / "own.nets"
    path.write_text(BLOCKS)
    nets.write_text("NetDegree : 2\na\nb\n")
    with pytest.raises(ConfigError, match=r"task\.netlist: macro a is 6 x 6, and the chip 5 x 9: make the chip larger"):
        FloorplanSettings(netlist=path, chip=(5, 9)).build()
    with pytest.raises(ConfigError, match=r"task\.chip: in \d+ of 64 random plans there is no legal move left"):
        FloorplanSettings(netlist=path, chip=(11, 11)).build()
    (note,) = FloorplanSettings(netlist=path, chip=(14.2, 14.2), grid=64).build().notes
    assert "no legal move left for a macro, the largest of them b" in note
    nets.write_text("NetDegree : 1\na\n")
    with pytest.raises(ConfigError, match=r"task\.netlist: .*own\.nets, line 1: expected a net of at least two pins"):
        FloorplanSettings(netlist=path).build()
    nets.write_text("NetDegree : 2\na : %0 %0\na : %0 %0\n")
    with pytest.raises(ConfigError, match=r"task\.netlist: the nets of own have no length in any plan"):
        FloorplanSettings(netlist=path, chip=(30, 30)).build()
    with pytest.raises(ConfigError, match=r"there is no such file"):
        FloorplanSettings(netlist=tmp_path / "other.blocks").build()


KNOWN = {
    "n10.hardblocks": (10, 118, 0),
    "n30.hardblocks": (30, 349, 0),
    "ami33.blocks": (33, 85, 42),
    "ami49.blocks": (49, 390, 22),
}


@pytest.mark.skipif(not SHARED.is_dir(), reason="the benchmark's netlists are not here")
@pytest.mark.parametrize("name", KNOWN)
def test_the_public_netlists_are_read_whole(name: str) -> None:
    macros, nets, lost = KNOWN[name]
    task = FloorplanSettings(netlist=SHARED / name).build()
    assert (task.horizon, len(task.world.chip.netlist.nets)) == (macros + 1, nets)
    assert [note.split(" terminals")[0] for note in task.notes] == ([f"{lost} of {lost}"] if lost else [])
