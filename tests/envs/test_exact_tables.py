"""What is exact in tables: three ways to the same return, distributions that stay, improvement that never loses."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_worlds import policy, world

from prefrl.envs import exact
from prefrl.envs.exact import MDP


@pytest.mark.parametrize("seed", range(3))
def test_the_return_is_the_same_by_time_by_occupancy_and_by_values(seed: int) -> None:
    mdp = world(seed)
    acts = policy(seed, mdp)
    over_time = mdp.discount ** np.arange(500) @ (exact.marginals(mdp, acts, 500) * mdp.rewards).sum((1, 2))
    by_occupancy = (exact.occupancy(mdp, acts) * mdp.rewards).sum() / (1 - mdp.discount)
    assert abs(over_time - exact.objective(mdp, acts)) < 1e-12
    assert abs(by_occupancy - exact.objective(mdp, acts)) < 1e-12


@pytest.mark.parametrize("seed", range(3))
def test_a_step_leaves_the_stationary_distribution_as_it_is_and_leads_to_it(seed: int) -> None:
    mdp = world(seed)
    acts = policy(seed, mdp)
    mu = exact.stationary(mdp, acts)
    assert abs(mu.sum() - 1) < 1e-12
    assert np.abs(mu.ravel() @ exact.chain(mdp, acts) - mu.ravel()).max() < 1e-12
    np.testing.assert_allclose(exact.marginals(mdp, acts, 2000)[-1], mu, atol=1e-9)


def test_the_occupancy_is_stationary_where_the_chain_begins_anew() -> None:
    mdp = world(4)
    acts = policy(4, mdp)
    anew = replace(mdp, transitions=mdp.discount * mdp.transitions + (1 - mdp.discount) * mdp.start)
    np.testing.assert_allclose(exact.occupancy(mdp, acts), exact.stationary(anew, acts), atol=1e-12)


def test_a_chain_in_two_parts_has_no_single_stationary_distribution() -> None:
    apart = MDP(np.eye(2)[:, None], np.zeros((2, 1)), np.array([0.5, 0.5]))
    with pytest.raises(ValueError, match="no single stationary distribution"):
        exact.stationary(apart, np.ones((2, 1)))


@pytest.mark.parametrize("horizon", [None, 4])
def test_the_gradient_is_that_of_the_return(horizon: int | None) -> None:
    mdp, logits, step = world(5), np.random.default_rng(5).normal(size=(5, 3)), 1e-6
    found = exact.gradient(mdp, exact.soft(logits, 1.0), horizon)
    for place in np.ndindex(logits.shape):
        nudge = np.zeros_like(logits)
        nudge[place] = step
        up, down = (exact.objective(mdp, exact.soft(logits + sign * nudge, 1.0), horizon) for sign in (1, -1))
        assert found[place] == pytest.approx((up - down) / (2 * step), abs=1e-7)


def test_values_to_a_horizon_add_up_to_the_return_to_it() -> None:
    mdp = world(6)
    acts = policy(6, mdp)
    values = exact.returns_to_go(mdp, acts, 7)
    np.testing.assert_array_equal(values[-1], mdp.rewards)
    assert mdp.start @ exact.state_values(acts, values)[0] == pytest.approx(exact.objective(mdp, acts, 7), abs=1e-12)


@given(seed=st.integers(0, 10**6), states=st.integers(1, 6), actions=st.integers(1, 4), discount=st.floats(0, 0.99))
@settings(max_examples=200, deadline=None)
def test_greedy_improvement_is_nowhere_worse(seed: int, states: int, actions: int, discount: float) -> None:
    mdp = world(seed, states, actions, discount)
    acts = policy(seed, mdp)
    values = exact.action_values(mdp, acts)
    better = exact.greedy(values)
    before, after = exact.state_values(acts, values), exact.state_values(better, exact.action_values(mdp, better))
    assert (after >= before - 1e-9).all()


@pytest.mark.parametrize("seed", range(3))
def test_value_and_policy_iteration_find_the_same_and_nothing_is_better(seed: int) -> None:
    mdp = world(seed)
    best, values = exact.policy_iteration(mdp)
    np.testing.assert_allclose(exact.value_iteration(mdp), values, atol=1e-11)
    np.testing.assert_allclose(values, mdp.rewards + mdp.discount * mdp.transitions @ values.max(1), atol=1e-11)
    assert exact.best_objective(mdp) >= max(exact.objective(mdp, policy(i, mdp)) for i in range(20))
    assert exact.regret(mdp, best) == pytest.approx(0, abs=1e-12)
    worst, _ = exact.policy_iteration(replace(mdp, rewards=-mdp.rewards))
    assert exact.regret(mdp, worst) == pytest.approx(1)


def test_where_all_policies_are_alike_there_is_no_regret() -> None:
    assert exact.regret(replace(world(0), rewards=np.ones((5, 3))), policy(0, world(0))) == 0


def test_soft_improvement_lies_between_greedy_and_uniform() -> None:
    values = np.array([[0.0, 1.0], [3.0, 0.0]])
    np.testing.assert_allclose(exact.soft(values, 1e-3), exact.greedy(values), atol=1e-12)
    np.testing.assert_allclose(exact.soft(values, 1e9), 0.5, atol=1e-8)
    assert exact.soft(values, 1.0)[0, 1] == pytest.approx(np.e / (1 + np.e))


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"rewards": np.zeros((4, 3))}, r"expected transitions \(S, A, S\).* got \(5, 3, 5\), \(4, 3\)"),
        ({"start": np.full(5, 0.3)}, "start: expected probabilities that add up to 1"),
        ({"start": np.array([2.0, -1, 0, 0, 0])}, "start: expected probabilities"),
        ({"discount": 1.0}, "a discount of at least 0 and below 1, got 1.0"),
    ],
)
def test_tables_that_are_no_decision_process_are_refused(changes: dict[str, object], says: str) -> None:
    with pytest.raises(ValueError, match=says):
        replace(world(0), **changes)  # type: ignore[arg-type]
