"""A language model as a policy: what was sampled is scored as it was, and what came as text is encoded once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from prefrl.envs.text import Reviews
from prefrl.policies.language import LanguagePolicy, LanguageSettings, enough_memory
from prefrl.policies.responses import Responses


def test_sampled_responses_come_back_token_for_token(toy_reviews: Reviews, rng: np.random.Generator) -> None:
    policy = LanguagePolicy(toy_reviews, 1.0, LanguageSettings(), rng)
    drawn = policy.respond(toy_reviews.prompts(3, rng), 4, rng)
    again = Responses.of(policy.with_gold(drawn), toy_reviews)
    assert torch.equal(again.mask, drawn.mask)
    assert torch.equal(again.tokens * again.mask, drawn.tokens * drawn.mask)
    assert torch.equal(again.ended, drawn.ended)
    assert again.prompt_tokens == drawn.prompt_tokens
    found, none = policy.log_prob(again)
    assert none is None
    torch.testing.assert_close(found.detach(), drawn.logp, atol=1e-4, rtol=1e-4)
    torch.testing.assert_close(policy.start_logp(again), found.detach(), atol=1e-4, rtol=1e-4)


def test_responses_that_came_as_text_get_a_begin_and_an_end_token_once(
    toy_reviews: Reviews, rng: np.random.Generator
) -> None:
    policy, tokenizer = LanguagePolicy(toy_reviews, 1.0, LanguageSettings(), rng), toy_reviews.tokenizer
    drawn = [r for r in policy.with_gold(policy.respond(toy_reviews.prompts(2, rng), 4, rng)) if r.tokens[-1] == 2]
    texts = [replace(one, tokens=(), prompt_tokens=()) for one in drawn]
    found = Responses.of(texts, toy_reviews)
    assert found.ended.all()
    for i, one in enumerate(drawn):
        assert found.prompt_tokens[i] == one.prompt_tokens
        assert tokenizer.decode(found.tokens[i, found.mask[i]].tolist(), skip_special_tokens=True) == one.text
        assert (found.tokens[i, found.mask[i]] == int(tokenizer.eos_token_id)).sum() == 1


def test_where_memory_runs_out_the_setting_is_named_that_halves_it() -> None:
    with (
        pytest.raises(MemoryError, match=r"halve learner\.policy\.chunk, which is 64; .*train=lora"),
        enough_memory("learner.policy.chunk", 64),
    ):
        torch.empty(2**60)
    with pytest.raises(RuntimeError, match="must match"), enough_memory("learner.policy.chunk", 64):
        torch.ones(2) + torch.ones(3)


def test_without_a_critic_there_are_no_values(toy_reviews: Reviews, rng: np.random.Generator) -> None:
    policy = LanguagePolicy(toy_reviews, 1.0, LanguageSettings(), rng)
    with pytest.raises(ValueError, match="has no values"):
        policy.values(policy.respond(toy_reviews.prompts(1, rng), 2, rng))
