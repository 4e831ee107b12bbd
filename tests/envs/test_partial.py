"""What a policy does not see: hidden numbers, moments without sight, and the last observations at once."""

from __future__ import annotations

from typing import Any

import numpy as np

from prefrl.envs.control import ControlSettings
from prefrl.protocols import Environments


def built(**settings: Any) -> tuple[Environments, int]:
    task = ControlSettings.model_validate({"env": "Pendulum-v1", "horizon": 6, "segment_steps": 2, **settings}).build()
    return task.environments(3), task.observation_size


def played(steps: int, **settings: Any) -> tuple[list[np.ndarray], list[np.ndarray], int]:
    """The observations to act on, and those that steps led to."""
    envs, size = built(**settings)
    seen, final = [envs.reset(np.random.default_rng(0))], []
    for _ in range(steps):
        step = envs.step(np.full((3, 1), 0.5, np.float32))
        seen.append(step.observations)
        final.append(step.final_observations)
    return seen, final, size


def test_hidden_numbers_are_left_out_and_the_rest_happens_as_before() -> None:
    whole, whole_final, _ = played(8)
    seen, final, size = played(8, hide=[2])
    assert size == 2
    for one, other in zip([*seen, *final], [*whole, *whole_final], strict=True):
        np.testing.assert_array_equal(one, other[:, :2])


def test_the_last_observations_are_seen_at_once_the_oldest_first_and_none_of_another_episode() -> None:
    whole, whole_final, _ = played(8)
    seen, final, size = played(8, stack=3)
    assert size == 9
    np.testing.assert_array_equal(seen[0], np.tile(whole[0], 3))
    np.testing.assert_array_equal(seen[4], np.concatenate(whole[2:5], 1))
    # The sixth step is the episode's last: it led to one observation, and the next one begins another.
    np.testing.assert_array_equal(final[5], np.concatenate([*whole[4:6], whole_final[5]], 1))
    np.testing.assert_array_equal(seen[6], np.tile(whole[6], 3))
    np.testing.assert_array_equal(seen[7], np.concatenate([whole[6], whole[6], whole[7]], 1))


def test_what_flickers_is_all_zeros_as_often_as_said_and_otherwise_as_before() -> None:
    whole, _, _ = played(300)
    seen, _, _ = played(300, flicker=0.3)
    dark = np.array([(one == 0).all(1) for one in seen])
    assert 0.25 < dark.mean() < 0.35
    for one, other, hidden in zip(seen, whole, dark, strict=True):
        np.testing.assert_array_equal(one[~hidden], other[~hidden])


def test_a_policy_learns_from_what_it_sees_of_the_last_steps(tmp_path: Any) -> None:
    """A whole small run, so that segments, the reward model and evaluation all have the one size."""
    from prefrl import Config
    from prefrl.stages import shrink
    from prefrl.store import Store

    config = shrink(Config.load("control/pendulum", ["task.hide=[2]", "task.stack=2", "task.flicker=0.1"]))
    with Store[Any](tmp_path) as store:
        assert [one.number for one in config.build(store).run()] == [0, 1]
