"""The policy: NumPy acts with what torch learns; densities and entropies are right."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from corridor import corridor

from prefrl.envs.control import ControlSettings
from prefrl.policies.acting import Decisions
from prefrl.policies.heads import ActionSpace
from prefrl.policies.mlp import MLPPolicy, MLPPolicySettings


def _policy(env: str, seed: int = 0) -> MLPPolicy:
    task = ControlSettings(env=env, segment_steps=5).build()
    policy = MLPPolicySettings(hidden=(16, 16), initial_std=0.7).build(task, np.random.default_rng(seed))
    policy.observe(np.random.default_rng(2).normal(1, 3, (50, len(policy.normaliser.mean))))
    return policy


def _lean(policy: MLPPolicy, bias: list[float]) -> None:
    """Towards some actions."""
    with torch.no_grad():
        policy.named()["actor_" + str(len(policy._names("actor")) - 1)].copy_(torch.tensor(bias))


@pytest.mark.parametrize("env", ["Pendulum-v1", "CartPole-v1"])
def test_numpy_acts_as_torch_would(env: str) -> None:
    policy = _policy(env)
    (weights,) = policy.parameters()
    weights.data += 0.1 * torch.randn(weights.shape, generator=torch.Generator().manual_seed(0))
    observations = np.random.default_rng(3).normal(size=(9, len(policy.normaliser.mean))).astype(np.float32)
    theirs = policy._outputs("actor", torch.from_numpy(policy.normalise(observations)))[1]
    choices, actions = policy.numpy_actor()(observations, None)
    if env == "CartPole-v1":
        assert np.array_equal(choices.argmax(1), theirs.argmax(1).numpy())
    else:
        np.testing.assert_allclose(choices, theirs.detach().numpy(), atol=1e-6)
        np.testing.assert_allclose(actions, np.clip(theirs.detach().numpy(), -1, 1) * 2, atol=1e-6)


def test_densities_and_entropies_are_those_of_torch_distributions() -> None:
    policy = _policy("Pendulum-v1")
    inputs, choices = torch.randn(7, 3), torch.randn(7, 1)
    logp, entropy = policy.log_prob(Decisions(inputs, choices))
    normal = torch.distributions.Normal(policy._outputs("actor", inputs)[1], policy.named()["log_std"].exp())
    torch.testing.assert_close(logp, normal.log_prob(choices))  # type: ignore[no-untyped-call]
    torch.testing.assert_close(entropy, normal.entropy())  # type: ignore[no-untyped-call]


def test_categorical_choices_follow_their_probabilities() -> None:
    policy = _policy("CartPole-v1")
    _lean(policy, [0.0, 1.5])
    observations = np.tile(np.array([0.1, 0.2, 0.0, -0.1], np.float32), (20_000, 1))
    choices, actions = policy.numpy_actor()(observations, np.random.default_rng(0))
    logp, entropy = policy.log_prob(Decisions(torch.from_numpy(policy.normalise(observations[:2])), torch.eye(2)))
    assert choices is actions
    assert choices.mean(0)[0] == pytest.approx(float(logp.detach()[0].exp()), abs=0.01)
    assert float(entropy.detach()[0]) == pytest.approx(-float((logp.exp() * logp).detach().sum()), abs=1e-5)


def test_gaussian_noise_has_the_stated_deviation_and_actions_keep_to_their_bounds() -> None:
    policy = _policy("Pendulum-v1")
    choices, actions = policy.numpy_actor()(np.zeros((20_000, 3), np.float32), np.random.default_rng(0))
    assert choices.std() == pytest.approx(0.7, abs=0.02)
    assert (actions.min(), actions.max()) == (-2.0, 2.0)


def test_the_normaliser_has_the_mean_and_variance_of_all_it_observed() -> None:
    policy = MLPPolicySettings(hidden=(4,)).build(ControlSettings(env="Pendulum-v1").build(), np.random.default_rng(0))
    data = np.random.default_rng(0).normal(5, 2, (90, 3)).astype(np.float32)
    policy.observe(data[:20].reshape(4, 5, 3))
    policy.observe(data[20:])
    np.testing.assert_allclose(policy.normaliser.mean, data.mean(0), rtol=1e-6)
    np.testing.assert_allclose(policy.normaliser.variance, data.var(0), rtol=1e-5)
    assert policy.normalise(np.full((1, 3), 1e6, np.float32)).tolist() == [[10.0] * 3]


@pytest.mark.parametrize("env", ["Pendulum-v1", "CartPole-v1"])
def test_new_statistics_do_not_change_what_the_policy_does(env: str) -> None:
    policy, rng = _policy(env), np.random.default_rng(5)
    size = len(policy.normaliser.mean)
    observations = rng.normal(1, 2, (50, size)).astype(np.float32)

    def done() -> tuple[np.ndarray, np.ndarray]:
        inputs = torch.from_numpy(policy.normalise(observations))
        return policy._outputs("actor", inputs)[1].detach().numpy(), policy.values_of(inputs).detach().numpy()

    before, mean, variance = done(), policy.normaliser.mean, policy.normaliser.variance
    policy.observe(rng.normal(3, 2, (40, size)))
    assert np.abs(policy.normaliser.mean - mean).min() > 0.5
    assert np.abs(policy.normaliser.variance - variance).min() > 0.1
    for one, other in zip(before, done(), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-5)


def test_an_input_that_begins_to_change_does_not_blow_weights_up() -> None:
    policy = MLPPolicySettings(hidden=(4,)).build(ControlSettings(env="Pendulum-v1").build(), np.random.default_rng(0))
    still = np.random.default_rng(1).normal(0, 1, (50, 3)) * [1.0, 1.0, 0.0]
    policy.observe(still)
    policy.observe(still + np.random.default_rng(2).normal(0, 1, (50, 3)) * [0.0, 0.0, 1.0])
    assert policy.named()["actor_0"].abs().max() < 3.0


def test_unbounded_actions_are_left_alone() -> None:
    space = ActionSpace(
        2, np.array([0, 1], np.float32), np.array([1, 3], np.float32), np.array([np.inf, 1], np.float32)
    )
    assert space.execute(np.array([[50.0, -9.0]], np.float32)).tolist() == [[50.0, -2.0]]


def test_state_and_load_give_the_same_policy() -> None:
    policy, other = _policy("Pendulum-v1"), _policy("Pendulum-v1", seed=1)
    observations = np.random.default_rng(3).normal(size=(4, 3)).astype(np.float32)
    assert other.numpy_actor()(observations, None)[0].tobytes() != policy.numpy_actor()(observations, None)[0].tobytes()
    other.load(policy.state())
    assert other.numpy_actor()(observations, None)[0].tobytes() == policy.numpy_actor()(observations, None)[0].tobytes()
    with pytest.raises(ValueError, match="actor_0 has shape"):
        other.load(_policy("CartPole-v1").state())


LEGAL = np.array([[True, False, True], [True, True, True], [False, True, False]])


def test_actions_that_are_not_legal_are_never_chosen() -> None:
    policy = MLPPolicySettings(hidden=(8,)).build(corridor(), np.random.default_rng(0))
    _lean(policy, [0.0, 3.0, 0.5])
    observations, legal = np.zeros((3_000, 1), np.float32), np.tile(LEGAL, (1_000, 1))
    drawn, _ = policy.numpy_actor()(observations, np.random.default_rng(1), legal)
    mode, _ = policy.numpy_actor()(observations[:3], None, LEGAL)
    assert not drawn[~legal].any()
    assert mode.argmax(1).tolist() == [2, 1, 1]
    expected = policy.log_prob(_three(np.eye(3, dtype=np.float32)[[2, 2, 2]]))[0].exp().detach()[:, 0]
    shares = drawn.reshape(1_000, 3, 3)[:, :, 2].mean(0)
    np.testing.assert_allclose(shares, expected.numpy(), atol=0.05)


def test_the_densities_of_legal_actions_are_those_of_a_choice_among_them_alone() -> None:
    policy = MLPPolicySettings(hidden=(8,)).build(corridor(), np.random.default_rng(0))
    _lean(policy, [0.0, 3.0, 0.5])
    choices = np.eye(3, dtype=np.float32)[[2, 0, 1]]
    logp, entropy = policy.log_prob(_three(choices))
    outputs = policy._outputs("actor", torch.zeros(3, 1))[1].detach()
    for i in range(3):
        alone = torch.distributions.Categorical(logits=outputs[i][torch.from_numpy(LEGAL[i])])
        place = int(LEGAL[i][: int(choices[i].argmax())].sum())
        assert float(logp[i].detach()) == pytest.approx(float(alone.log_prob(torch.tensor(place))), abs=1e-6)  # type: ignore[no-untyped-call]
        assert float(entropy[i].detach()) == pytest.approx(float(alone.entropy()), abs=1e-6)  # type: ignore[no-untyped-call]
    (logp.sum() + entropy.sum()).backward()  # type: ignore[no-untyped-call]
    (weights,) = policy.parameters()
    assert weights.grad is not None
    assert weights.grad.isfinite().all()


def test_where_all_actions_are_legal_it_is_as_if_nobody_had_asked() -> None:
    policy = MLPPolicySettings(hidden=(8,)).build(corridor(), np.random.default_rng(0))
    choices, every = np.eye(3, dtype=np.float32), np.ones((3, 3), bool)
    free = Decisions(torch.zeros(3, 1), torch.from_numpy(choices))
    told = Decisions(free.observations, free.choices, torch.from_numpy(every))
    for one, other in zip(policy.log_prob(free), policy.log_prob(told.rows(torch.arange(3))), strict=True):
        assert torch.equal(one, other)
    observations = np.ones((3, 1), np.float32)
    with_mask, without = (
        policy.numpy_actor()(observations, np.random.default_rng(0), legal)[0] for legal in (every, None)
    )
    np.testing.assert_array_equal(with_mask, without)


def _three(choices: np.ndarray) -> Decisions:
    """In the three situations of LEGAL."""
    return Decisions(torch.zeros(3, 1), torch.from_numpy(choices), torch.from_numpy(LEGAL))
