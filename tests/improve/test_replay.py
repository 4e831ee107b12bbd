"""Replay buffers of stable-baselines3 under a reward that changes."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from control_stubs import Ageing, Known
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete
from stable_baselines3.common.buffers import DictReplayBuffer, NStepReplayBuffer, ReplayBuffer

from prefrl.improve import replay
from prefrl.improve.replay import cut, relabel
from prefrl.improve.vec_env import executed, flattened

LINE = Box(-99.0, 99.0, (1,))
UNIT = Box(-1.0, 1.0, (1,))


def test_relabelling_sees_actions_as_they_were_executed() -> None:
    space = gymnasium.spaces.Box(np.array([-2.0], np.float32), np.array([6.0], np.float32))
    buffer = ReplayBuffer(6, gymnasium.spaces.Box(-1.0, 1.0, (1,)), space, n_envs=2)
    step = np.zeros((2, 1), np.float32)
    buffer.add(step, step, np.array([[-1.0], [0.5]], np.float32), np.zeros(2), np.zeros(2), [{}, {}])
    relabel(buffer, Known(lambda o, a: a[..., 0]))
    assert buffer.rewards[:1].tolist() == [[-2.0, 4.0]]
    assert not buffer.rewards[1:].any()


def test_a_buffer_that_keeps_more_than_transitions_is_refused() -> None:
    class Other(ReplayBuffer):  # type: ignore[misc]
        pass

    box = gymnasium.spaces.Box(-1.0, 1.0, (1,))
    with pytest.raises(ValueError, match="NStepReplayBuffer, DictReplayBuffer, got Other"):
        relabel(Other(4, box, box), Known())


def test_relabelling_follows_the_ring_through_ends_and_resets() -> None:
    box = gymnasium.spaces.Box(-1.0, 1.0, (1,))
    buffer = ReplayBuffer(8, gymnasium.spaces.Box(-99.0, 99.0, (1,)), box, n_envs=1)
    place = 0.0
    for t in range(11):  # the ring is overwritten from its start; slot 2 then holds the newest step
        observation, done = np.array([[place]], np.float32), t == 5
        buffer.add(observation, observation + 1, np.zeros((1, 1)), np.zeros(1), np.array([done]), [{}])
        place = 50.0 if t == 8 else place + 1  # a reset without an end, as between two rounds
    relabel(buffer, Ageing())
    assert buffer.rewards[:, 0].tolist() == [3, 1, 2, 1, 2, 3, 1, 2]


def filled(buffer: ReplayBuffer, steps: int, ends: tuple[int, ...] = ()) -> None:
    """Two environments that count their steps from 0 and from 50, and end after some of them."""
    for t in range(steps):
        now = np.array([[t], [50 + t]], np.float32)
        buffer.add(now, now + 1, np.zeros((2, 1)), np.zeros(2), np.full(2, t in ends), [{}, {}])


def test_sums_over_several_steps_are_of_the_newest_rewards_in_a_ring_that_wraps() -> None:
    buffer = NStepReplayBuffer(12, LINE, UNIT, device="cpu", n_envs=2, n_steps=3, gamma=0.5)
    filled(buffer, 8, ends=(5,))  # six slots: 6, 7, 2, 3, 4, 5
    relabel(buffer, Known(lambda o, a: 10.0 * o[..., 0]))
    assert buffer.rewards.tolist() == [[10.0 * t, 500.0 + 10.0 * t] for t in (6, 7, 2, 3, 4, 5)]
    np.random.seed(0)
    drawn = buffer.sample(200)
    sums = {2.0: 20 + 15 + 10, 3.0: 30 + 20 + 12.5, 4.0: 40 + 25, 5.0: 50, 6.0: 60 + 35, 7.0: 70}
    sums |= {
        50.0 + t: x + {3: 875, 2: 750, 1: 500}[n] for (t, x), n in zip(sums.items(), (3, 3, 2, 1, 2, 1), strict=True)
    }
    found = dict(zip(drawn.observations[:, 0].tolist(), drawn.rewards[:, 0].tolist(), strict=True))
    assert found == sums


def test_sums_over_several_steps_stop_where_the_environments_are_reset() -> None:
    buffer = NStepReplayBuffer(20, LINE, UNIT, device="cpu", n_envs=2, n_steps=3, gamma=1.0)
    filled(buffer, 3)
    cut(buffer)
    filled(buffer, 3)
    relabel(buffer, Known(lambda o, a: 1.0 + 0.0 * o[..., 0]))
    drawn = buffer._get_samples(np.array([0, 1, 2, 3]))
    assert drawn.rewards[:, 0].tolist() == [3.0, 2.0, 1.0, 3.0]
    assert drawn.dones.sum() == 0  # what the last step led to still has a value
    assert drawn.next_observations[:3, 0].remainder(50).tolist() == [3.0, 3.0, 3.0]


def test_a_termination_before_a_reset_stays_one() -> None:
    buffer = ReplayBuffer(20, LINE, UNIT, device="cpu", n_envs=2)
    filled(buffer, 3, ends=(2,))
    cut(buffer)
    assert buffer._get_samples(np.array([2])).dones.tolist() == [[1.0]]


def test_a_reward_sees_the_parts_of_a_dict_as_one_row() -> None:
    space = Dict({"b": Discrete(3, start=1), "a": Box(-9.0, 9.0, (2,))})
    buffer = DictReplayBuffer(8, space, UNIT, n_envs=2)
    now = {"b": np.array([1, 3]), "a": np.array([[1.0, 2.0], [3.0, 4.0]], np.float32)}
    for _ in range(5):
        buffer.add(dict(now), dict(now), np.zeros((2, 1)), np.zeros(2), np.zeros(2), [{}, {}])
    relabel(buffer, Known(lambda o, a: o @ np.array([1.0, 10.0, 100.0, 1000.0, 10000.0])))
    # Parts by name, as gymnasium flattens them.
    expected = [1.0 + 20.0 + 100.0, 3.0 + 40.0 + 10000.0]
    assert buffer.rewards.tolist() == [expected] * 4
    np.testing.assert_array_equal(
        gymnasium.spaces.flatten(space, {"b": 3, "a": now["a"][1]}), [3.0, 4.0, 0.0, 0.0, 1.0]
    )


@pytest.mark.parametrize("steps", [7, 13])
def test_a_ring_that_is_scored_in_pieces_is_scored_as_a_whole(steps: int, monkeypatch: pytest.MonkeyPatch) -> None:
    rewards = []
    for piece in (replay.PIECE, 4, 1):
        monkeypatch.setattr(replay, "PIECE", piece)
        buffer = ReplayBuffer(20, LINE, UNIT, n_envs=2)
        filled(buffer, steps, ends=(4,))
        relabel(buffer, Ageing())
        rewards.append(buffer.rewards[: buffer.size()].tolist())
    assert rewards[0] == rewards[1] == rewards[2]
    assert max(rewards[0]) == [4.0, 4.0]


def test_several_choices_are_seen_as_gymnasium_and_a_task_see_them() -> None:
    space = Dict({"hands": MultiDiscrete([2, 3], start=[1, 0]), "lamps": MultiBinary(2)})
    space.seed(0)
    rows = [space.sample() for _ in range(20)]
    seen = {name: np.stack([row[name] for row in rows]) for name in space}
    np.testing.assert_array_equal(flattened(space, seen), [gymnasium.spaces.flatten(space, row) for row in rows])
    hands, lamps = (executed(space[name], seen[name]).argmax(1) for name in space)
    np.testing.assert_array_equal(hands, 3 * (seen["hands"][:, 0] - 1) + seen["hands"][:, 1])
    np.testing.assert_array_equal(lamps, 2 * seen["lamps"][:, 0] + seen["lamps"][:, 1])
    with pytest.raises(ValueError, match="at most 1024 combinations, got MultiBinary"):
        executed(MultiBinary(11), np.zeros((1, 11)))
