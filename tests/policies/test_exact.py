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
from prefrl.policies.logprobs import head_alone, response_logp
from prefrl.policies.responses import Responses


def rows_of(prompts: Sequence[Sequence[int]], tokens: Tensor, mask: Tensor) -> Responses:
    return Responses(("",) * len(prompts), tuple(map(tuple, prompts)), tokens, mask, mask.float(), mask[:, -1])


@pytest.mark.parametrize("name", MORE)
def test_an_architecture_is_computed_exactly(name: str) -> None:
    """Log-probabilities of padded rows, and of sampling, to 1e-5 those of the plain forward pass of each row alone."""
    model = tiny(name)
    alone = head_alone(model)
    order = torch.Generator().manual_seed(1)
    prompts = [torch.randint(3, VOCABULARY, (n,), generator=order).tolist() for n in (6, 2, 9)]
    drawn = generate(model, prompts, Sampling(2, 8, (2,)), order)
    rows = rows_of([p for p in prompts for _ in range(2)], drawn.tokens, drawn.mask)
    with torch.no_grad():
        found = response_logp(model, rows, 1.0, alone)
        for i, prompt in enumerate(rows.prompt_tokens):
            said = drawn.tokens[i, drawn.mask[i]]
            plain = model(input_ids=torch.tensor([[*prompt, *said.tolist()]]), use_cache=False).logits[0]
            expected = plain[len(prompt) - 1 : -1].log_softmax(-1).gather(1, said[:, None])[:, 0]
            torch.testing.assert_close(found[i, drawn.mask[i]], expected, atol=1e-5, rtol=0)
            torch.testing.assert_close(drawn.logp[i, drawn.mask[i]], expected, atol=1e-5, rtol=0)
    check_exact(model, lambda p, t, m: response_logp(model, rows_of(p, t, m), 1.0, alone))


@pytest.mark.parametrize("name", REFUSED)
def test_an_architecture_that_is_not_exact_is_refused_by_name(name: str) -> None:
    model = tiny(name)
    with pytest.raises(ConfigError, match=rf"task\.model: a {type(model).__name__} \({name}\)"):
        check_exact(model, lambda p, t, m: response_logp(model, rows_of(p, t, m), 1.0, head_alone(model)))


@pytest.mark.parametrize(("name", "alone"), [("llama", True), ("cohere", False), ("gemma2", False), ("granite", False)])
def test_what_is_done_to_logits_after_the_head_is_noticed(name: str, alone: bool) -> None:
    assert head_alone(tiny(name)) is alone


def test_a_wrong_score_is_refused_whichever_token_shows_it() -> None:
    """A head that is off for one half of the vocabulary alone."""
    model = tiny("llama")

    def off(prompts: Any, tokens: Tensor, mask: Tensor) -> Tensor:
        found = response_logp(model, rows_of(prompts, tokens, mask), 1.0)
        return torch.where(tokens > VOCABULARY // 2, found + 0.01, found)

    with pytest.raises(ConfigError, match=r"log-probabilities here differ by 0\.01 nats"):
        check_exact(model, off)
