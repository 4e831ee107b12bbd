"""A policy with adapters: its start is itself without them, little is kept, and what is exported is the same policy."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
import torch
from families import tiny
from peft import PeftModel
from transformers import AutoModelForCausalLM, AutoTokenizer

from prefrl.components import ConfigError
from prefrl.envs.text import Reviews
from prefrl.envs.texts import TextsSettings
from prefrl.improve.text import TextLearner, TextLearnerSettings
from prefrl.policies.generate import Sampling, generate
from prefrl.policies.language import LanguagePolicy, LanguageSettings, save_model
from prefrl.policies.lora import add_adapters, without_adapters
from prefrl.policies.responses import Responses
from prefrl.protocols import RewardModel, Store, TextTask
from prefrl.types import Floats, Response

NO_STORE = cast("Store[Response]", None)


class Long:
    def score(self, candidates: Sequence[Response]) -> Floats:
        return np.array([len(c.tokens) for c in candidates], np.float32)


def learner(task: TextTask, **changes: Any) -> TextLearner:
    given: dict[str, Any] = {"updates": 2, "prompts": 4, "responses": 4, "policy": {"train": "lora", "lora_rank": 4}}
    settings = TextLearnerSettings.model_validate(given | {"learning_rate": 1e-2} | changes)
    return settings.build(task, np.random.default_rng(0))


def improved(task: TextTask, **changes: Any) -> TextLearner:
    one = learner(task, **changes)
    one.improve(cast("RewardModel[Response]", Long()), NO_STORE, np.random.default_rng(1))
    return one


def some(policy: LanguagePolicy, rng: np.random.Generator) -> Responses:
    return policy.respond(policy.task.prompts(3, rng), 4, rng)


def test_the_start_is_the_model_without_its_adapters(toy_reviews: Reviews, rng: np.random.Generator) -> None:
    whole, one = LanguagePolicy(toy_reviews, 1.0, LanguageSettings(), rng), improved(toy_reviews).policy
    drawn = some(whole, rng)
    torch.testing.assert_close(one.start_logp(drawn), whole.start_logp(drawn))
    assert (one.log_prob(drawn)[0] - one.start_logp(drawn)).abs().max() > 0.01
    assert all(p.requires_grad for p in one.parameters())
    assert len(one.parameters()) == 14  # one layer has seven matrices; two for each


@pytest.mark.parametrize("train", ["lora", "full"])
def test_the_start_writes_what_it_wrote_before_anything_was_learned(toy_reviews: Reviews, train: str) -> None:
    rng, prompts = np.random.default_rng, toy_reviews.prompts(3, np.random.default_rng(0))
    fresh = LanguagePolicy(toy_reviews, 1.0, LanguageSettings(), rng(0)).respond(prompts, 4, rng(1))
    one = improved(toy_reviews, policy={"train": train}, score="log_quantile").policy
    assert torch.equal(one.respond_at_start(prompts, 4, rng(1)).tokens, fresh.tokens)
    assert not torch.equal(one.respond(prompts, 4, rng(1)).tokens, fresh.tokens)


def test_adapters_change_nothing_at_first_and_only_they_are_kept(toy_reviews: Reviews) -> None:
    fresh = learner(toy_reviews)
    drawn = some(fresh.policy, np.random.default_rng(0))
    assert torch.equal(fresh.policy.log_prob(drawn)[0], fresh.policy.start_logp(drawn))
    one = improved(toy_reviews)
    state = one.state()
    assert all("lora_" in name for name in state["model"])
    fresh.load(state)
    assert torch.equal(fresh.policy.log_prob(drawn)[0], one.policy.log_prob(drawn)[0])


@pytest.mark.parametrize("name", ["gpt2", "gpt_neox", "phi", "qwen2"])
def test_every_shape_that_is_written_out_knows_adapters(name: str, rng: np.random.Generator) -> None:
    model = tiny(name)
    add_adapters(model, 4, "all-linear", rng, "learner.policy")
    with torch.no_grad():
        for parameter in model.parameters():
            if parameter.requires_grad:
                parameter.add_(torch.randn(parameter.shape, generator=torch.Generator().manual_seed(0)), alpha=0.3)
    found = [
        generate(model, [[3, 4, 5], [6]], Sampling(2, 12, ()), torch.Generator().manual_seed(0), fast=fast)
        for fast in (True, False)
    ]
    assert torch.equal(found[0].tokens, found[1].tokens)
    torch.testing.assert_close(found[0].logp, found[1].logp, atol=1e-4, rtol=0)
    with without_adapters(model):
        bare = generate(model, [[3, 4, 5], [6]], Sampling(2, 12, ()), torch.Generator().manual_seed(0))
    assert not torch.equal(bare.logp, found[0].logp)


def test_sampling_with_adapters_is_fast_and_exact(toy_reviews: Reviews) -> None:
    """The decoder that is written out adds the adapters' products; it must not read the frozen matrices alone."""
    one = improved(toy_reviews).policy
    prompts = [toy_reviews.encode(p) for p in toy_reviews.prompts(3, np.random.default_rng(0))]
    found = [
        generate(one.model, prompts, Sampling(2, 12, ()), torch.Generator().manual_seed(0), fast=fast)
        for fast in (True, False)
    ]
    assert torch.equal(found[0].tokens, found[1].tokens)
    torch.testing.assert_close(found[0].logp, found[1].logp, atol=1e-4, rtol=0)


@pytest.mark.parametrize("train", ["full", "lora"])
def test_an_exported_policy_is_what_transformers_loads(
    toy_reviews: Reviews, tmp_path: Path, train: str, rng: np.random.Generator
) -> None:
    policy = improved(toy_reviews, policy={"train": train}).policy
    drawn = some(policy, rng)
    policy.save(tmp_path / "policy")
    loaded: Any = AutoModelForCausalLM.from_pretrained(tmp_path / "policy")
    tokenizer = AutoTokenizer.from_pretrained(tmp_path / "policy")
    assert tokenizer.get_vocab() == toy_reviews.tokenizer.get_vocab()
    assert loaded.generation_config.eos_token_id == list(toy_reviews.ends)
    expected = policy.log_prob(drawn)[0].detach()
    torch.testing.assert_close(_plain(loaded, drawn), expected, atol=1e-5, rtol=0)


@pytest.mark.filterwarnings("ignore:.*is_gradient_checkpointing:FutureWarning")  # peft asks for it
def test_exported_adapters_are_what_peft_loads(toy_reviews: Reviews, tmp_path: Path, rng: np.random.Generator) -> None:
    policy = improved(toy_reviews).policy
    drawn = some(policy, rng)
    policy.save(tmp_path / "adapter", adapter=True)
    loaded: Any = PeftModel.from_pretrained(toy_reviews.model(), tmp_path / "adapter").eval()
    torch.testing.assert_close(_plain(loaded, drawn), policy.log_prob(drawn)[0].detach(), atol=1e-5, rtol=0)
    with pytest.raises(ConfigError, match=r"learner\.policy\.train=full"):
        improved(toy_reviews, policy={"train": "full"}).policy.save(tmp_path / "none", adapter=True)


def test_a_start_that_is_an_adapter_is_the_reference_of_what_is_learned_from_it(
    toy_reviews: Reviews, tmp_path: Path, rng: np.random.Generator
) -> None:
    save_model(toy_reviews.model(), toy_reviews, tmp_path / "base", adapter=False)
    first = improved(TextsSettings(model=tmp_path / "base", prompts=said(tmp_path), response_tokens=8).build()).policy
    first.save(tmp_path / "adapter", adapter=True)
    again = TextsSettings(model=tmp_path / "adapter", prompts=said(tmp_path), response_tokens=8).build()
    second = improved(again).policy
    drawn = some(second, rng)
    expected = first.log_prob(drawn)[0].detach()
    torch.testing.assert_close(second.start_logp(drawn), expected, atol=1e-5, rtol=0)
    assert not torch.allclose(second.log_prob(drawn)[0], expected, atol=1e-4)
    whole = improved(again, policy={"train": "full"}).policy
    torch.testing.assert_close(whole.start_logp(drawn), expected, atol=1e-5, rtol=0)
    assert all(p.requires_grad for p in whole.model.parameters())
    second.save(tmp_path / "second", adapter=True)  # its base is an adapter itself
    third = LanguagePolicy(TextsSettings(model=tmp_path / "second").build(), 1.0, LanguageSettings(), rng)
    torch.testing.assert_close(third.start_logp(drawn), second.log_prob(drawn)[0].detach(), atol=1e-5, rtol=0)
    (tmp_path / "base").rename(tmp_path / "gone")
    with pytest.raises(ConfigError, match=r"is an adapter of .*base.*, which is no folder here"):
        TextsSettings(model=tmp_path / "adapter").build()


def said(folder: Path) -> Path:
    """A file of prompts."""
    path = folder / "prompts.jsonl"
    path.write_text("".join(f'{{"prompt": "it was {n}"}}\n' for n in range(16)))
    return path


@torch.no_grad()
def _plain(model: Any, drawn: Responses) -> torch.Tensor:
    found = torch.zeros(drawn.mask.shape)
    for i, prompt in enumerate(drawn.prompt_tokens):
        said = drawn.tokens[i, drawn.mask[i]]
        logits = model(input_ids=torch.tensor([[*prompt, *said.tolist()]]), use_cache=False).logits[0]
        found[i, drawn.mask[i]] = logits[len(prompt) - 1 : -1].log_softmax(-1).gather(1, said[:, None])[:, 0]
    return found


def test_a_policy_of_half_precision_learns_with_adapters_of_full(toy_reviews: Reviews) -> None:
    class Half:
        def __getattr__(self, name: str) -> Any:
            return getattr(toy_reviews, name)

        def model(self, frozen: bool = False) -> Any:
            return toy_reviews.model().to(torch.bfloat16)  # type: ignore[arg-type]

    one = TextLearnerSettings(policy=LanguageSettings(train="lora"), updates=1, prompts=4, responses=4).build(
        cast(Any, Half()), np.random.default_rng(0)
    )
    metrics = one.improve(cast("RewardModel[Response]", Long()), NO_STORE, np.random.default_rng(1))
    assert all(p.dtype == torch.float32 for p in one.policy.parameters())
    assert np.isfinite(metrics["grad_norm"])
    assert LanguagePolicy(
        toy_reviews,
        1.0,
        LanguageSettings(train="lora", lora_rank=2, lora_targets="default"),
        np.random.default_rng(0),
    ).parameters()
