"""How a reward model reads text: its tokenizer, its context and its chat template."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from text_models import some
from transformers import GPT2Config, GPT2Model, PreTrainedTokenizerFast, RobertaConfig, RobertaModel

from prefrl.components import ConfigError
from prefrl.envs.text import Reviews
from prefrl.reward_models.text import TransformerReward, TransformerSettings
from prefrl.types import Response


def of_folder(folder: Path, model: Any, task: Reviews, words: Any = None, **special: Any) -> TransformerReward:
    """On a backbone of one's own, with the task's tokenizer or with one that knows these words."""
    inner = words or task.tokenizer._tokenizer
    tokenizer = PreTrainedTokenizerFast(tokenizer_object=inner, **special)  # type: ignore[no-untyped-call]
    tokenizer.save_pretrained(folder)
    model.save_pretrained(folder)
    return TransformerSettings(backbone=str(folder)).build(task, np.random.default_rng(0))


def gpt2() -> GPT2Model:
    return GPT2Model(GPT2Config(vocab_size=1000, n_positions=64, n_embd=32, n_layer=1, n_head=2))


def few_words() -> Any:
    from tokenizers import Tokenizer, models, pre_tokenizers

    words = Tokenizer(models.WordLevel({"<e>": 0, "<u>": 1, "good": 2, "bad": 3, ".": 4}, unk_token="<u>"))
    words.pre_tokenizer = pre_tokenizers.Whitespace()
    return words


def test_another_tokenizer_reads_the_text_with_an_end_where_there_was_one(toy_reviews: Reviews, tmp_path: Path) -> None:
    reward = of_folder(tmp_path, gpt2(), toy_reviews, few_words(), eos_token="<e>")
    end = int(toy_reviews.tokenizer.eos_token_id)
    ended, cut = (Response("good", "bad .", (7,), tokens) for tokens in ((9, 9, end), (9, 9)))
    rows = reward.backbone.rows([ended, cut, Response("good", "bad ."), Response("good", "")])
    assert rows == [[2, 3, 4, 0], [2, 3, 4], [2, 3, 4, 0], [2, 0]]


def test_a_tokenizer_without_an_end_is_refused(toy_reviews: Reviews, tmp_path: Path) -> None:
    reward = of_folder(tmp_path, gpt2(), toy_reviews, few_words())
    with pytest.raises(ConfigError, match="neither an end token nor a separator"):
        reward.score([Response("good", "bad")])


def test_what_does_not_fit_the_context_is_named_with_both_lengths(toy_reviews: Reviews, tmp_path: Path) -> None:
    reward, (one,) = of_folder(tmp_path, gpt2(), toy_reviews, eos_token="<eos>"), some(toy_reviews, 1)
    long = replace(one, prompt_tokens=(5,) * 60, tokens=(5,) * 5)
    for ask in (reward.stack, reward.score, reward.features):
        with pytest.raises(ValueError, match=rf"candidate {long.id[:12]} .its prompt begins .* has 65 tokens.* of 64"):
            ask([one, long])


@pytest.mark.parametrize("padding", [0, 1])
def test_a_context_ends_where_positions_do_that_start_after_padding(
    toy_reviews: Reviews, tmp_path: Path, padding: int
) -> None:
    size: dict[str, Any] = {"hidden_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2}
    config = RobertaConfig(
        vocab_size=1000, max_position_embeddings=64, pad_token_id=padding, intermediate_size=48, **size
    )
    reward = of_folder(tmp_path, RobertaModel(config), toy_reviews, eos_token="<eos>")
    longest = Response("", "", (5,), (5,) * (62 - padding))
    assert np.isfinite(reward.score([longest])).all()
    with pytest.raises(ValueError, match=f"{64 - padding} tokens.* context of {63 - padding}"):
        reward.score([replace(longest, tokens=(*longest.tokens, 5))])


CHAT = (
    "{{ bos_token }}{% for m in messages %}{% if m.role == 'system' %}{{ raise_exception('no system') }}{% endif %}"
    "<{{ m.role }}>{{ m.content | trim }}{{ eos_token }}{% endfor %}"
)


def test_a_chat_template_gives_one_begin_and_ends_the_response_unless_it_was_cut(
    toy_reviews: Reviews, monkeypatch: pytest.MonkeyPatch
) -> None:
    words, (one,) = toy_reviews.tokenizer, some(toy_reviews, 1)
    monkeypatch.setattr(words, "chat_template", CHAT)
    plain, reward = (
        TransformerSettings(chat_template=wanted).build(toy_reviews, np.random.default_rng(0))
        for wanted in (None, True)
    )
    assert plain.backbone.rows([one]) == [[*one.prompt_tokens, *one.tokens]]
    talk = Response("Human: Hi\n\nAssistant: Yes?\n\nHuman: Why?\n\nAssistant: ", " So.")
    alike = [Response("Hi", "So."), Response("Hi", "So.", (9,), (9, int(words.eos_token_id)))]
    cut = [Response("Hi", text, (9,), (9,)) for text in ("So.", "")]
    expected = [
        "<bos><user>Hi<eos><assistant>Yes?<eos><user>Why?<eos><assistant>So.<eos>",
        *["<bos><user>Hi<eos><assistant>So.<eos>"] * 2,
        "<bos><user>Hi<eos><assistant>So.",
        "<bos><user>Hi<eos><assistant>",
    ]
    rows = reward.backbone.rows([talk, *alike, *cut])
    assert rows == [words.encode(text, add_special_tokens=False) for text in expected]
    assert np.isfinite(reward.score([one])).all()
    with pytest.raises(ValueError, match="does not fit the chat template of the reward's tokenizer: no system"):
        reward.score([Response("System: Be brief.\n\nHuman: Hi\n\nAssistant: ", "So.")])


def test_a_chat_template_that_is_not_there_is_refused(toy_reviews: Reviews) -> None:
    with pytest.raises(ConfigError, match="the reward's tokenizer has no chat template"):
        TransformerSettings(chat_template=True).build(toy_reviews, np.random.default_rng(0))
