from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from small_pictures import policy_of, small_digits
from torch.distributions import Normal, kl_divergence

from prefrl.policies.denoiser import Chains, Denoiser, DenoiserPolicy
from prefrl.storage.checkpoints import load_state, save_state


@pytest.fixture(scope="module")
def policy() -> DenoiserPolicy:
    """One that has moved away from its start."""
    return moved(policy_of(small_digits("a three", "an eight")))


def moved(policy: DenoiserPolicy) -> DenoiserPolicy:
    torch.manual_seed(0)
    with torch.no_grad():
        for parameter in policy.parameters():
            parameter.add_(0.05 * torch.randn_like(parameter))
    return policy


def drawn(policy: DenoiserPolicy, count: int = 20) -> Chains:
    return policy.draw(["a three", "an eight"] * (count // 2), np.random.default_rng(0))


def steps_by_hand(model: Denoiser, chains: Chains, level: int) -> Normal:
    """The Gaussian of one step, from Ho et al. 2020, equations 6 and 7, in their letters."""
    bar = model.signal.double()
    before = chains.states[:, model.steps - level]
    clean = model.clean(before, torch.full((len(before),), level), chains.captions)
    alpha, beta = bar[level] / bar[level - 1], 1 - bar[level] / bar[level - 1]
    mean = bar[level - 1].sqrt() * beta / (1 - bar[level]) * clean
    mean = mean + alpha.sqrt() * (1 - bar[level - 1]) / (1 - bar[level]) * before
    return Normal(mean, ((1 - bar[level - 1]) / (1 - bar[level]) * beta).sqrt())


@torch.no_grad()
def test_a_step_is_a_gaussian_whose_probability_and_kl_are_exact(policy: DenoiserPolicy) -> None:
    chains = drawn(policy)
    logp, kl = policy.log_prob_and_kl(chains)
    assert logp.shape == kl.shape == chains.mask.shape == (20, policy.model.steps - 1)
    for at, level in enumerate(range(policy.model.steps, 1, -1)):
        ours, start = (steps_by_hand(model, chains, level) for model in (policy.model, policy.start))
        expected = ours.log_prob(chains.states[:, at + 1].double()).sum(1)  # type: ignore[no-untyped-call]
        torch.testing.assert_close(logp[:, at].double(), expected, atol=1e-3, rtol=1e-4)
        torch.testing.assert_close(kl[:, at].double(), kl_divergence(ours, start).sum(1), atol=1e-3, rtol=1e-3)
        scaled = (chains.states[:, at + 1].double() - ours.mean) / ours.stddev
        assert float(scaled.square().mean()) == pytest.approx(1.0, abs=0.15)
    assert kl.min() > 0.01
    torch.testing.assert_close(policy.kl(chains), kl)


@torch.no_grad()
def test_the_mean_of_the_log_ratio_is_the_kl(policy: DenoiserPolicy) -> None:
    chains = policy.draw(["a three"] * 4000, np.random.default_rng(0))
    ratios = (chains.logp - policy.start_logp_and_kl(chains)[0]).sum(1)
    assert float(ratios.mean()) == pytest.approx(float(policy.kl(chains).sum(1).mean()), rel=0.03)


@pytest.mark.parametrize("count", [2, 6, 20, 150])
def test_a_chain_has_the_probability_that_it_was_drawn_with_to_the_bit(policy: DenoiserPolicy, count: int) -> None:
    """However many go through the network beside it: the ratio is exactly 1 before the first step."""
    chains = drawn(policy, count)
    assert torch.equal(policy.log_prob(chains)[0], chains.logp)
    for at in torch.randperm(count).split(7):  # type: ignore[no-untyped-call]
        assert torch.equal(policy.log_prob(chains.rows(at))[0], chains.logp[at])


def test_a_fresh_policy_is_its_start_whatever_the_caption() -> None:
    one = policy_of(small_digits("a three", "an eight"))
    chains = drawn(one)
    assert torch.equal(one.start_logp_and_kl(chains)[0], chains.logp)
    assert float(one.kl(chains).max()) == 0.0
    first = one.draw(["a three"] * 4, np.random.default_rng(1))
    assert torch.equal(first.pixels, one.draw(["an eight"] * 4, np.random.default_rng(1)).pixels)


def test_a_caption_makes_a_difference_once_it_was_learned(policy: DenoiserPolicy) -> None:
    three, eight = (policy.draw([caption] * 4, np.random.default_rng(1)) for caption in ("a three", "an eight"))
    assert not torch.equal(three.pixels, eight.pixels)


def test_the_same_numbers_give_the_same_pictures_in_any_parts(policy: DenoiserPolicy) -> None:
    whole, again = drawn(policy), drawn(policy)
    assert torch.equal(whole.pixels, again.pixels)
    assert not torch.equal(whole.pixels, policy.draw(["a three"] * 20, np.random.default_rng(9)).pixels)
    assert [one.caption for one in whole.candidates(policy.task.captions)][:3] == ["a three", "an eight", "a three"]
    assert whole.pixels.dtype == torch.uint8
    assert whole.pixels.shape == (20, 8, 8)


def test_the_last_step_stays_the_starting_policys(policy: DenoiserPolicy) -> None:
    """So no picture is less probable under the start than its chain says."""
    chains = drawn(policy)
    with torch.no_grad():
        last = policy.start.clean(chains.states[:, -1], torch.ones(20, dtype=torch.int64), chains.captions)
    expected = ((last + 1) * 127.5).round().clamp(0, 255).to(torch.uint8)
    assert torch.equal(chains.pixels.flatten(1), expected)


def test_a_state_goes_through_a_checkpoint_and_another_size_is_refused(policy: DenoiserPolicy, tmp_path: Path) -> None:
    save_state(tmp_path, "policy", policy.state())
    other = policy_of(small_digits("a three", "an eight"))
    other.load(load_state(tmp_path, "policy"))
    assert torch.equal(drawn(other).pixels, drawn(policy).pixels)
    assert other.start_digest() == policy.start_digest()
    with pytest.raises(ValueError, match=r"captions.weight is missing or has another shape"):
        policy_of(small_digits("a three")).load(policy.state())


def test_gold_is_attached_and_there_is_no_critic(policy: DenoiserPolicy) -> None:
    found = policy.with_gold(drawn(policy, 4))
    assert all(one.gold is not None and one.gold.shape == (1,) and 0 <= one.gold[0] <= 1 for one in found)
    with pytest.raises(ValueError, match="no critic"):
        policy.values(drawn(policy, 4))


def test_the_noise_grows_from_none_to_all() -> None:
    signal = Denoiser(4, 1, 10, 8, 1).signal
    assert float(signal[0]) == 1.0
    assert float(signal[-1]) == pytest.approx(1e-4)
    assert (signal.diff() < 0).all()


@pytest.mark.parametrize("chunk", [1, 7])
def test_a_smaller_chunk_draws_the_same_pictures(chunk: int) -> None:
    task = small_digits("a three", "an eight")
    whole, parts = (drawn(moved(policy_of(task, size))) for size in (64, chunk))
    assert torch.equal(whole.states[:, 0], parts.states[:, 0])
    torch.testing.assert_close(whole.states, parts.states, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(whole.logp, parts.logp, atol=1e-2, rtol=1e-4)


@torch.no_grad()
def test_one_pass_of_the_start_gives_what_two_would(policy: DenoiserPolicy) -> None:
    chains = drawn(policy)
    logp, kl = policy.start_logp_and_kl(chains)
    assert torch.equal(kl, policy.kl(chains))
    assert torch.equal(kl, policy.log_prob_and_kl(chains)[1])
    unmoved = policy_of(small_digits("a three", "an eight"))
    assert torch.equal(logp, unmoved.log_prob(chains)[0])
