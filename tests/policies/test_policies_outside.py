"""A policy acts in an environment as that is itself, also where prefrl saw a row of numbers and one choice in it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary, MultiDiscrete, Space, Tuple, flatten
from shell import Shell
from stable_baselines3.common.evaluation import evaluate_policy

from prefrl import Config, Run, load_policy
from prefrl.components import ConfigError
from prefrl.envs.control import ControlSettings, GymnasiumTask
from prefrl.envs.several import SeveralSettings, SeveralTask, _check_alike
from prefrl.improve.control import ControlLearnerSettings
from prefrl.improve.q_learning import QLearningSettings
from prefrl.improve.sb3 import SB3Settings
from prefrl.policies.acting import Memory
from prefrl.policies.loaded import Loaded, outside
from prefrl.stages import export_onnx, shrink
from prefrl.types import Floats

ROW = Box(-1.0, 1.0, (2,), np.float32)
PARTS = Dict({"a": Discrete(3, start=1), "b": Box(-1.0, 1.0, (2, 2), np.float32)})
PAIR = Tuple((ROW, MultiBinary(3)))


class Strict(gymnasium.Env[Any, Any]):
    """Shows what its space holds, and takes nothing but what its space holds."""

    def __init__(self, observation: Space[Any] = ROW, action: Space[Any] = ROW) -> None:
        self.observation_space, self.action_space = observation, action

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        return self.observation_space.sample(), {}

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action), action
        return self.observation_space.sample(), 0.0, False, False, {}


@pytest.fixture(autouse=True)
def register() -> Iterator[None]:
    gymnasium.register("Strict-v0", Strict, max_episode_steps=9)  # type: ignore[arg-type]
    yield
    del gymnasium.registry["Strict-v0"]


def built(observation: Space[Any] = ROW, action: Space[Any] = ROW, **settings: Any) -> GymnasiumTask:
    gymnasium.registry["Strict-v0"].kwargs = {"observation": observation, "action": action}
    return ControlSettings.model_validate({"env": "Strict-v0", "segment_steps": 3, **settings}).build()


def loaded(task: GymnasiumTask | SeveralTask, action: Floats, seen: list[Floats] | None = None) -> Loaded:
    """Does `action` (A,), whatever it sees."""

    def act(observations: Floats, rng: np.random.Generator | None, memory: Memory) -> tuple[Floats, Memory]:
        if seen is not None:
            seen.append(observations)
        return np.tile(action, (len(observations), 1)), memory

    return Loaded(act, task.observation_size, task.action_size, task.action_bounds, outside(task))


@pytest.mark.parametrize(
    ("space", "chosen", "expected"),
    [
        (Discrete(2, start=2), 1, 3),
        (MultiDiscrete([2, 3], start=[0, 1]), 4, [1, 2]),
        (MultiBinary(3), 5, [1, 0, 1]),
        (MultiBinary((2, 1)), 1, [[0], [1]]),
    ],
    ids=str,
)
def test_what_is_chosen_is_what_the_environment_takes(space: Space[Any], chosen: int, expected: Any) -> None:
    task = built(action=space)
    policy = loaded(task, np.eye(task.action_size, dtype=np.float32)[chosen])
    one, _ = policy.predict([0.1, 0.2])
    several, _ = policy.predict(np.zeros((3, 2)))
    assert np.array_equal(one, expected)
    assert np.array_equal(several, [expected] * 3)
    assert space.contains(one)
    assert all(space.contains(each) for each in several)


def test_a_policy_of_several_tasks_does_what_all_of_them_take() -> None:
    from_two = built(action=Discrete(2, start=2))
    lengths = {"env": "Strict-v0", "segment_steps": 3}
    task = SeveralSettings.model_validate({"tasks": {"one": lengths, "other": lengths}}).build()
    action, _ = loaded(task, np.eye(2, dtype=np.float32)[1]).predict(np.zeros((3, 4)))
    assert action.tolist() == [3, 3, 3]
    with pytest.raises(ConfigError, match=r"2 choices of Discrete\(2, start=2\) and 2 choices"):
        _check_alike(("one", from_two), ("other", built(action=Discrete(2))))


def test_a_block_of_numbers_is_one_again() -> None:
    task = built(action=Box(-2.0, 2.0, (2, 2), np.float64))
    action, _ = loaded(task, np.array([0.0, 1.0, 2.0, -1.0], np.float32)).predict([0.1, 0.2])
    assert action.tolist() == [[0.0, 1.0], [2.0, -1.0]]
    assert action.dtype == np.float64


@pytest.mark.parametrize(
    "space", [Discrete(5, start=2), MultiDiscrete([2, 3]), Box(0, 255, (2, 2, 3), np.uint8), PARTS, PAIR], ids=str
)
def test_what_the_environment_shows_is_what_the_policy_learned_from(space: Space[Any]) -> None:
    task, seen = built(observation=space, action=Discrete(2)), list[Floats]()
    policy = loaded(task, np.eye(2, dtype=np.float32)[0], seen)
    space.seed(3)
    shown = [space.sample() for _ in range(4)]
    assert np.ndim(policy.predict(shown[0])[0]) == 0
    assert len(policy.predict(_stacked(space, shown))[0]) == 4
    expected = np.stack([np.asarray(flatten(space, one), np.float32) for one in shown])
    np.testing.assert_array_equal(seen[0], expected[:1])
    np.testing.assert_array_equal(seen[1], expected)
    returns, steps = evaluate_policy(policy, gymnasium.make("Strict-v0"), 1, warn=False, return_episode_rewards=True)
    assert (returns, steps) == ([0.0], [9])


def _stacked(space: Space[Any], shown: list[Any]) -> Any:
    """As a vectorised environment gives them."""
    if isinstance(space, Dict):
        return {name: _stacked(part, [one[name] for one in shown]) for name, part in space.spaces.items()}
    if isinstance(space, Tuple):
        return tuple(_stacked(part, [one[i] for one in shown]) for i, part in enumerate(space.spaces))
    return np.stack(shown)


@pytest.mark.parametrize(
    ("space", "given"),
    [
        (Discrete(5, start=2), 1),
        (Discrete(5), np.zeros((2, 5))),
        (PARTS, np.zeros(7)),
        (PARTS, {"a": 1}),
        (PARTS, {"a": [1, 2], "b": np.zeros((2, 2))}),
        (Box(0, 255, (2, 2, 3), np.uint8), np.zeros(12)),
    ],
)
def test_what_the_environment_does_not_show_is_refused(space: Space[Any], given: Any) -> None:
    task = built(observation=space, action=Discrete(2))
    with pytest.raises(ValueError, match="observations must be those of "):
        loaded(task, np.eye(2, dtype=np.float32)[0]).predict(given)


def test_what_is_hidden_from_a_policy_may_be_shown_to_it() -> None:
    task, seen = ControlSettings(env="Pendulum-v1", hide=(2,)).build(), list[Floats]()
    policy = loaded(task, np.zeros(1, np.float32), seen)
    policy.predict([0.6, 0.8, 5.0])
    policy.predict([0.6, 0.8])
    assert [rows.tolist() for rows in seen] == [[[np.float32(0.6), np.float32(0.8)]]] * 2
    with pytest.raises(ValueError, match=r"\(2,\) or \(n, 2\) \(without numbers \[2\] of the 3, 0 to 2\), got \(4,\)"):
        policy.predict(np.zeros(4))
    stacked = ControlSettings(env="Pendulum-v1", stack=4).build()
    with pytest.raises(ValueError, match=r"\(n, 12\) \(the last 4 in one row, the oldest first\), got \(3,\)"):
        loaded(stacked, np.zeros(1, np.float32)).predict(np.zeros(3))


@pytest.mark.parametrize(
    ("spaces", "says"),
    [
        ({"action": Discrete(2, start=1)}, r"actions are Discrete\(2, start=1\), and not counted from 0"),
        ({"action": MultiBinary(2)}, r"actions are MultiBinary\(2\)"),
        ({"observation": Discrete(4), "action": Discrete(2)}, r"observations are Discrete\(4\)"),
    ],
)
def test_a_policy_that_needs_its_task_leaves_in_no_file(spaces: dict[str, Any], says: str, tmp_path: Path) -> None:
    task, rng = built(**spaces), np.random.default_rng(0)
    small = {"environments": 1, "steps_per_round": 8}
    learners: list[Any] = [
        ControlLearnerSettings(device="cpu"),
        SB3Settings.model_validate({"algorithm": "PPO", "options": {"n_steps": 8, "batch_size": 8}, **small}),
    ]
    if "observation" in spaces:
        learners.append(QLearningSettings.model_validate(small))
    for settings in learners:
        with pytest.raises(ConfigError, match=rf"a policy of Strict-v0 cannot leave.*{says}.*prefrl\.load_policy"):
            settings.build(task, rng).save(tmp_path / "policy.zip")
    assert not (tmp_path / "policy.zip").exists()


def test_a_row_of_whole_numbers_is_one_of_numbers() -> None:
    assert not built(observation=Box(0, 9, (4,), np.int64), action=Discrete(2)).outside.changed  # type: ignore[union-attr]


def test_a_run_acts_in_its_environment_and_says_what_its_file_would_not(prefrl: Shell) -> None:
    gymnasium.registry["Strict-v0"].kwargs = {"observation": ROW, "action": Discrete(2, start=2)}
    settings = ["task.env=Strict-v0", "task.segment_seconds=null", "task.segment_steps=3", "task.horizon=9"]
    with Run(shrink(Config.load("control/cartpole", settings)), "run") as run:
        list(run)
    assert load_policy("run").predict([0.1, 0.2])[0] in (2, 3)
    assert prefrl("export run --form sb3 --to policy.zip") == 2
    assert "not counted from 0" in prefrl.err
    with pytest.raises(ConfigError, match="not counted from 0"):
        export_onnx(Path("run"), Path("policy.onnx"))


def test_an_export_says_which_numbers_its_file_wants(prefrl: Shell) -> None:
    with Run(shrink(Config.load("control/pendulum", ["task.hide=[2]"])), "run") as run:
        list(run)
    assert prefrl("export run --form sb3 --to policy.zip") == 0
    assert "raw observations (without numbers [2] of the 3, 0 to 2)" in prefrl.out
