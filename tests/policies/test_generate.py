from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
import torch
from families import tiny
from torch import Tensor
from transformers import GPT2Config, GPT2LMHeadModel, LlamaConfig, LlamaForCausalLM, PreTrainedModel

from prefrl.policies.decoder import FastDecoder, plan
from prefrl.policies.generate import Generation, Sampling, draw, generate, pad_left
from prefrl.policies.logprobs import Shortcuts, all_logp, response_logp
from prefrl.policies.responses import Responses

V = 50
PROMPTS = [[1, 7, 8, 9, 10, 11], [1, 5], [1, 20, 21], [1]]
ENDS = (2, 3, 4, 30, 31)


def llama(context: int = 64) -> PreTrainedModel:
    torch.manual_seed(0)  # two ways of computing agree on draws only where none is close
    config = LlamaConfig(
        vocab_size=V,
        hidden_size=32,
        intermediate_size=48,
        num_hidden_layers=2,
        num_attention_heads=4,
        num_key_value_heads=2,
        max_position_embeddings=context,
    )
    return _loud(LlamaForCausalLM(config))


def gpt2(context: int = 64) -> PreTrainedModel:
    """Absolute positions: what a model with left padding gets wrong without position ids."""
    torch.manual_seed(0)
    return _loud(GPT2LMHeadModel(GPT2Config(vocab_size=V, n_embd=32, n_layer=2, n_head=4, n_positions=context)))


def _loud(model: PreTrainedModel) -> PreTrainedModel:
    """Random weights large enough that the distributions are far from uniform."""
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for p in model.parameters():
            p.add_(torch.randn(p.shape, generator=generator), alpha=0.3 if p.ndim == 2 else 0.1)
    model.eval()  # type: ignore[no-untyped-call]
    return model


def drawn(model: PreTrainedModel, sampling: Sampling, fast: bool = True, seed: int = 0) -> Generation:
    return generate(model, PROMPTS, sampling, torch.Generator().manual_seed(seed), fast)


@pytest.mark.parametrize("fast", [True, False])
@pytest.mark.parametrize("name", ["llama", "gpt2", "qwen3", "phi"])
def test_rows_that_end_make_room_for_others_and_nothing_else_changes(name: str, fast: bool) -> None:
    model = family(name)
    order = torch.Generator().manual_seed(3)
    prompts = [torch.randint(3, V, (n,), generator=order).tolist() for n in (3, 1, 9, 2, 5, 1, 7, 4, 2, 11)]
    sampling, made = Sampling(2, 14, ENDS), torch.Generator
    whole = generate(model, prompts, sampling, made().manual_seed(5), fast)
    assert 0 < int(whole.ended.sum()) < len(whole.ended)
    for at_once in (1, 4, 7, 12):
        found = generate(model, prompts, sampling, made().manual_seed(5), fast, at_once)
        assert torch.equal(found.tokens, whole.tokens)
        assert torch.equal(found.mask, whole.mask)
        assert torch.equal(found.ended, whole.ended)
        torch.testing.assert_close(found.logp, whole.logp, atol=2e-5, rtol=0)


def test_no_more_rows_than_are_allowed_are_written_at_once(monkeypatch: pytest.MonkeyPatch) -> None:
    model, seen = family("llama"), list[int]()
    step = FastDecoder.step

    def counting(self: FastDecoder, tokens: Tensor) -> Tensor:
        seen.append(len(tokens))
        return step(self, tokens)

    monkeypatch.setattr(FastDecoder, "step", counting)
    prompts = [[3 + i] * (i % 5 + 1) for i in range(40)]
    generate(model, prompts, Sampling(2, 14, ENDS), torch.Generator().manual_seed(5), at_once=10)
    assert max(seen) <= 10
    assert len(seen) < 8 * 13  # eight blocks, one after the other, each as long as its longest row
    assert sum(seen[:20]) > 0.6 * 10 * 20


@pytest.mark.parametrize("fast", [True, False])
@pytest.mark.parametrize("make", [lambda: llama(17), lambda: gpt2(17)])
def test_rows_that_ended_long_ago_are_at_no_place_that_a_model_has_not(
    make: Callable[[], PreTrainedModel], fast: bool
) -> None:
    model, sampling = make(), Sampling(8, 14, (2,))  # few end, and wait among those that go on and those that join
    prompts = [[1, 5, 9]] * 24
    whole = generate(model, prompts, sampling, torch.Generator().manual_seed(5), fast)
    found = generate(model, prompts, sampling, torch.Generator().manual_seed(5), fast, at_once=32)
    assert torch.equal(found.tokens, whole.tokens)


def responses(found: Generation, samples: int, prompts: Sequence[Sequence[int]] = PROMPTS) -> Responses:
    ids = tuple(tuple(p) for p in prompts for _ in range(samples))
    return Responses(("",) * len(ids), ids, found.tokens, found.mask, found.logp, found.ended)


@pytest.mark.parametrize("make", [llama, gpt2])
@pytest.mark.parametrize("temperature", [1.0, 0.7])
@pytest.mark.parametrize("ends", [(), ENDS])
def test_log_probs_at_sampling_are_those_of_a_forward_pass(
    make: Callable[[], PreTrainedModel], temperature: float, ends: tuple[int, ...]
) -> None:
    model = make()
    found = drawn(model, Sampling(3, 12, ends, temperature))
    again = response_logp(model, responses(found, 3), temperature)
    torch.testing.assert_close(found.logp, again, atol=2e-5, rtol=0)


@pytest.mark.parametrize("make", [llama, gpt2])
def test_left_padding_changes_nothing(make: Callable[[], PreTrainedModel]) -> None:
    model, sampling = make(), Sampling(1, 8, ())
    together = drawn(model, sampling)
    uniform = torch.rand(len(PROMPTS), 8, generator=torch.Generator().manual_seed(0))
    for i, prompt in enumerate(PROMPTS):
        logp = _one_by_one(model, prompt, together.tokens[i])
        torch.testing.assert_close(
            together.logp[i], logp.gather(1, together.tokens[i, :, None])[:, 0], atol=2e-5, rtol=0
        )
        tokens, _ = draw(logp, uniform[i], 1.0)
        assert tokens.tolist() == together.tokens[i].tolist()


def _one_by_one(model: PreTrainedModel, prompt: list[int], tokens: Tensor) -> Tensor:
    """(L, V) log-probabilities, by a plain pass over an unpadded row."""
    with torch.no_grad():
        logits = model(input_ids=torch.tensor([prompt + tokens.tolist()])).logits[0]
    logp: Tensor = logits[len(prompt) - 1 : -1].log_softmax(-1)
    return logp


FAST: dict[str, dict[str, Any]] = {
    "llama": {},
    "llama, biases": {"attention_bias": True, "mlp_bias": True, "hidden_act": "gelu"},
    "mistral": {"sliding_window": 40},
    "qwen2": {},
    "qwen3": {"head_dim": 16},
    "phi": {},
    "gpt2": {},
    "gpt_neox": {},
    "gpt_neox, in turn": {"use_parallel_residual": False},
}


def family(name: str, **more: Any) -> PreTrainedModel:
    model = tiny(name.partition(",")[0], **FAST.get(name, {}), **more)
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():  # biases and norms begin as 0 and 1, where half of what is written out would not show
        for p in model.parameters():
            if p.ndim == 1:
                p.add_(torch.randn(p.shape, generator=generator), alpha=0.2)
    return model


@pytest.mark.parametrize("ends", [(), ENDS])
@pytest.mark.parametrize("name", FAST)
def test_the_fast_decoder_agrees_with_the_general_one(name: str, ends: tuple[int, ...]) -> None:
    model = family(name)
    assert plan(model, 22) is not None
    fast, general = (drawn(model, Sampling(4, 16, ends), fast) for fast in (True, False))
    assert torch.equal(fast.tokens, general.tokens)
    assert torch.equal(fast.mask, general.mask)
    torch.testing.assert_close(fast.logp, general.logp, atol=2e-5, rtol=1e-5)


def test_other_models_and_unusual_ones_take_the_general_way() -> None:
    assert plan(tiny("opt"), 20) is None
    assert plan(family("mistral"), 41) is None  # beyond its window
    assert plan(tiny("phi", qk_layernorm=True), 20) is None
    assert plan(tiny("gpt2", scale_attn_by_inverse_layer_idx=True), 20) is None
    assert plan(tiny("llama").to(torch.bfloat16), 20) is None  # type: ignore[arg-type]
    yarn = {"rope_type": "yarn", "factor": 2.0, "rope_theta": 1e4, "original_max_position_embeddings": 32}
    assert plan(tiny("llama", rope_parameters=yarn), 20) is None


def test_a_response_stops_at_its_first_end_token_and_keeps_it() -> None:
    found = drawn(llama(), Sampling(8, 12, ENDS))
    assert found.ended.any()
    assert not found.ended.all()
    for tokens, mask, logp, ended in zip(found.tokens, found.mask, found.logp, found.ended, strict=True):
        length = int(mask.sum())
        assert mask[:length].all()
        at = [i for i, token in enumerate(tokens[:length].tolist()) if token in ENDS]
        assert at == ([length - 1] if ended else [])
        assert ended or length == 12
        assert not tokens[length:].any()
        assert not logp[length:].any()


def test_what_a_row_gets_does_not_hang_on_when_others_end() -> None:
    model = llama()
    fixed, stopped = drawn(model, Sampling(4, 12, ())), drawn(model, Sampling(4, 12, ENDS))
    assert torch.equal(fixed.tokens * stopped.mask, stopped.tokens)


def test_the_same_generator_gives_the_same_bytes_and_another_does_not() -> None:
    model, sampling = llama(), Sampling(2, 8, ENDS)
    first, second, third = (drawn(model, sampling, seed=s) for s in (0, 0, 1))
    assert first.logp.numpy().tobytes() == second.logp.numpy().tobytes()
    assert not torch.equal(first.tokens, third.tokens)


def test_the_generation_config_has_no_say() -> None:
    model, sampling = gpt2(), Sampling(2, 8, ())
    free = drawn(model, sampling)
    config = model.generation_config
    assert config is not None
    config.top_k, config.top_p, config.temperature, config.repetition_penalty = 2, 0.1, 0.1, 9.0
    assert torch.equal(free.tokens, drawn(model, sampling).tokens)


def test_training_mode_is_refused() -> None:
    model = gpt2()
    model.train()
    with pytest.raises(ValueError, match="eval mode"):
        drawn(model, Sampling(1, 2, ()))


def test_prompts_must_hold_a_token() -> None:
    with pytest.raises(ValueError, match="at least one token"):
        pad_left([[1], []])


def test_prompts_are_padded_on_the_left_with_a_valid_id() -> None:
    ids, mask = pad_left([[5, 6], [7]])
    assert ids.tolist() == [[5, 6], [0, 7]]
    assert mask.tolist() == [[1, 1], [0, 1]]


def test_draws_have_the_model_s_distribution() -> None:
    logits = torch.tensor([[0.0, 1.0, -1.0, float("-inf")]]).expand(40_000, -1)
    tokens, logp = draw(logits, torch.rand(40_000, generator=torch.Generator().manual_seed(0)), 0.5)
    expected = (logits[0] / 0.5).softmax(-1)
    share = torch.bincount(tokens, minlength=4) / len(tokens)
    torch.testing.assert_close(share, expected, atol=0.01, rtol=0)
    torch.testing.assert_close(logp, expected.log()[tokens])


def test_draws_never_take_what_has_no_probability() -> None:
    logits = torch.full((3, 5), float("-inf"))
    logits[:, 1:3] = 0.0
    tokens, _ = draw(logits, torch.tensor([0.0, np.float32(1 - 2**-24), 0.499]), 1.0)
    assert tokens.tolist() == [1, 2, 1]


def test_scoring_in_chunks_changes_nothing_but_rounding() -> None:
    model = llama()
    rows = responses(drawn(model, Sampling(5, 12, ENDS)), 5)
    whole = response_logp(model, rows, 1.0).detach()
    for chunk in (1, 3, 100):
        torch.testing.assert_close(
            all_logp(model, rows, 1.0, chunk, Shortcuts(head_alone=True)), whole, atol=1e-5, rtol=0
        )


def test_each_prompt_is_run_once_for_all_its_samples() -> None:
    model, seen = llama(), []
    model.register_forward_pre_hook(lambda _, args, kwargs: seen.append(kwargs["input_ids"].shape), with_kwargs=True)
    drawn(model, Sampling(5, 4, ()))
    assert seen == [(len(PROMPTS), max(map(len, PROMPTS)))]
