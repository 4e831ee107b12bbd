"""Tables as a world to act in, and the grid that makes some."""

import numpy as np
import pytest
from small_worlds import policy, world

from prefrl.components import ConfigError
from prefrl.envs.exact import objective, policy_iteration, stationary
from prefrl.envs.fast.vectorised import Vectorised
from prefrl.envs.tabular import Grid, GridworldSettings, Tabular, table
from prefrl.envs.toys import INK


def test_what_happens_is_as_probable_as_the_tables_say() -> None:
    mdp, rng = world(1), np.random.default_rng(0)
    tabular, count = Tabular(mdp), 200_000
    assert np.bincount(tabular.start(count, rng)[:, 0].astype(int), minlength=5) / count == pytest.approx(
        mdp.start, abs=4e-3
    )
    states, actions = np.full((count, 1), 3.0), np.eye(3)[np.full(count, 2)]
    after, rewards, ended = tabular.advance(states, actions, rng)
    assert np.bincount(after[:, 0].astype(int), minlength=5) / count == pytest.approx(mdp.transitions[3, 2], abs=4e-3)
    assert (rewards == mdp.rewards[3, 2]).all()
    assert not ended.any()
    assert tabular.observe(after[:4]).argmax(1).tolist() == after[:4, 0].tolist()
    with pytest.raises(ValueError, match="have no places"):
        tabular.picture(after[0], 16)


def test_returns_of_episodes_come_to_the_exact_one() -> None:
    mdp, rng, episodes = world(2), np.random.default_rng(1), 20_000
    acts = policy(2, mdp)
    environments = Vectorised(Tabular(mdp), episodes, 7)
    seen, returns = environments.reset(rng), np.zeros(episodes)
    for _ in range(6):
        chosen = (rng.random((episodes, 1)) > acts[seen.argmax(1)].cumsum(1)).sum(1)
        step = environments.step(np.eye(3, dtype=np.float32)[chosen])
        returns += step.rewards
        seen = step.observations
    error = returns.std() / np.sqrt(episodes)
    assert returns.mean() == pytest.approx(objective(mdp, acts, 6), abs=4 * error)


def test_a_grid_is_walked_as_it_is_drawn() -> None:
    grid = Grid(("S.#", "xG."), slip=0.2)
    mdp = grid.mdp()
    assert grid.cells == {(0, 0): 0, (0, 1): 1, (1, 0): 2, (1, 1): 3, (1, 2): 4}
    assert mdp.rewards[:, 0].tolist() == [0, 0, -1, 1, 0]
    up, right = 0, 1
    np.testing.assert_allclose(mdp.transitions[0, right], [0.1, 0.8, 0.1, 0, 0])  # up is the edge: it stays
    np.testing.assert_allclose(mdp.transitions[1, right], [0, 0.9, 0, 0.1, 0])  # a wall, and the edge above
    np.testing.assert_allclose(mdp.transitions[4, up], [0, 0, 0, 0.1, 0.9])
    np.testing.assert_allclose(mdp.transitions[3, up], [1, 0, 0, 0, 0])  # a goal: the walker begins anew
    np.testing.assert_array_equal(grid.spread(np.arange(5.0)), [[0, 1, np.nan], [2, 3, 4]])
    drawn = grid.picture(1, 60)
    assert drawn.shape == (60, 60, 3)
    assert tuple(drawn[10, 30]) == INK
    assert len({tuple(drawn[y, x]) for y, x in ((10, 10), (10, 50), (30, 10), (30, 30))}) == 4


def test_every_policy_that_errs_has_one_stationary_distribution_on_the_grid_of_the_preset() -> None:
    world = GridworldSettings().world()
    best, _ = policy_iteration(world.mdp)
    mu = stationary(world.mdp, 0.9 * best + 0.025)
    assert mu.min() > 0
    acted = table(lambda observed: best[observed.argmax(1)], len(best))
    np.testing.assert_array_equal(acted, best)


@pytest.mark.parametrize(
    ("rows", "says"),
    [
        (["S.", "G"], r"task.rows: expected rows of one length, got lengths \[2, 1\]"),
        ([], "task.rows: expected rows of one length"),
        (["SG?"], r"task.rows: unknown cells \['\?'\]"),
        (["S.."], "task.rows: expected a cell S, .* and a cell G"),
    ],
)
def test_rows_that_are_no_grid_are_refused(rows: list[str], says: str) -> None:
    with pytest.raises(ConfigError, match=says):
        GridworldSettings.model_validate({"rows": rows}).build()


def test_a_segment_longer_than_an_episode_is_refused() -> None:
    with pytest.raises(ConfigError, match="segment of 5 steps is longer than an episode of 4"):
        GridworldSettings(horizon=4).build()
