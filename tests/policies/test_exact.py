"""Every architecture is computed exactly, or refused by its name, before anybody is asked."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import pytest
import torch
from families import MORE, REFUSED, VOCABULARY, tiny
from torch import Tensor

from prefrl.components import ConfigError
from prefrl.policies.exact import check_exact
from prefrl.policies.generate import Sampling, generate
from prefrl.policies.logprobs import Shortcuts, response_logp, shortcuts_of
from prefrl.policies.responses import Responses


def rows_of(prompts: Sequence[Sequence[int]], tokens: Tensor, mask: Tensor) -> Responses:
    return Responses(("",) * len(prompts), tuple(map(tuple, prompts)), tokens, mask, mask.float(), mask[:, -1])


@pytest.mark.parametrize("name", MORE)
def test_an_architecture_is_computed_exactly(name: str) -> None:
    """Log-probabilities of padded rows, and of sampling, to 1e-5 those of the plain forward pass of each row alone."""
    model = tiny(name)
    shortcuts = shortcuts_of(model)
    order = torch.Generator().manual_seed(1)
    prompts = [torch.randint(3, VOCABULARY, (n,), generator=order).tolist() for n in (6, 2, 9)]
    drawn = generate(model, prompts, Sampling(2, 8, (2,)), order)
    rows = rows_of([p for p in prompts for _ in range(2)], drawn.tokens, drawn.mask)
    with torch.no_grad():
        found = response_logp(model, rows, 1.0, shortcuts)
        for i, prompt in enumerate(rows.prompt_tokens):
            said = drawn.tokens[i, drawn.mask[i]]
            plain = model(input_ids=torch.tensor([[*prompt, *said.tolist()]]), use_cache=False).logits[0]
            expected = plain[len(prompt) - 1 : -1].log_softmax(-1).gather(1, said[:, None])[:, 0]
            torch.testing.assert_close(found[i, drawn.mask[i]], expected, atol=1e-5, rtol=0)
            torch.testing.assert_close(drawn.logp[i, drawn.mask[i]], expected, atol=1e-5, rtol=0)
    check_exact(model, lambda p, t, m: response_logp(model, rows_of(p, t, m), 1.0, shortcuts))


@pytest.mark.parametrize("name", REFUSED)
def test_an_architecture_that_is_not_exact_is_refused_by_name(name: str) -> None:
    model = tiny(name)
    with pytest.raises(ConfigError, match=rf"task\.model: a {type(model).__name__} \({name}\)"):
        check_exact(model, lambda p, t, m: response_logp(model, rows_of(p, t, m), 1.0, shortcuts_of(model)))


@pytest.mark.parametrize(("name", "alone"), [("llama", True), ("cohere", False), ("gemma2", False), ("granite", False)])
def test_what_is_done_to_logits_after_the_head_is_noticed(name: str, alone: bool) -> None:
    assert shortcuts_of(tiny(name)).head_alone is alone


@pytest.mark.parametrize("name", ["llama", "gpt2", "bloom", "qwen3", "mixtral"])
def test_a_prompt_that_is_run_once_gets_the_gradient_of_all_its_responses(name: str) -> None:
    model = tiny(name)
    order = torch.Generator().manual_seed(1)
    prompts = [torch.randint(3, VOCABULARY, (n,), generator=order).tolist() for n in (6, 2, 9) for _ in range(3)]
    lengths = torch.tensor([5, 1, 3, 4, 2, 5, 1, 1, 1])
    mask = torch.arange(5) < lengths[:, None]
    rows = rows_of(prompts, torch.randint(3, VOCABULARY, mask.shape, generator=order) * mask, mask)
    weights = torch.rand(mask.shape, generator=order)

    def gradient(shortcuts: Shortcuts) -> Tensor:
        model.zero_grad()
        (response_logp(model, rows, 0.7, shortcuts) * weights).sum().backward()  # type: ignore[no-untyped-call]
        return torch.cat([p.grad.flatten() for p in model.parameters() if p.grad is not None])

    apart, shared = gradient(Shortcuts(head_alone=True)), gradient(shortcuts_of(model))
    assert float((apart - shared).norm() / apart.norm()) < 1e-6
    assert shortcuts_of(model).prompts_once


def test_prompts_are_run_once_only_where_that_changes_nothing() -> None:
    """Its attention counts columns, padding included."""
    assert not shortcuts_of(tiny("mpt")).prompts_once


@pytest.mark.parametrize(("name", "window"), [("mistral", "sliding_window"), ("gpt_neo", "window_size")])
def test_prompts_that_a_window_may_cut_are_run_with_each_response(
    name: str, window: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    model = tiny(name)
    monkeypatch.setattr(model.config, window, 12)
    prompts = [[5, 6, 7] * n for n in (1, 1, 4, 4)]
    mask = torch.ones(4, 6, dtype=torch.bool)
    rows = rows_of(prompts, torch.full((4, 6), 9), mask)
    with torch.no_grad():
        found = response_logp(model, rows, 1.0, Shortcuts(head_alone=True, prompts_once=True))
        expected = response_logp(model, rows, 1.0, Shortcuts(head_alone=True))
    assert torch.equal(found, expected)


def test_a_wrong_score_is_refused_whichever_token_shows_it() -> None:
    """A head that is off for one half of the vocabulary alone."""
    model = tiny("llama")

    def off(prompts: Any, tokens: Tensor, mask: Tensor) -> Tensor:
        found = response_logp(model, rows_of(prompts, tokens, mask), 1.0)
        return torch.where(tokens > VOCABULARY // 2, found + 0.01, found)

    with pytest.raises(ConfigError, match=r"log-probabilities here differ by 0\.01 nats"):
        check_exact(model, off)
