"""The fast environments through gymnasium's and stable-baselines3's own interfaces."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import DummyVecEnv, VecMonitor, VecNormalize

from prefrl.envs.fast.wrapped import make
from prefrl.envs.sb3 import FastVecEnv
from prefrl.envs.vector import NAMES

CURRENT = [name for name in NAMES if name != "CartPole-v0"]  # of which gymnasium warns that it is out of date


def _pair(name: str, mode: str, steps: int = 60, **options: Any) -> tuple[Any, Any]:
    """Ours, and gymnasium's own."""
    ours = gymnasium.make_vec(f"prefrl/{name}", 3, autoreset_mode=mode, max_episode_steps=steps, **options)
    single = [lambda: make(name, max_episode_steps=steps, disable_env_checker=True, **options)] * 3
    return ours, SyncVectorEnv(single, autoreset_mode=mode)


@pytest.mark.parametrize("mode", ["NextStep", "SameStep"])
@pytest.mark.parametrize("name", CURRENT)
def test_they_are_gymnasiums_own_step_for_step_from_the_same_seeds(name: str, mode: str) -> None:
    ours, theirs = _pair(name, mode)
    assert ours.observation_space == theirs.observation_space
    assert ours.action_space == theirs.action_space
    assert ours.metadata == theirs.metadata
    first, expected = ours.reset(seed=5)[0], theirs.reset(seed=5)[0]
    np.testing.assert_allclose(first, expected, rtol=0, atol=1e-7 if name == "Acrobot-v1" else 0)
    theirs.action_space.seed(0)
    for _ in range(150):
        actions = theirs.action_space.sample()
        step, reference = ours.step(actions), theirs.step(actions)
        for found, wanted in zip(step[:4], reference[:4], strict=True):
            assert found.dtype == wanted.dtype
        beginning = name == "Acrobot-v1"  # whose first observations are to rounding
        np.testing.assert_allclose(step[0], reference[0], rtol=0, atol=1e-7 if beginning else 0)
        np.testing.assert_allclose(step[1], reference[1], rtol=1e-9 if name == "Pendulum-v1" else 0)
        assert np.array_equal(step[2], reference[2])
        assert np.array_equal(step[3], reference[3])
        assert ("final_obs" in step[4]) == ("final_obs" in reference[4])
        for i in np.flatnonzero(reference[4].get("_final_obs", [])):
            assert np.array_equal(step[4]["final_obs"][i], reference[4]["final_obs"][i])


def test_a_body_that_is_told_to_goes_on_when_it_has_fallen() -> None:
    ours, theirs = _pair("Hopper-v5", "NextStep", 200, terminate_when_unhealthy=False)
    ours.reset(seed=1), theirs.reset(seed=1)
    theirs.action_space.seed(0)
    for _ in range(120):
        actions = theirs.action_space.sample()
        step, reference = ours.step(actions), theirs.step(actions)
        assert np.array_equal(step[0], reference[0])
        assert np.array_equal(step[1], reference[1])
        assert not step[2].any()
    assert (step[1] < 1).any()  # without the reward for health


def test_without_autoreset_the_caller_begins_the_episodes_that_have_ended() -> None:
    envs = gymnasium.make_vec("prefrl/CartPole-v1", 2, autoreset_mode=AutoresetMode.DISABLED, max_episode_steps=4)
    envs.reset(seed=0)
    envs.step(np.array([0, 0]))
    envs.reset(options={"reset_mask": np.array([True, False])})
    steps = [envs.step(np.array([0, 1])) for _ in range(3)]
    assert [s[3].tolist() for s in steps] == [[False, False], [False, False], [False, True]]
    with pytest.raises(ValueError, match=r"environments \[1\] have ended"):
        envs.step(np.array([0, 0]))
    assert envs.reset(options={"reset_mask": np.array([False, True])})[0].shape == (2, 4)
    envs.step(np.array([0, 0]))


def test_what_the_fast_stepper_does_not_know_is_refused() -> None:
    for options in ({"g": 5.0}, {"render_mode": "rgb_array"}, {"terminate_when_unhealthy": False}, {"threads": 2}):
        with pytest.raises(ValueError, match=f"Pendulum-v1 has no option '{next(iter(options))}'"):
            gymnasium.make_vec("prefrl/Pendulum-v1", 2, **options)
    with pytest.raises(ValueError, match="threads must be at least 1, got 0"):
        gymnasium.make_vec("prefrl/Hopper-v5", 2, threads=0)
    envs = gymnasium.make_vec("prefrl/Pendulum-v1", 2, render_mode=None)
    with pytest.raises(gymnasium.error.ResetNeeded):
        envs.step(np.zeros((2, 1)))
    with pytest.raises(ValueError, match=r"only the option reset_mask here, got \['low'\]"):
        envs.reset(options={"low": 0.0})
    with pytest.raises(ValueError, match="expected 2 seeds"):
        envs.reset(seed=[1])  # type: ignore[arg-type]  # gymnasium's own takes lists as well
    envs.reset()
    with pytest.raises(ValueError, match=r"actions of shape \(2, 1\), got \(2,\)"):
        envs.step(np.zeros(2))
    with pytest.raises(ValueError, match=r"action of environment 1 is \[nan\]"):
        envs.step(np.array([[0.0], [np.nan]]))
    poles = gymnasium.make_vec("prefrl/CartPole-v1", 2)
    poles.reset()
    with pytest.raises(ValueError, match="action of environment 0 is 2"):
        poles.step(np.array([2, 0]))


@pytest.mark.parametrize(("name", "options"), [("Hopper-v5", {"threads": 2}), ("CartPole-v1", {})])
def test_the_vec_env_is_a_dummy_vec_env(name: str, options: dict[str, Any]) -> None:
    ours = FastVecEnv(name, 3, max_episode_steps=40, **options)
    theirs = DummyVecEnv([lambda: make(name, max_episode_steps=40)] * 3)
    ours.seed(3), theirs.seed(3)
    assert np.array_equal(ours.reset(), theirs.reset())
    theirs.action_space.seed(0)
    for _ in range(100):
        actions = np.stack([theirs.action_space.sample() for _ in range(3)])
        step, reference = ours.step(actions), theirs.step(actions)
        for found, wanted in zip(step[:3], reference[:3], strict=True):
            assert np.array_equal(found, wanted)
            assert found.dtype == wanted.dtype
        for info, wanted in zip(step[3], reference[3], strict=True):
            assert info["TimeLimit.truncated"] == wanted["TimeLimit.truncated"]
            assert np.array_equal(info.get("terminal_observation"), wanted.get("terminal_observation"))


def test_an_algorithm_learns_on_the_vec_env_behind_the_usual_wrappers() -> None:
    envs = VecNormalize(VecMonitor(FastVecEnv("CartPole-v1", 2)))
    model = PPO("MlpPolicy", envs, n_steps=64, batch_size=64, n_epochs=1, device="cpu", seed=0).learn(256)
    assert len(model.ep_info_buffer or []) > 2
    with pytest.raises(ValueError, match="autoreset_mode"):
        FastVecEnv("CartPole-v1", 2, autoreset_mode="NextStep")


def test_minus_one_is_no_limit_and_nothing_else_below_one_is() -> None:
    envs = gymnasium.make_vec("prefrl/MountainCar-v0", 1, max_episode_steps=-1)
    envs.reset(seed=0)
    assert not any(envs.step(np.array([1]))[3].any() for _ in range(250))  # its own limit is 200
    with pytest.raises(ValueError, match="expected at least 1, or -1 for no limit, got 0"):
        gymnasium.make_vec("prefrl/Pendulum-v1", 1, max_episode_steps=0)
