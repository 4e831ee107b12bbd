"""Our own policy gradients for control: they learn, count, bootstrap, repeat and resume as they say."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from control_stubs import Known, point
from corridor import corridor
from pydantic import ValidationError

from prefrl.components import ConfigError
from prefrl.envs.control import GymnasiumTask
from prefrl.improve.control import ControlLearner, ControlLearnerSettings
from prefrl.improve.valued import _next_values
from prefrl.policies.mlp import MLPPolicy
from prefrl.policies.rollout import Rollout
from prefrl.reward_models.mlp import MLPSettings
from prefrl.storage.checkpoints import load_state, save_state
from prefrl.store import Store
from prefrl.types import Segment, Steps

SMALL: dict[str, Any] = {
    "environments": 4,
    "steps_per_round": 400,
    "rollout_steps": 40,
    "epochs": 3,
    "critic_epochs": 2,
    "minibatch": 64,
    "policy": {"hidden": (8,)},
    "evaluation_episodes": 3,
}


def _learner(task: GymnasiumTask, seed: int = 0, **settings: object) -> ControlLearner:
    return ControlLearnerSettings.model_validate({**SMALL, **settings}).build(task, np.random.default_rng(seed))


def _bytes(learner: ControlLearner) -> bytes:
    state = learner.policy.state()
    arrays = [*(p.numpy() for p in state["parameters"].values()), state["mean"], state["variance"]]
    return b"".join(a.tobytes() for a in arrays)


@pytest.mark.parametrize("discrete", [False, True])
def test_it_learns_to_stay_at_the_origin(store: Store[Segment], discrete: bool) -> None:
    learner = _learner(
        point(discrete), seed=2, steps_per_round=1600, epochs=6, discount=0.9, policy={"hidden": (16, 16)}
    )
    before = learner.evaluate(Known(), np.random.default_rng(9)).metrics["gold"]
    for number in range(4):
        learner.improve(Known(), store, np.random.default_rng(number))
    after = learner.evaluate(Known(), np.random.default_rng(9)).metrics["gold"]
    # What it takes to come there from a uniform start, and 0.1 a step beside it where pushes have one size.
    assert before < -8.0
    assert after > (-3.0 if discrete else -1.5)


def test_reinforce_is_a_choice_of_settings_and_learns_too(store: Store[Segment]) -> None:
    learner = _learner(
        point(), clip=None, epochs=1, trace=1.0, discount=0.9, minibatch=160, steps_per_round=4800, learning_rate=3e-3
    )
    before = learner.evaluate(Known(), np.random.default_rng(9)).metrics["gold"]
    for number in range(3):
        learner.improve(Known(), store, np.random.default_rng(number))
    assert learner.evaluate(Known(), np.random.default_rng(9)).metrics["gold"] > before + 3.0


def test_fresh_starts_begin_each_rollout_with_new_episodes_that_no_segment_spans(store: Store[Segment]) -> None:
    def beginnings(fresh: bool) -> set[str]:
        """Where episodes begin; a rollout's last step leads on to the next one's first, or does not."""
        learner = _learner(point(), steps_per_round=160, rollout_steps=10, fresh_starts=fresh)  # four rollouts in each
        learner.improve(Known(), store, np.random.default_rng(1))
        rollout = learner._player._recent
        assert rollout is not None
        assert (rollout.observations[:, 10] == rollout.final_observations[:, 9]).any() != fresh
        segments = learner.sample(60, np.random.default_rng(2))
        # A jump to a new start is none that a push can make.
        assert max(np.abs(np.diff(one.observations[:, 0])).max() for one in segments) < 1.0
        return {one.episode.rsplit("/", 1)[1] for one in segments}

    assert beginnings(False) == {"0", "20"}  # the horizon
    assert beginnings(True) == {"0", "10", "20", "30"}


def test_every_step_of_the_environments_is_counted_once_by_purpose(store: Store[Segment]) -> None:
    spent: list[int] = []
    learner = _learner(point(spent=spent))
    learner.sample(10, np.random.default_rng(0))
    assert (sum(spent), learner.steps) == (20, Steps(query=20))
    learner.improve(Known(), store, np.random.default_rng(1))
    assert (sum(spent), learner.steps) == (420, Steps(learn=400, query=20))
    learner.sample(10, np.random.default_rng(2))
    assert sum(spent) == 420
    learner.evaluate(Known(), np.random.default_rng(3))
    assert (sum(spent), learner.steps) == (480, Steps(learn=400, query=20, evaluate=60))


@pytest.mark.parametrize("rollout_steps", [7, 30, 64, 1000])
def test_a_round_takes_exactly_its_steps_however_long_rollouts_are(store: Store[Segment], rollout_steps: int) -> None:
    learner = _learner(point(), rollout_steps=rollout_steps)
    learner.improve(Known(), store, np.random.default_rng(0))
    assert learner.steps.learn == 400


def test_segments_carry_gold_states_and_names_that_are_unique_in_the_run(store: Store[Segment]) -> None:
    learner = _learner(point())
    pools = []
    for number in range(3):
        pools.append(learner.sample(16, np.random.default_rng(number)))
        learner.improve(Known(), store, np.random.default_rng(number))
    segments = [s for pool in pools for s in pool]
    assert len({s.id for s in segments}) == 48
    assert not {s.episode for s in pools[0]} & {s.episode for s in pools[1]}
    assert all(s.gold is not None and s.states is not None and len(s.gold) == len(s) == 5 for s in segments)


def test_gold_never_touches_what_is_learned(store: Store[Segment]) -> None:
    learners = [_learner(point(hide_gold=hide)) for hide in (False, True)]
    for learner in learners:
        learner.sample(10, np.random.default_rng(5))
        learner.improve(Known(), store, np.random.default_rng(0))
    assert _bytes(learners[0]) == _bytes(learners[1])
    gold = learners[1].evaluate(Known(), np.random.default_rng(0)).metrics
    assert np.isnan(gold["gold"])
    assert np.isfinite(gold["learned"])


def test_same_seed_gives_equal_bytes_and_another_does_not(store: Store[Segment]) -> None:
    found = []
    for seed in (0, 0, 1):
        learner = _learner(point())
        learner.improve(Known(), store, np.random.default_rng(seed))
        found.append(_bytes(learner))
    assert found[0] == found[1] != found[2]


def test_a_saved_learner_goes_on_bit_for_bit(store: Store[Segment], tmp_path: Any) -> None:
    learner = _learner(point())
    learner.improve(Known(), store, np.random.default_rng(0))
    save_state(tmp_path, "learner", learner.state())
    other = _learner(point(), seed=7)
    other.load(load_state(tmp_path, "learner"))
    pools = [one.sample(10, np.random.default_rng(1)) for one in (learner, other)]
    assert [s.id for s in pools[0]] == [s.id for s in pools[1]]
    for one in (learner, other):
        one.improve(Known(), store, np.random.default_rng(2))
    assert _bytes(learner) == _bytes(other)
    assert learner.steps == other.steps


def test_the_probability_ratio_is_one_before_the_first_step(store: Store[Segment]) -> None:
    learner = _learner(point(), minibatch=160, epochs=1, rollout_steps=40, target_kl=None)
    learner.improve(Known(), store, np.random.default_rng(0))
    metrics = learner.improve(Known(), store, np.random.default_rng(1))
    assert abs(metrics["kl_old"]) < 1e-9
    assert metrics["clipped"] == 0.0


def test_a_time_limit_bootstraps_from_the_final_observation_and_a_termination_does_not() -> None:
    learner = _learner(point())
    ones = np.ones((1, 4, 1), np.float32)
    rollout = Rollout(
        observations=ones * np.array([[[0.1], [0.2], [0.3], [0.4]]], np.float32),
        choices=ones,
        actions=ones,
        final_observations=ones * np.array([[[0.2], [0.8], [0.9], [0.5]]], np.float32),
        terminated=np.array([[False, False, True, False]]),
        truncated=np.array([[False, True, False, False]]),
        gold=np.zeros((1, 4)),
        states=None,
    )
    with torch.no_grad():
        policy = learner.policy
        assert isinstance(policy, MLPPolicy)
        unseen = np.array([[False, True, True, True]])
        reading = policy.read(rollout, None, unseen)
        found = _next_values(rollout, reading.values, reading.final, unseen)

        def value(x: float) -> float:
            inputs = torch.from_numpy(policy.normalise(np.array([[x]], np.float32)))
            return float(policy.values_of(inputs).detach())

    assert found[0].tolist() == pytest.approx([value(0.2), value(0.8), 0.0, value(0.5)], abs=1e-6)


def test_evaluation_does_not_depend_on_what_was_drawn_before() -> None:
    learner = _learner(point())
    first = learner.evaluate(Known(), np.random.default_rng(0))
    learner.sample(10, np.random.default_rng(1))
    second = learner.evaluate(Known(), np.random.default_rng(0))
    assert first.metrics == second.metrics
    assert [s.id for s in first.examples] == [s.id for s in second.examples]
    assert len(first.examples) == 3


def test_a_reward_that_is_nan_stops_the_round_and_is_named(store: Store[Segment]) -> None:
    broken = Known(lambda o, a: np.where(o[..., 0] > 0.5, np.nan, o[..., 0]))
    with pytest.raises(FloatingPointError, match=r"learned reward of environment \d+, step \d+"):
        _learner(point()).improve(broken, store, np.random.default_rng(0))


def test_it_learns_from_a_fitted_ensemble(store: Store[Segment]) -> None:
    task = point()
    learner = _learner(task)
    reward = MLPSettings(hidden=(8,)).build(task, np.random.default_rng(0))
    reward.settle(reward.stack(learner.sample(20, np.random.default_rng(0))), lambda scores: scores.sum(1))
    metrics = learner.improve(reward, store, np.random.default_rng(1))
    assert all(np.isfinite(v) for v in metrics.values())
    json.dumps(metrics)


def test_steps_that_do_not_divide_are_refused_with_both_numbers() -> None:
    with pytest.raises(ValidationError, match="got 1000 and 16"):
        ControlLearnerSettings(steps_per_round=1000)


def test_a_text_task_is_refused() -> None:
    class Text:
        name, kind = "reviews", "text"

    with pytest.raises(ConfigError, match="'text'"):
        ControlLearnerSettings().build(Text(), np.random.default_rng(0))


def test_a_reward_model_without_step_rewards_is_refused(store: Store[Segment]) -> None:
    class Whole:
        members, fitted = 1, True

    with pytest.raises(ConfigError, match=r"reward\.kind=mlp"):
        _learner(point()).improve(Whole(), store, np.random.default_rng(0))  # type: ignore[arg-type]


def test_the_formula_says_what_is_optimised() -> None:
    assert "clip(r, 0.8, 1.2)" in ControlLearnerSettings().formula()
    assert "log pi(a|s) A" in ControlLearnerSettings(clip=None).formula()


def test_an_algorithm_fills_in_defaults_and_what_is_set_beside_it_stands() -> None:
    assert ControlLearnerSettings() == ControlLearnerSettings(algorithm="ppo")
    plain = ControlLearnerSettings(algorithm="reinforce", trace=0.9)
    assert (plain.clip, plain.epochs, plain.trace) == (None, 1, 0.9)
    assert ControlLearnerSettings.model_validate(plain.model_dump()) == plain
    assert ControlLearnerSettings(algorithm="a2c").rollout_steps == 16


def test_it_learns_where_some_moves_are_not_legal(store: Store[Segment]) -> None:
    learner = _learner(corridor(), seed=1, steps_per_round=800, epochs=4, discount=0.9, learning_rate=1e-2)
    reward = Known(lambda observations, actions: observations[..., 0])
    before = learner.evaluate(reward, np.random.default_rng(9)).metrics["gold"]
    metrics = [learner.improve(reward, store, np.random.default_rng(number)) for number in range(2)]
    assert learner.evaluate(reward, np.random.default_rng(9)).metrics["gold"] > max(before, 28.0)  # 36 at the most
    assert all(m["ratio_error"] < 1e-5 for m in metrics)
    assert metrics[0]["entropy"] < np.log(3)


def test_the_legal_moves_of_a_rollout_are_kept_and_saved(store: Store[Segment], tmp_path: Path) -> None:
    learner = _learner(corridor(), steps_per_round=40)
    learner.improve(Known(), store, np.random.default_rng(0))
    recent = learner.state()["recent"]
    np.testing.assert_array_equal(recent["legal"][..., 0], recent["observations"][..., 0] > 0)
    assert (recent["choices"] * ~recent["legal"]).sum() == 0.0
    save_state(tmp_path, "learner", learner.state())
    other = _learner(corridor(), seed=1, steps_per_round=40)
    other.load(load_state(tmp_path, "learner"))
    np.testing.assert_array_equal(other.state()["recent"]["legal"], recent["legal"])
