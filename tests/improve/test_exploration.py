"""How the noise of a policy's actions, and their bounds, are what the settings say: gSDE and squashing."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
import torch
from control_stubs import Known, point
from stable_baselines3 import PPO
from stable_baselines3.common.distributions import StateDependentNoiseDistribution

from prefrl.components import ConfigError
from prefrl.envs.control import ControlSettings
from prefrl.improve.control import ControlLearner, ControlLearnerSettings
from prefrl.improve.to_sb3 import save_ppo
from prefrl.policies.heads import ActionSpace, Noise, density
from prefrl.policies.mlp import MLPPolicy, MLPPolicySettings
from prefrl.policies.zips import read_zip
from prefrl.store import Store
from prefrl.types import Segment

Kind = Literal["mlp", "gru", "transformer"]
BOX = np.array([-2.0, 0.0], np.float32), np.array([2.0, 1.0], np.float32)


def learner(**policy: Any) -> ControlLearner:
    small: dict[str, Any] = {"environments": 4, "steps_per_round": 160, "rollout_steps": 40, "device": "cpu"}
    small |= {"minibatch": 160, "epochs": 1, "target_kl": None}  # one gradient step for each rollout
    settings = ControlLearnerSettings.model_validate(small | {"policy": policy})
    return settings.build(point(), np.random.default_rng(0))


def test_squashed_actions_are_within_their_bounds_and_tell_what_was_drawn() -> None:
    space = ActionSpace.within(2, BOX, squash=True)
    drawn = np.random.default_rng(0).normal(0.0, 1.2, (500, 2)).astype(np.float32)
    actions = space.execute(drawn)
    assert ((actions > BOX[0]) & (actions < BOX[1])).all()
    np.testing.assert_allclose(actions[:, 1], 0.5 + 0.5 * np.tanh(drawn[:, 1]), rtol=1e-6)
    np.testing.assert_allclose(space.choices(actions), drawn, atol=2e-3)
    assert np.isfinite(space.choices(np.stack(BOX))).all()  # on the bounds themselves
    unbounded = ActionSpace.within(1, (np.array([-np.inf]), np.array([np.inf])), squash=True)
    assert unbounded.execute(np.array([[7.0]], np.float32)).item() == 7.0


def test_noise_is_one_function_of_the_features_until_it_is_drawn_anew() -> None:
    noise, rng = Noise(np.log(np.full((3, 2), 0.5, np.float32)), steps=4), np.random.default_rng(0)
    features = rng.normal(size=(5, 3)).astype(np.float32)
    first = [noise(features, rng) for _ in range(4)]
    assert all(np.array_equal(one, first[0]) for one in first)
    np.testing.assert_allclose(noise(2 * features, rng) / 2, noise(features, rng), rtol=1e-5)  # of a new function
    assert not np.allclose(noise(features, rng), first[0])
    kept = Noise(np.zeros((3, 2), np.float32))
    assert np.array_equal(kept(features, rng), [kept(features, rng) for _ in range(100)][-1])


def test_densities_are_those_of_stable_baselines3() -> None:
    order = torch.Generator().manual_seed(0)
    features, outputs, choices = (torch.randn(6, size, generator=order) for size in (4, 2, 2))
    log_std = torch.randn(4, 2, generator=order)
    theirs = StateDependentNoiseDistribution(2, use_expln=False, squash_output=False)
    theirs.latent_sde_dim = 4  # as proba_distribution_net would set it
    theirs.proba_distribution(outputs, log_std, features)
    logp, entropies = density(outputs, choices, log_std, None, features)
    torch.testing.assert_close(logp[:, 0], theirs.log_prob(choices), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(entropies[:, 0], theirs.entropy(), rtol=1e-4, atol=1e-4)


def test_what_is_drawn_has_the_density_that_is_learned_by() -> None:
    rng, features = np.random.default_rng(0), np.array([[0.3, -0.8, 0.5]], np.float32)
    log_std = np.log(np.array([[0.5, 1.0], [0.2, 0.1], [0.7, 0.4]], np.float32))
    drawn = np.concatenate([Noise(log_std)(features, rng) for _ in range(4000)])
    spread = np.sqrt(features**2 @ np.exp(2 * log_std))[0]
    np.testing.assert_allclose(drawn.std(0), spread, rtol=0.05)


@pytest.mark.parametrize("kind", ["mlp", "gru", "transformer"])
@pytest.mark.parametrize("settings", [{"sde": True}, {"sde": True, "sde_steps": 3}, {"squash": True}], ids=str)
def test_every_kind_learns_and_the_ratio_begins_at_one(
    kind: Kind, settings: dict[str, Any], store: Store[Segment]
) -> None:
    ours = learner(kind=kind, **settings)
    before = ours.policy.state()["parameters"]["log_std"]
    for number in range(2):
        metrics = ours.improve(Known(), store, np.random.default_rng(number))
        assert metrics["ratio_error"] < 1e-5
    after = ours.policy.state()["parameters"]["log_std"]
    assert (before.dim() == 2) is bool(settings.get("sde"))
    assert not torch.equal(before, after)
    sampled = ours.sample(6, np.random.default_rng(2))
    assert all((np.abs(one.actions) <= 1).all() for one in sampled)


def test_noise_that_is_a_function_of_the_state_is_smoother_in_time() -> None:
    def jump(**settings: Any) -> float:
        segments = learner(kind="mlp", **settings).sample(20, np.random.default_rng(0))
        return float(np.mean([np.abs(np.diff(one.actions[:, 0])).mean() for one in segments]))

    assert jump(sde=True, squash=True) < 0.3 * jump(squash=True)


@pytest.mark.parametrize("name", ["squash", "sde"])
def test_discrete_actions_have_neither(name: str) -> None:
    cartpole = ControlSettings(env="CartPole-v1").build()
    with pytest.raises(ConfigError, match=rf"learner\.policy\.{name} is for continuous actions.*CartPole-v1"):
        MLPPolicySettings.model_validate({name: True}).build(cartpole, np.random.default_rng(0))


@pytest.mark.parametrize("squash", [False, True])
def test_a_zip_of_stable_baselines3_explores_by_the_state_as_well(squash: bool, tmp_path: Path) -> None:
    task = ControlSettings(env="Pendulum-v1").build()
    policy = MLPPolicySettings(hidden=(8,), sde=True, squash=squash).build(task, np.random.default_rng(0))
    seen = np.random.default_rng(1).normal(0.0, 2.0, (40, 3)).astype(np.float32)
    policy.observe(seen)
    policy.named()["actor_2"].data.mul_(300)  # so that actions come near their bounds
    save_ppo(policy, task, tmp_path / "policy.zip")
    theirs = PPO.load(tmp_path / "policy.zip")
    assert (theirs.use_sde, theirs.sde_sample_freq) == (True, policy.settings.sde_steps)
    _, actions = policy.numpy_actor()(seen, None)
    np.testing.assert_allclose(actions, theirs.predict(seen, deterministic=True)[0], atol=1e-5)
    assert np.abs(actions).max() > 1.5


def test_a_zip_of_stable_baselines3_does_not_squash_other_noise(tmp_path: Path) -> None:
    task = ControlSettings(env="Pendulum-v1").build()
    policy: MLPPolicy = MLPPolicySettings(squash=True).build(task, np.random.default_rng(0))
    with pytest.raises(ConfigError, match="squashes actions only together with sde"):
        save_ppo(policy, task, tmp_path / "policy.zip")


@pytest.mark.parametrize("squash", [False, True])
def test_such_a_zip_acts_and_starts_here_as_it_does_there(squash: bool, tmp_path: Path) -> None:
    noise = {"use_sde": True, "sde_sample_freq": 3}
    kwargs = {"net_arch": [8], "squash_output": squash}
    model = PPO("MlpPolicy", "Pendulum-v1", policy_kwargs=dict(kwargs), seed=0, **noise)
    model.policy.action_net.weight.data.mul_(300)
    model.save(tmp_path / "policy.zip")
    seen = np.random.default_rng(1).normal(0.0, 1.0, (40, 3)).astype(np.float32)
    expected = model.predict(seen, deterministic=True)[0]
    zipped = read_zip(tmp_path / "policy.zip")
    assert (zipped.squash, zipped.noise_steps) == (squash, 3)
    np.testing.assert_allclose(zipped.loaded().predict(seen)[0], expected, atol=1e-5)
    task = ControlSettings(env="Pendulum-v1").build()
    policy = {"hidden": [8], "sde": True, "squash": squash}
    settings = ControlLearnerSettings.model_validate({"start": tmp_path / "policy.zip", "policy": policy})
    started = settings.build(task, np.random.default_rng(0))
    np.testing.assert_allclose(started.actor()(seen, None, None)[0], expected, atol=1e-5)
    for name in ("sde", *(["squash"] if squash else [])):
        other = settings.model_copy(update={"policy": settings.policy.model_copy(update={name: False})})
        with pytest.raises(ConfigError, match=rf"has learner\.policy\.{name}=true: set it so"):
            other.build(task, np.random.default_rng(0)).actor()


def test_a_zip_with_noise_of_another_kind_is_refused(tmp_path: Path) -> None:
    for name, kwargs in (("a", {"use_expln": True}), ("b", {"full_std": False})):
        PPO("MlpPolicy", "Pendulum-v1", policy_kwargs=kwargs, use_sde=True).save(tmp_path / f"{name}.zip")
        with pytest.raises(ValueError, match="use_expln, or not full_std"):
            read_zip(tmp_path / f"{name}.zip")


def test_a_policy_of_pictures_or_other_units_is_no_start() -> None:
    for settings in ({"kind": "cnn", "image": [36, 36, 3]}, {"activation": "relu"}, {"critic_hidden": [8]}):
        with pytest.raises(ValueError, match=r"leave learner\.policy as it is, but for hidden, initial_std, sde"):
            ControlLearnerSettings.model_validate({"start": "policy.zip", "policy": settings})
    ControlLearnerSettings.model_validate({"start": "policy.zip", "policy": {"hidden": [8], "initial_std": 0.5}})
