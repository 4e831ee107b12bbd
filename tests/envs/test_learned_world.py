"""A learned world: it foresees what it was shown, says how far it is to be trusted, and knows nothing of tasks."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pytest
import torch

from prefrl.components import ConfigError
from prefrl.envs.fast.vectorised import Vectorised
from prefrl.envs.imagined import Branches, Dream, DreamtTask
from prefrl.envs.learned import Imagined, Transitions, World, WorldSettings
from prefrl.envs.toys import Point, PointSettings
from prefrl.policies.rollout import Rollout, collect
from prefrl.types import Bools, Floats

SMALL: dict[str, Any] = {"members": 3, "hidden": (16,), "fit_steps": 300, "minibatch": 64, "learning_rate": 1e-2}
CPU = torch.device("cpu")


def rollout(world: Any = None, seed: int = 0, steps: int = 20) -> Rollout:
    """Random pushes of points in the plane."""
    rng = np.random.default_rng(seed)
    envs = Vectorised(world or Point(), 20, 20)

    def act(observations: Floats, *_: object) -> tuple[Floats, Floats]:
        chosen = rng.uniform(-1, 1, (len(observations), 2)).astype(np.float32)
        return chosen, chosen

    return collect(envs, envs.reset(rng), steps, act)[0]


def world(**settings: object) -> World:
    return World(WorldSettings.model_validate(SMALL | settings), (2, 2), CPU, np.random.default_rng(0))


def seen(found: Rollout, share: float = 0.1) -> Transitions:
    return Transitions.of(found, share, np.random.default_rng(1))


@pytest.fixture(scope="module")
def fitted() -> World:
    found = world()
    found.fit(seen(rollout()), np.random.default_rng(2))
    return found


def test_a_world_foresees_steps_that_it_was_not_shown(fitted: World) -> None:
    new = seen(rollout(seed=5))
    after = fitted.imagine(new.observations, new.actions, np.zeros(len(new), np.int64)).observations
    off = np.abs(after - new.following).mean()
    assert off < 0.1 * np.abs(new.observations - new.following).mean()


def test_members_are_their_own_and_a_branch_follows_one(fitted: World) -> None:
    observations = np.full((6, 2), 0.3, np.float32)
    actions = np.full((6, 2), 0.5, np.float32)
    found = fitted.imagine(observations, actions, np.array([0, 1, 2, 0, 1, 2])).observations
    assert np.array_equal(found[:3], found[3:])
    assert len(np.unique(found[:3, 0])) == 3
    each = fitted.predict(torch.from_numpy(observations), torch.from_numpy(actions))[:, 0, :2]
    np.testing.assert_allclose(found[:3], each.detach().numpy(), rtol=1e-5)
    own = (torch.from_numpy(x).expand(3, -1, -1) for x in (observations, actions))
    tiled = fitted.predict(*own)
    np.testing.assert_allclose(tiled[:, 0, :2].detach().numpy(), each.detach().numpy(), rtol=1e-5)


def test_members_part_where_nothing_was_seen(fitted: World) -> None:
    near, far = np.zeros((50, 2), np.float32), np.full((50, 2), 6.0, np.float32)
    actions = np.random.default_rng(0).uniform(-1, 1, (50, 2)).astype(np.float32)
    there, here = (fitted.imagine(x, actions, np.zeros(50, np.int64)).parted.mean() for x in (far, near))
    assert there > 5 * here


def test_what_is_imagined_stays_near_what_was_seen(fitted: World) -> None:
    data = seen(rollout())
    both = np.concatenate([data.observations, data.following])
    margin = 0.1 * (both.max(0) - both.min(0))
    envs, rng = Branches(Dream(fitted, data.observations), 8, whole=200), np.random.default_rng(0)

    def outwards(observations: Floats, *_: object) -> tuple[Floats, Floats]:
        chosen = np.ones((len(observations), 2), np.float32)
        return chosen, chosen

    found = collect(envs, envs.reset(rng), 200, outwards)[0]
    assert (found.final_observations <= both.max(0) + margin + 1e-6).all()
    assert (found.final_observations >= both.min(0) - margin - 1e-6).all()


def test_a_fit_goes_on_from_the_one_before_though_other_steps_are_normalised_otherwise(fitted: World) -> None:
    again = world(fit_steps=1, learning_rate=1e-12)
    again.load(fitted.state())
    wide = seen(rollout())
    wide = replace(wide, observations=wide.observations * 3 + 1, following=wide.following * 3 + 1)
    steps = torch.from_numpy(wide.observations[:50]) / 4, torch.from_numpy(wide.actions[:50])
    before = fitted.predict(*steps)[..., :2]
    again.fit(wide, np.random.default_rng(0))
    torch.testing.assert_close(again.predict(*steps)[..., :2], before, rtol=1e-3, atol=1e-4)


def test_a_saved_world_is_the_same_to_the_byte_and_others_are_refused(fitted: World) -> None:
    again = world()
    again.load(fitted.state())
    data = seen(rollout(seed=3))
    for one in (again, fitted_copy := world()):
        one.load(fitted.state())
        one.fit(data, np.random.default_rng(4))
    members = np.arange(len(data)) % 3
    a, b = (one.imagine(data.observations, data.actions, members) for one in (again, fitted_copy))
    assert a.observations.tobytes() == b.observations.tobytes()
    assert again.reach == fitted_copy.reach
    with pytest.raises(ValueError, match="other settings or task"):
        world(hidden=(8,)).load(fitted.state())


def test_held_out_steps_are_never_learned_from() -> None:
    data = seen(rollout(), share=0.3)
    assert data.held_out.mean() == pytest.approx(0.3, abs=0.01)
    other = replace(data, following=np.where(data.held_out[:, None], np.roll(data.following, 7, 0), data.following))
    other = replace(other, following=np.clip(other.following, data.following.min(0), data.following.max(0)))
    worlds = [world(fit_steps=1), world(fit_steps=1)]  # of one step the last weights are kept, whatever is held out
    for found, one in zip(worlds, (data, other), strict=True):
        found.fit(one, np.random.default_rng(0))
    for layers in zip(*(found.state()["layers"] for found in worlds), strict=True):
        assert torch.equal(*layers)
    scales = [found.state()["scales"] for found in worlds]
    assert all(torch.equal(scales[0][name], scales[1][name]) for name in ("input_mean", "input_std", "change_std"))
    assert worlds[1].held_out > worlds[0].held_out


def falling(moves: int, steps: int = 100, seed: int = 0) -> Rollout:
    """One episode that lies still after so many steps."""
    rng, found = np.random.default_rng(seed), rollout(steps=steps)
    places = np.zeros((1, steps + 1, 2), np.float32)
    places[0, 1:] = rng.normal(size=2) + np.minimum(np.arange(1, steps + 1), moves)[:, None]
    actions, ends = rng.normal(size=(1, steps, 2)).astype(np.float32), np.zeros((1, steps), bool)
    if moves == 0:
        places[:], actions[:] = 0.0, 0.0
    seen: dict[str, Any] = {"observations": places[:, :-1], "final_observations": places[:, 1:], "actions": actions}
    return replace(found, **seen, choices=actions, terminated=ends, truncated=ends, gold=np.zeros((1, steps)))


@pytest.mark.parametrize(("moves", "held"), [(9, 1), (2, 1), (1, 0), (60, 6)])
def test_of_a_play_that_soon_lies_still_most_is_learned_from(moves: int, held: int) -> None:
    data = seen(falling(moves))
    assert data.held_out[data.moves].sum() == held
    metrics = world(fit_steps=2).fit(data, np.random.default_rng(0))
    assert all(math.isfinite(value) for value in metrics.values())
    assert metrics["world_steps"] == (0 if not held else (~data.held_out).sum())


def test_where_nothing_moves_something_is_learned_from_all_the_same() -> None:
    data = seen(falling(0))
    assert (len(data), data.held_out.sum()) == (1, 0)


def test_the_share_held_out_is_right_over_plays_that_are_short() -> None:
    rng, data = np.random.default_rng(0), seen(falling(9))
    for number in range(1, 41):
        new = Transitions.of(falling(3 + number % 8, seed=number), 0.1, rng, data)
        assert not new.held_out[new.moves].all()
        data = data.joined(new)
        assert data.held_out[data.moves].sum() == pytest.approx(0.1 * data.moves.sum(), abs=0.51)


# --- How far it is trusted -------------------------------------------------------------------------------------------


def noisy(data: Transitions) -> Transitions:
    """What follows has nothing to do with what went before."""
    return replace(data, following=np.random.default_rng(0).permutation(data.following))


def test_a_world_that_explains_nothing_is_not_to_be_dreamt_in(fitted: World) -> None:
    assert fitted.reach == fitted.settings.longest
    assert world().reach == 0  # before the first fit
    again = world()
    again.load(fitted.state())
    metrics = again.fit(noisy(seen(rollout())), np.random.default_rng(0))
    assert metrics["reach"] == 0
    assert again.error > 0.9


def test_branches_shorten_as_the_held_out_error_grows() -> None:
    reaches, clean = [], seen(rollout())
    for noise in (0.0, 0.02, 0.1):
        found = world(longest=1000)
        shaken = clean.following + noise * np.random.default_rng(3).normal(size=clean.following.shape)
        found.fit(replace(clean, following=shaken.astype(np.float32)), np.random.default_rng(0))
        reaches.append(found.reach)
    assert reaches[0] > 2 * reaches[1] > 4 * reaches[2]
    assert reaches[2] < 12


@dataclass
class Stub:
    """A world whose members part by so much in each step, and whose points go nowhere."""

    parting: float
    reach: int = 50
    members: int = 2
    terminates: bool = False
    settings = WorldSettings(tolerance=1.0)

    def imagine(self, observations: Floats, actions: Floats, members: np.ndarray) -> Any:
        over = np.full(len(members), self.terminates)
        return Imagined(observations + np.float32(1), over, np.full(len(members), self.parting))


def lengths(stub: Any, steps: int = 60) -> tuple[list[int], Rollout]:
    dream = Dream(stub, np.zeros((4, 1), np.float32))
    branches = Branches(dream, 3)
    start = branches.reset(np.random.default_rng(0))
    found, _ = collect(branches, start, steps, lambda observations, *_: (observations, observations))
    return dream.lengths, found


@pytest.mark.parametrize(("parting", "length"), [(0.0, 50), (0.05, 20), (0.3, 4), (2.0, 1)])
def test_a_branch_is_cut_where_members_have_parted_and_never_counts_as_an_end(parting: float, length: int) -> None:
    found, rolled = lengths(Stub(parting))
    assert set(found) == {length}
    assert not rolled.terminated.any()
    assert rolled.observations.max() == length - 1  # each begins in a start
    assert rolled.final_observations.max() == length
    assert np.isnan(rolled.gold).all()


def test_a_foreseen_termination_ends_a_branch_for_good() -> None:
    found, rolled = lengths(Stub(2.0, terminates=True))
    assert set(found) == {1}
    assert rolled.terminated.all()
    assert not rolled.truncated.any()


def test_terminations_are_foreseen_from_what_was_seen() -> None:
    @dataclass(frozen=True)
    class Cliff(Point):
        def advance(self, states: Floats, actions: Floats, rng: np.random.Generator) -> tuple[Floats, Floats, Bools]:
            after, rewards, _ = super().advance(states, actions, rng)
            return after, rewards, after[:, 0] > 0.5

    found, data = world(hidden=(32,), fit_steps=600), seen(rollout(Cliff(), steps=200))
    assert 0.02 < data.terminated.mean() < 0.5
    found.fit(data, np.random.default_rng(0))
    new = seen(rollout(Cliff(), seed=8))
    said = found.imagine(new.observations, new.actions, np.zeros(len(new), np.int64)).terminated
    assert (said == new.terminated).mean() > 0.9
    assert said[new.terminated].mean() >= 0.5


def test_moves_that_are_not_always_legal_are_refused() -> None:
    found = replace(rollout(), legal=np.ones((20, 20, 2), bool))
    with pytest.raises(ConfigError, match="does not know which actions are legal"):
        seen(found)


def test_a_dreamt_task_is_the_real_one_but_for_its_environments(fitted: World) -> None:
    real = PointSettings().build()
    found = DreamtTask(real, Dream(fitted, np.zeros((5, 2), np.float32)))
    told = "name", "kind", "horizon", "segment_steps", "observation_size", "action_size", "action_bounds", "fps"
    assert all(getattr(found, name) is getattr(real, name) or name == "fps" for name in told)
    envs = found.environments(4)
    assert envs.reset(np.random.default_rng(0)).tolist() == [[0.0, 0.0]] * 4
    assert envs.states() is None
    assert envs.legal() is None
    assert math.isnan(float(envs.step(np.zeros((4, 2), np.float32)).rewards[0]))
