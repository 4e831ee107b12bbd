"""stable-baselines3 on the learned reward: adapters, relabelling, counting, resuming."""

from __future__ import annotations

import tempfile
from copy import deepcopy
from dataclasses import replace
from inspect import signature
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from control_stubs import Ageing, Known, point
from corridor import corridor
from stable_baselines3 import PPO as SB3PPO
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from prefrl.components import ConfigError
from prefrl.envs.control import ControlSettings, GymnasiumTask
from prefrl.improve import sb3
from prefrl.improve.replay import replay_state
from prefrl.improve.sb3 import (
    ALGORITHMS,
    SB3,
    LearnedReward,
    Name,
    SB3Settings,
    TaskEnv,
    algorithm_class,
    executed,
    relabel,
)
from prefrl.improve.vec_env import scored
from prefrl.policies.rollout import learned_rewards
from prefrl.protocols import Environments, Transition
from prefrl.reward_models.mlp import MLPSettings
from prefrl.reward_models.sequence import GRUSettings
from prefrl.storage.checkpoints import load_state, save_state
from prefrl.store import Store
from prefrl.types import Bools, Floats, Segment, Steps

NET = {"net_arch": [8]}
PPO: dict[str, Any] = {"algorithm": "PPO", "options": {"n_steps": 20, "n_epochs": 2, "batch_size": 40}}
SAC_: dict[str, Any] = {
    "algorithm": "SAC",
    "options": {"train_freq": 5, "gradient_steps": 2, "learning_starts": 20, "batch_size": 16, "buffer_size": 150},
}
both = pytest.mark.parametrize("algorithm", [PPO, SAC_], ids=["PPO", "SAC"])
REPLAYS: dict[str, Any] = {"train_freq": 5, "gradient_steps": 2, "learning_starts": 20, "batch_size": 16}
UNIT = gymnasium.spaces.Box(-1.0, 1.0, (1,))
every = pytest.mark.parametrize("name", ALGORITHMS)


def _settings(name: Name) -> dict[str, Any]:
    """Small ones of any algorithm."""
    options = REPLAYS | {"buffer_size": 150} if ALGORITHMS[name].replays else {"n_steps": 20}
    small = {"policy": NET | {"lstm_hidden_size": 6, "n_lstm_layers": 2}} if name == "RecurrentPPO" else {}
    return {"algorithm": name, "options": options | ({"batch_size": 40} if ALGORITHMS[name].batch else {})} | small


def _task(name: Name) -> GymnasiumTask:
    return point(discrete=ALGORITHMS[name].actions == "discrete")


@every
def test_any_algorithm_learns_and_goes_on_bit_for_bit_where_it_was_saved(
    store: Store[Segment], name: Name, tmp_path: Any
) -> None:
    learner = _learner(_task(name), _settings(name))
    before = _bytes(learner)
    learner.improve(Known(), store, np.random.default_rng(0))
    assert _bytes(learner) != before
    save_state(tmp_path, "learner", learner.state())
    other = _learner(_task(name), _settings(name), seed=7)
    other.load(load_state(tmp_path, "learner"))
    for one in (learner, other):
        one.improve(Known(), store, np.random.default_rng(2))
    assert _bytes(learner) == _bytes(other)
    assert np.isfinite(learner.evaluate(Known(), np.random.default_rng(3)).metrics["gold"])


def test_learning_leaves_no_folder_of_stable_baselines3_behind(
    store: Store[Segment], monkeypatch: pytest.MonkeyPatch, tmp_path: Any
) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    learner = _learner(_task("PPO"), _settings("PPO"))
    assert "loss" in learner.improve(Known(), store, np.random.default_rng(0))
    assert not list(tmp_path.glob("SB3-*"))


def test_tensorboard_is_written_where_it_was_asked_for(store: Store[Segment], tmp_path: Any) -> None:
    settings = _settings("PPO")
    settings["options"] |= {"tensorboard_log": str(tmp_path)}
    _learner(_task("PPO"), settings).improve(Known(), store, np.random.default_rng(0))
    assert list(tmp_path.rglob("events.out.*"))


@every
def test_any_algorithm_starts_from_its_own_zip(name: Name, tmp_path: Any) -> None:
    learner = _learner(_task(name), _settings(name))
    learner.save(tmp_path / "policy.zip")
    other = _learner(_task(name), _settings(name), seed=7, start=tmp_path / "policy.zip")
    assert _bytes(other) == _bytes(learner)


@every
def test_the_table_says_of_algorithms_what_is_so(name: Name) -> None:
    known, parameters = ALGORITHMS[name], signature(algorithm_class(name)).parameters
    assert issubclass(algorithm_class(name), OffPolicyAlgorithm) is known.replays
    assert parameters["train_freq" if known.replays else "n_steps"].default == known.at_once
    assert not known.batch or parameters["batch_size"].default == known.batch


def test_actions_that_an_algorithm_cannot_take_are_refused_with_those_that_can() -> None:
    with pytest.raises(ConfigError, match=r"DQN needs discrete .* has continuous actions; use one of PPO, .*SAC"):
        _learner(point(), _settings("DQN"))
    with pytest.raises(ConfigError, match=r"algorithm=TD3 needs continuous .* use one of PPO, A2C, .*DQN"):
        _learner(point(discrete=True), _settings("TD3"))


@pytest.mark.parametrize("name", ["PPO", "SAC", "DQN"])
def test_weights_that_are_none_are_said_in_the_round_that_made_them(store: Store[Segment], name: Name) -> None:
    settings = _settings(name)
    settings["options"] = settings["options"] | {"learning_rate": 1e30}
    learner = _learner(_task(name), settings, steps_per_round=400)
    told = rf"{name}: after \d+ steps a weight of the policy .* is not finite, .*: lower learner\.options\.learning"
    with pytest.raises(FloatingPointError, match=told):
        learner.improve(Known(), store, np.random.default_rng(0))


def _learner(task: GymnasiumTask, algorithm: dict[str, Any], seed: int = 0, **settings: object) -> SB3:
    small: dict[str, Any] = {"environments": 2, "steps_per_round": 80, "policy": NET, "evaluation_episodes": 3}
    return SB3Settings.model_validate({**small, **algorithm, **settings}).build(task, np.random.default_rng(seed))


def _bytes(learner: SB3) -> bytes:
    return b"".join(p.detach().numpy().tobytes() for p in learner.model.policy.parameters())


def test_the_discount_is_what_stable_baselines3_calls_gamma() -> None:
    assert SB3Settings(options={"gamma": 0.9}).discount == 0.9
    for name in ALGORITHMS:
        default = signature(algorithm_class(name)).parameters["gamma"].default
        assert SB3Settings.model_validate({"algorithm": name}).discount == default


@both
def test_the_algorithm_computes_on_the_device_that_the_settings_name(
    algorithm: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[torch.device] = []
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(sb3, "algorithm_class", lambda _: lambda *_, device, **__: made.append(device))
    for device in ("cpu", "cuda", "auto"):
        _learner(point(), algorithm, device=device)
    assert [device.type for device in made] == ["cpu", "cuda", "cuda"]


@both
def test_every_step_of_the_environments_is_counted_once_by_purpose(
    store: Store[Segment], algorithm: dict[str, Any]
) -> None:
    spent: list[int] = []
    learner = _learner(point(spent=spent), algorithm)
    learner.sample(10, np.random.default_rng(0))
    assert (sum(spent), learner.steps) == (20, Steps(query=20))
    learner.improve(Known(), store, np.random.default_rng(1))
    assert (sum(spent), learner.steps) == (100, Steps(learn=80, query=20))
    learner.evaluate(Known(), np.random.default_rng(3))
    assert (sum(spent), learner.steps) == (160, Steps(learn=80, query=20, evaluate=60))
    segments = learner.sample(10, np.random.default_rng(2))
    assert sum(spent) == 160
    assert all(s.gold is not None and s.states is not None and len(s) == 5 for s in segments)


@both
def test_gold_never_touches_what_is_learned(store: Store[Segment], algorithm: dict[str, Any]) -> None:
    learners = [_learner(point(hide_gold=hide), algorithm) for hide in (False, True)]
    for learner in learners:
        for number in range(2):
            learner.improve(Known(), store, np.random.default_rng(number))
    assert _bytes(learners[0]) == _bytes(learners[1])


@both
def test_a_saved_learner_goes_on_bit_for_bit(store: Store[Segment], algorithm: dict[str, Any], tmp_path: Any) -> None:
    learner = _learner(point(), algorithm)
    for number in range(2):
        learner.improve(Known(), store, np.random.default_rng(number))
    save_state(tmp_path, "learner", learner.state())
    other = _learner(point(), algorithm, seed=7)
    other.load(load_state(tmp_path, "learner"))
    pools = [one.sample(10, np.random.default_rng(1)) for one in (learner, other)]
    assert [s.id for s in pools[0]] == [s.id for s in pools[1]]
    for one in (learner, other):
        one.improve(Known(), store, np.random.default_rng(2))
    assert _bytes(learner) == _bytes(other)
    assert learner.steps == other.steps


@both
def test_the_global_generators_are_left_as_they_were(store: Store[Segment], algorithm: dict[str, Any]) -> None:
    torch.manual_seed(3)
    np.random.seed(3)
    before = torch.get_rng_state(), np.random.get_state(legacy=False)["state"]["key"]
    learner = _learner(point(), algorithm)
    learner.sample(5, np.random.default_rng(0))
    learner.improve(Known(), store, np.random.default_rng(0))
    assert torch.equal(torch.get_rng_state(), before[0])
    assert np.array_equal(np.random.get_state(legacy=False)["state"]["key"], before[1])


def test_it_learns_to_stay_at_the_origin(store: Store[Segment]) -> None:
    options = {"n_steps": 100, "batch_size": 100, "gamma": 0.9, "learning_rate": 2e-3}
    learner = _learner(point(), {"algorithm": "PPO", "options": options}, environments=4, steps_per_round=6000)
    before = learner.evaluate(Known(), np.random.default_rng(9)).metrics["gold"]
    learner.improve(Known(), store, np.random.default_rng(0))
    after = learner.evaluate(Known(), np.random.default_rng(9)).metrics["gold"]
    assert after > max(-5.0, before + 3.0)


def test_the_replay_holds_the_newest_rewards_whole_and_never_the_gold(store: Store[Segment]) -> None:
    learner = _learner(point(), SAC_)
    for number in range(3):  # the second round wraps the ring of 150 steps
        learner.improve(Known(lambda o, a: o[..., 0] + a[..., 0]), store, np.random.default_rng(number))
    buffer = learner.model.replay_buffer
    assert buffer.full
    relabel(buffer, Known(lambda o, a: 3.0 * o[..., 0] + a[..., 0]))
    np.testing.assert_allclose(buffer.rewards, 3.0 * buffer.observations[..., 0] + buffer.actions[..., 0], atol=1e-6)


def test_each_round_begins_by_scoring_what_is_replayed_anew(store: Store[Segment]) -> None:
    learner = _learner(point(), {**SAC_, "options": {**SAC_["options"], "buffer_size": 1000}})
    learner.improve(Known(lambda o, a: o[..., 0]), store, np.random.default_rng(0))
    learner.improve(Known(lambda o, a: 7.0 - o[..., 0]), store, np.random.default_rng(1))
    buffer = learner.model.replay_buffer
    assert buffer.size() == 80  # both rounds, of 40 steps in each of two environments
    np.testing.assert_allclose(buffer.rewards[:80], 7.0 - buffer.observations[:80, :, 0], atol=1e-6)


@both
def test_an_evaluation_does_not_explore(algorithm: dict[str, Any]) -> None:
    learner = _learner(point(), algorithm)
    one, other = (learner.evaluate(Known(), np.random.default_rng(0)) for _ in range(2))
    assert [s.id for s in one.examples] == [s.id for s in other.examples]


def test_the_wrapper_works_in_a_script_of_ones_own() -> None:
    task = ControlSettings(env="CartPole-v1", segment_steps=10).build()
    reward = MLPSettings(hidden=(8,)).build(task, np.random.default_rng(0))
    env = VecNormalize(LearnedReward(make_vec_env("CartPole-v1", 3, seed=0), reward), norm_reward=False)
    model = SB3PPO("MlpPolicy", env, n_steps=16, batch_size=24, n_epochs=1, seed=0, device="cpu")
    model.learn(48)
    assert np.isfinite(model.rollout_buffer.rewards).all()
    assert not (model.rollout_buffer.rewards == 1.0).any()


def test_the_wrapper_scores_the_observation_before_the_action() -> None:
    env = LearnedReward(make_vec_env("Pendulum-v1", 2, seed=0), Known(lambda o, a: o[..., 2] + 100 * a[..., 0]))
    observations: Any = env.reset()
    actions = np.array([[0.5], [9.0]], np.float32)
    _, rewards, _, _ = env.step(actions)
    np.testing.assert_allclose(rewards, observations[:, 2] + 100 * np.array([0.5, 2.0], np.float32), rtol=1e-5)


@pytest.mark.parametrize("at_fault", ["an observation", "the learned reward"])
def test_who_is_at_fault_for_a_reward_that_is_no_number(at_fault: str) -> None:
    observations = np.zeros((2, 1, 3), np.float32)
    observations[1, 0, 2] = np.nan if at_fault == "an observation" else 0.0
    reward = Known(lambda o, a: o[..., 2] / o[..., 1])  # 0 / 0 where nothing else is wrong
    alone, begins = np.zeros((2, 1, 1), np.float32), np.ones((2, 1), bool)
    observations[0, 0, 1] = 1.0
    with np.errstate(invalid="ignore"), pytest.raises(FloatingPointError, match=f"^{at_fault} of environment 1 is"):
        scored(reward, observations, alone, begins)


def test_a_time_limit_is_told_from_a_termination_and_the_last_observation_kept() -> None:
    env = TaskEnv(ControlSettings(env="CartPole-v1", horizon=9, segment_steps=3).build(), 2)
    env.start(np.random.default_rng(0))
    env.reset()
    for _ in range(9):
        observations, _, dones, infos = env.step(np.array([0, 1]))
    assert dones.all()
    assert [info["TimeLimit.truncated"] for info in infos] == [True, True]
    assert not np.array_equal(infos[0]["terminal_observation"], observations[0])


def test_discrete_actions_are_seen_one_hot_from_any_start() -> None:
    assert executed(gymnasium.spaces.Discrete(3, start=5), np.array([5, 7])).tolist() == [[1, 0, 0], [0, 0, 1]]


def _diverging(discrete: bool, at: int, starts: tuple[float, ...] = ()) -> GymnasiumTask:
    """The point, of which one observation is no number: the `at`-th that a step leads to, of the second environment."""
    task = point(discrete=discrete)

    def make(count: int) -> Environments:
        return Diverging(task.make(count), at, starts)

    return replace(task, make=make)


class Diverging:
    def __init__(self, inner: Environments, at: int, starts: tuple[float, ...]) -> None:
        self._inner, self._left, self._starts = inner, at, starts

    def reset(self, rng: np.random.Generator) -> Floats:
        first = self._inner.reset(rng)
        return np.array(self._starts, np.float32)[:, None] if self._starts else first

    def states(self) -> Floats | None:
        return None

    def legal(self) -> Bools | None:
        return None

    def step(self, actions: Floats) -> Transition:
        step, self._left = self._inner.step(actions), self._left - 1
        if self._left:
            return step
        final, following = step.final_observations.copy(), step.observations.copy()
        final[1] = np.nan
        if not step.truncated[1]:
            following[1] = np.nan
        return step._replace(observations=following, final_observations=final)


@pytest.mark.parametrize("name", ["PPO", "SAC", "TD3", "DQN"])
@pytest.mark.parametrize("at", [13, 20])
def test_an_observation_that_is_no_number_stops_the_run_also_where_an_episode_ends_with_it(
    store: Store[Segment], name: Name, at: int
) -> None:
    learner = _learner(_diverging(ALGORITHMS[name].actions == "discrete", at), _settings(name))
    with pytest.raises(FloatingPointError, match=f"observation of environment 1 after step {at - 1} of the rollout"):
        learner.improve(Known(), store, np.random.default_rng(0))


def test_what_an_algorithm_does_and_what_an_episode_begins_with_are_numbers_too() -> None:
    env = TaskEnv(ControlSettings(env="Pendulum-v1", horizon=9, segment_steps=3).build(), 2)
    env.start(np.random.default_rng(0))
    env.reset()
    env.step(np.zeros((2, 1), np.float32))
    with pytest.raises(FloatingPointError, match="action of environment 1 in step 1 of the rollout is"):
        env.step(np.array([[0.5], [np.nan]], np.float32))
    env = TaskEnv(_diverging(discrete=False, at=99, starts=(0.0, np.inf)), 2)
    with pytest.raises(FloatingPointError, match="first observation of an episode of environment 1"):
        env.reset()


@both
@pytest.mark.parametrize("bare", [True, False])
def test_a_shrunk_round_is_one_small_rollout_that_still_learns(
    store: Store[Segment], algorithm: dict[str, Any], bare: bool
) -> None:
    late = {"learning_starts": 1000} if algorithm is SAC_ else {}
    options = {} if bare else {**algorithm["options"], **late, "batch_size": 20}
    values = {"algorithm": algorithm["algorithm"], "options": options, "steps_per_round": 40960, "policy": NET}
    settings = SB3Settings.model_validate({**values, "environments": 2})
    small = settings.shrunk()
    assert (small.steps_per_round <= 128, small.evaluation_episodes) == (True, 1)
    assert settings.work() / small.work() == 40960 / small.steps_per_round
    learner = small.build(point(), np.random.default_rng(0))
    before = _bytes(learner)
    learner.improve(Known(), store, np.random.default_rng(0))
    assert learner.steps.learn == small.steps_per_round
    assert _bytes(learner) != before


def test_a_shrunk_round_hides_no_mistake_in_the_settings() -> None:
    settings = SB3Settings(environments=2, steps_per_round=100, options={"n_steps": 20, "batch_size": 40})
    with pytest.raises(ConfigError, match="must be a multiple of 40"):
        settings.shrunk().build(point(), np.random.default_rng(0))


def test_steps_that_the_algorithm_would_overshoot_are_refused() -> None:
    with pytest.raises(ConfigError, match="must be a multiple of 40"):
        _learner(point(), PPO, steps_per_round=100)


def test_an_option_that_the_algorithm_does_not_have_is_refused_by_name() -> None:
    with pytest.raises(ConfigError, match="learning_rat"):
        _learner(point(), {"algorithm": "PPO", "options": {"learning_rat": 1.0}})


FITS = {"batch_size": 40}  # stable-baselines3 warns of one that does not divide the rollout


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"options": FITS | {"learning_rate": "fast"}}, r"learner\.options=.*schedule must be a float or a callable"),
        ({"options": {"n_steps": 1, "batch_size": 1}}, r"learner\.options=.*`batch_size` must be greater than 1"),
        ({"options": FITS, "policy": {"squash_output": True}}, r"learner\.policy=.*only available when using gSDE"),
        ({"policy": {"activation_fn": "rellu"}}, r"activation_fn: 'rellu' is none of torch\.nn's; did you mean 'relu'"),
    ],
)
def test_a_value_that_the_algorithm_cannot_use_is_refused_with_what_it_says(settings: Any, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        _learner(point(), {"algorithm": "PPO"} | settings)


def test_a_networks_activation_is_set_by_name() -> None:
    learner = _learner(point(), {"algorithm": "SAC", "policy": {"net_arch": [4], "activation_fn": "gelu"}})
    assert isinstance(learner.model.actor.latent_pi[1], torch.nn.GELU)


def test_the_algorithm_is_stable_baselines3s_own() -> None:
    assert isinstance(_learner(point(), SAC_).model, SAC)


def test_the_wrapper_shows_a_reward_the_running_episode_as_far_back_as_it_looks() -> None:
    task = ControlSettings(env="Pendulum-v1", horizon=6, segment_steps=3).build()
    env, reward = LearnedReward(TaskEnv(task, 2), None), Ageing()
    env.learned = reward
    env.reset()
    found = [env.step(np.zeros((2, 1), np.float32))[1].tolist() for _ in range(9)]
    assert found == [[float(min(t, 4))] * 2 for t in (1, 2, 3, 4, 5, 6, 1, 2, 3)]
    env.reset()
    assert env.step(np.zeros((2, 1), np.float32))[1].tolist() == [1.0, 1.0]


def test_the_wrapper_gives_the_rewards_of_the_whole_rollout() -> None:
    task = ControlSettings(env="Pendulum-v1", horizon=7, segment_steps=3).build()
    reward = GRUSettings(width=8).build(task, np.random.default_rng(0))
    inner = TaskEnv(task, 2)
    env, rng = LearnedReward(inner, reward), np.random.default_rng(1)
    inner.start(rng)
    env.reset()
    found = np.stack([env.step(rng.uniform(-2, 2, (2, 1)).astype(np.float32))[1] for _ in range(17)], 1)
    np.testing.assert_allclose(found, learned_rewards(reward, inner.rollout()), rtol=1e-4, atol=1e-5)


def test_an_algorithm_that_does_not_know_legal_moves_is_stopped_at_the_first_that_is_not() -> None:
    learner = _learner(corridor(), PPO)
    with pytest.raises(ValueError, match=r"is not legal there; .* learner.kind=control"):
        learner.sample(10, np.random.default_rng(0))


@both
def test_an_evaluation_plays_the_mode_whatever_the_global_generators_say(algorithm: dict[str, Any]) -> None:
    learner, gold = _learner(point(), algorithm), []
    for seed in (0, 1):
        torch.manual_seed(seed)
        gold.append(learner.evaluate(Known(), np.random.default_rng(0)).metrics)
    assert gold[0] == gold[1]


def _all(learner: SB3, value: float) -> None:
    """Make every weight this: 0 leaves the point where it is, and with 10 it is pushed away."""
    with torch.no_grad():
        for p in learner.model.policy.parameters():
            p.fill_(value)


@pytest.mark.parametrize("name", ["PPO", "SAC", "CrossQ"])
def test_a_policy_that_lost_clearly_goes_back_and_what_is_replayed_stays(store: Store[Segment], name: Name) -> None:
    learner, rng = _learner(_task(name), _settings(name), rollback=0.1), np.random.default_rng
    learner.improve(Known(), store, rng(0))
    _all(learner, 0.0)
    learner.evaluate(Known(), rng(1))
    assert learner.settle(Known()) is None
    good, moments = _bytes(learner), deepcopy(_optimizer(learner).state_dict())
    learner.improve(Known(), store, rng(2))
    _all(learner, 10.0)
    replayed = replay_state(learner.model.replay_buffer) if ALGORITHMS[name].replays else {}
    learner.evaluate(Known(), rng(1))
    undone = learner.settle(Known())
    assert undone is not None
    assert undone.notes[0].startswith("round 2 was undone")
    assert _bytes(learner) == good
    _assert_same(_optimizer(learner).state_dict()["state"], moments["state"])
    assert learner.steps.learn == 160
    if replayed:
        assert learner.model.replay_buffer.size() == len(replayed["rewards"]) == 75
    learner.improve(Known(), store, rng(3))  # which does not change the best policy that is kept
    assert _bytes(learner) != good
    assert learner.go_back() == 1
    assert _bytes(learner) == good
    _assert_same(_optimizer(learner).state_dict()["state"], moments["state"])


def _optimizer(learner: SB3) -> torch.optim.Optimizer:
    critic = "critic.optimizer" in learner.model._get_torch_save_params()[0]
    found: torch.optim.Optimizer = learner.model.critic.optimizer if critic else learner.model.policy.optimizer
    return found


def _assert_same(one: dict[int, Any], other: dict[int, Any]) -> None:
    for number, moments in other.items():
        assert all(torch.equal(one[number][name], x) for name, x in moments.items())


def test_without_rollback_the_last_policy_stands(store: Store[Segment]) -> None:
    learner = _learner(point(), SAC_)
    for number in range(2):
        learner.improve(Known(), store, np.random.default_rng(number))
        if number:
            _all(learner, 10.0)
        learner.evaluate(Known(), np.random.default_rng(1))
        assert learner.settle(Known()) is None
    assert learner.go_back() is None


def test_exploration_falls_over_the_run_and_not_in_each_round_anew(store: Store[Segment], tmp_path: Any) -> None:
    schedule = {"exploration_fraction": 1.0, "exploration_initial_eps": 1.0, "exploration_final_eps": 0.2}
    settings = {"algorithm": "DQN", "options": {**REPLAYS, **schedule}}
    learner, rates = _learner(_task("DQN"), settings), []
    for number in range(4):
        learner.pace(number / 4, (number + 1) / 4)
        learner.improve(Known(), store, np.random.default_rng(number))
        rates.append(learner.model.exploration_rate)
    assert rates == pytest.approx([0.8, 0.6, 0.4, 0.2])
    other = _learner(_task("DQN"), settings)
    save_state(tmp_path, "learner", learner.state())
    other.load(load_state(tmp_path, "learner"))
    assert other.model.exploration_rate == rates[-1]


@pytest.mark.parametrize("name", ["DQN", "DoubleDQN", "QRDQN", "TD3", "DDPG"])
def test_where_a_policy_draws_nothing_first_questions_are_about_random_actions(name: Name) -> None:
    pool = _learner(_task(name), _settings(name)).sample(20, np.random.default_rng(0))
    actions = np.concatenate([s.actions for s in pool])
    assert 0.3 < (actions[:, 0] > 0).mean() < 0.7
    again = _learner(_task(name), _settings(name), seed=7).sample(20, np.random.default_rng(0))
    assert [s.id for s in pool] == [s.id for s in again]


def test_sums_over_several_steps_learn_in_the_loop_and_stop_where_a_round_ends(store: Store[Segment]) -> None:
    learner = _learner(point(), {**SAC_, "options": {**SAC_["options"], "n_steps": 3}}, steps_per_round=60)
    for number in range(2):
        learner.improve(Known(), store, np.random.default_rng(number))
    buffer = learner.model.replay_buffer
    assert isinstance(buffer, NStepReplayBuffer)
    # Episodes of 20 steps end at their time; a round of 30 ends in the middle of one.
    assert np.flatnonzero(buffer.timeouts[:60, 0]).tolist() == [19, 29, 49, 59]
    np.testing.assert_allclose(buffer.rewards[:60], 1 - 2 * np.abs(buffer.observations[:60, :, 0]), atol=1e-6)


def test_the_memory_of_a_recurrent_policy_goes_along_and_is_forgotten_where_an_episode_begins() -> None:
    learner = _learner(point(), _settings("RecurrentPPO"))
    act, observations = learner._act(deterministic=True), np.random.default_rng(0).normal(size=(3, 3, 1))
    begins, state = np.array([[True] * 3, [False] * 3, [False, True, False]]), None
    for seen, begin in zip(observations.astype(np.float32), begins, strict=True):
        found, _ = act(seen, None, begin)
        expected, state = learner.model.predict(seen, state, begin, deterministic=True)
        np.testing.assert_allclose(found, expected, atol=1e-6)
    first, memory = learner.actor()(seen, None, None)
    assert memory is not None
    assert memory.shape == (3, 2 * 2 * 6)
    assert not np.allclose(learner.actor()(seen, None, memory)[0], first, atol=1e-6)


class Parts(gymnasium.Env[dict[str, Any], Any]):
    """A point on a line, seen in two parts."""

    observation_space = gymnasium.spaces.Dict({"place": UNIT, "side": gymnasium.spaces.Discrete(2)})
    action_space = UNIT

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, Any], Any]:
        super().reset(seed=seed)
        self.place, self.age = self.np_random.uniform(-1, 1, 1).astype(np.float32), 0
        return self._seen(), {}

    def step(self, action: Any) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        self.place, self.age = np.clip(self.place + 0.2 * action, -1, 1).astype(np.float32), self.age + 1
        return self._seen(), float("nan"), False, self.age == 10, {}

    def _seen(self) -> dict[str, Any]:
        return {"place": self.place, "side": int(self.place[0] > 0)}


def test_observations_in_parts_learn_in_a_script_of_ones_own() -> None:
    worth = [Known(lambda o, a: o @ np.array([1.0, 10.0, 100.0])), Known(lambda o, a: -o[..., 0])]
    env = LearnedReward(DummyVecEnv([Parts] * 2), worth[0])
    model = SAC("MultiInputPolicy", env, buffer_size=30, learning_starts=10, batch_size=8, policy_kwargs=NET, seed=0)
    model.learn(40)  # wraps the ring of 15 steps
    buffer: Any = model.replay_buffer
    place, side = buffer.observations["place"][..., 0], buffer.observations["side"][..., 0]
    np.testing.assert_allclose(buffer.rewards, place + np.where(side > 0, 100.0, 10.0), rtol=1e-6)
    relabel(buffer, worth[1])
    np.testing.assert_allclose(buffer.rewards, -place)
