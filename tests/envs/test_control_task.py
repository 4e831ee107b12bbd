"""Control tasks: lengths, ids and spaces that cannot be are told apart; terminations are off unless asked for."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest

from prefrl.components import ConfigError
from prefrl.envs.control import WORLDS, ControlSettings
from prefrl.envs.fast.bodies import BODIES


def test_seconds_become_steps_by_the_rate_of_the_simulation() -> None:
    assert ControlSettings(env="Pendulum-v1", segment_seconds=1.5).build().segment_steps == 30
    assert ControlSettings(env="CartPole-v1", segment_seconds=0.5).build().segment_steps == 25
    assert ControlSettings(env="Acrobot-v1", segment_seconds=2.0).build().segment_steps == 10
    assert ControlSettings(env="MountainCar-v0", segment_seconds=1.0).build().segment_steps == 30
    hopper = ControlSettings(env="Hopper-v5", segment_seconds=1.0).build()
    assert hopper.segment_steps == 125
    assert hopper.fps == pytest.approx(125.0)


def test_a_task_says_what_its_spaces_are() -> None:
    pendulum = ControlSettings(env="Pendulum-v1").build()
    assert (pendulum.observation_size, pendulum.action_size, pendulum.horizon) == (3, 1, 200)
    assert pendulum.action_bounds is not None
    assert [b.tolist() for b in pendulum.action_bounds] == [[-2.0], [2.0]]
    cartpole = ControlSettings(env="CartPole-v1").build()
    assert (cartpole.action_size, cartpole.action_bounds, cartpole.kind) == (2, None, "control")


def test_a_segment_longer_than_the_episode_is_refused_with_both_numbers() -> None:
    with pytest.raises(ConfigError, match=r"segment of 300 steps is longer than an episode of 200"):
        ControlSettings(env="Pendulum-v1", segment_steps=300).build()


def test_two_lengths_are_refused() -> None:
    with pytest.raises(ConfigError, match="not both"):
        ControlSettings(segment_steps=3, segment_seconds=1.0).build()


@pytest.mark.parametrize(("wrong", "right"), [("Pendulm-v1", "Pendulum-v1"), ("hopper", "Hopper-v5")])
def test_an_unknown_id_is_refused_with_the_nearest(wrong: str, right: str) -> None:
    with pytest.raises(ConfigError, match=f"did you mean '{right}'"):
        ControlSettings(env=wrong).build()


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"options": {"g": "x"}}, r"task\.options=.*Pendulum-v1 cannot step with them: unsupported operand"),
        ({"options": {"render_mode": "human"}}, "leave render_mode out"),
        ({"variable_horizon": True, "after_end": "restart"}, "episodes end, and nothing comes after"),
        ({"env": "HalfCheetah-v3"}, "gymnasium cannot make it: The mujoco v2 and v3 based environments"),
    ],
)
@pytest.mark.filterwarnings("ignore:.*out of date:DeprecationWarning")
def test_what_could_not_be_stepped_is_refused_when_the_task_is_built(settings: dict[str, Any], said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        ControlSettings(**settings).build()


def test_an_id_cannot_name_code_to_import() -> None:
    with pytest.raises(ConfigError, match="unknown gymnasium environment"):
        ControlSettings(env="antigravity:Pendulum-v1").build()


@pytest.mark.parametrize("name", [name for name in [*WORLDS, *BODIES] if name != "CartPole-v0"])
def test_episodes_have_a_fixed_horizon_where_the_environment_allows_it(name: str) -> None:
    task = ControlSettings(env=name, horizon=60, segment_steps=5).build()
    envs = task.environments(2)
    envs.reset(np.random.default_rng(0))
    action = np.eye(task.action_size, dtype=np.float32)[[0, 0]]
    steps = [envs.step(action) for _ in range(60)]
    assert not any(s.terminated.any() for s in steps)
    assert [bool(s.truncated.all()) for s in steps] == [False] * 59 + [True]


def test_episodes_may_end_early_when_asked_to() -> None:
    task = ControlSettings(env="CartPole-v1", variable_horizon=True, segment_steps=5).build()
    envs = task.environments(1)
    envs.reset(np.random.default_rng(0))
    assert any(envs.step(np.array([[1.0, 0.0]], np.float32)).terminated.all() for _ in range(30))


def test_a_cartpole_that_fell_earns_nothing_and_stays_as_it_fell() -> None:
    task = ControlSettings(env="CartPole-v1", segment_steps=5).build()
    envs = task.environments(1)
    envs.reset(np.random.default_rng(0))
    steps = [envs.step(np.array([[1.0, 0.0]], np.float32)) for _ in range(20)]
    assert steps[0].rewards[0] == 1.0
    assert steps[-1].rewards[0] == 0.0
    assert np.array_equal(steps[-1].observations, steps[-2].observations)


def test_an_environment_without_a_time_limit_needs_a_horizon() -> None:
    class Still(gymnasium.Env[np.ndarray, np.ndarray]):
        observation_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)
        action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    gymnasium.register("Still-v0", Still)  # type: ignore[arg-type]
    try:
        with pytest.raises(ConfigError, match=r"task\.horizon"):
            ControlSettings(env="Still-v0").build()
        with pytest.raises(ConfigError, match="segment_steps or fps"):
            ControlSettings(env="Still-v0", horizon=10).build()
        assert ControlSettings(env="Still-v0", horizon=10, fps=2.0).build().segment_steps == 3
    finally:
        del gymnasium.registry["Still-v0"]


@pytest.mark.parametrize(
    "settings",
    [
        {"env": "Pendulum-v1"},
        {"env": "HalfCheetah-v5", "after_end": "restart"},
        {"env": "HalfCheetah-v5", "options": {"ctrl_cost_weight": 0.2}},
        {"env": "HumanoidStandup-v5"},
    ],
)
def test_threads_are_refused_where_no_fast_stepper_of_mujoco_steps(settings: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=r"task\.threads=2: only Ant-v5, HalfCheetah-v5, .*leave task\.threads=1"):
        ControlSettings(threads=2, **settings).build()


def test_threads_reach_the_stepper_behind_partial_sight_too() -> None:
    envs = ControlSettings(env="HalfCheetah-v5", threads=2, hide=(0,)).build().environments(4)
    assert envs._envs._bodies._batch.nthread == 2  # type: ignore[attr-defined]


def test_a_run_may_go_on_with_another_number_of_threads() -> None:
    several = ControlSettings(env="HalfCheetah-v5", threads=2)
    assert several.lasting() == several.identity() == ControlSettings(env="HalfCheetah-v5")
