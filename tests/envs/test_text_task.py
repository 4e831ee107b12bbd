from __future__ import annotations

import numpy as np
import torch
from transformers import PreTrainedTokenizerBase

from prefrl.envs.reviews import reviews
from prefrl.envs.text import Reviews, ReviewsSettings
from prefrl.types import Response

REVIEWS = reviews()


def encoded(tokenizer: PreTrainedTokenizerBase, text: str, **kwargs: bool) -> list[int]:
    return [int(i) for i in tokenizer.encode(text, **kwargs)]


def test_prompts_are_neutral_in_the_eyes_of_the_gold(toy_reviews: Reviews, rng: np.random.Generator) -> None:
    prompts = {*toy_reviews.prompts(3000, rng), *toy_reviews.evaluation_prompts(500, rng)}
    assert len(prompts) > 500
    assert not toy_reviews.gold([Response(p, "") for p in prompts]).any()


def test_evaluation_prompts_are_never_learned_on(toy_reviews: Reviews, rng: np.random.Generator) -> None:
    assert not {*toy_reviews.prompts(2000, rng)} & {*toy_reviews.evaluation_prompts(500, rng)}


def test_prompts_are_drawn_from_the_generator_given(toy_reviews: Reviews) -> None:
    first, second, third = (toy_reviews.prompts(20, np.random.default_rng(s)) for s in (0, 0, 1))
    assert first == second != third


def test_the_grammar_is_of_mixed_sentiment_around_zero(toy_reviews: Reviews, rng: np.random.Generator) -> None:
    pairs = [REVIEWS.sample(rng) for _ in range(1000)]
    gold = toy_reviews.gold([Response(*pair) for pair in pairs])
    assert abs(gold.mean()) < 0.1
    assert gold.std() > 0.6


def test_the_gold_reads_prompt_and_response_together(toy_reviews: Reviews) -> None:
    praise, pan = Response("The plot of this film was", " superb."), Response("The plot of this film was", " dreadful.")
    assert toy_reviews.gold([praise])[0] > 0.5
    assert toy_reviews.gold([pan])[0] < -0.3
    assert (
        toy_reviews.gold([Response("I did not", " like it.")])[0]
        < 0
        < toy_reviews.gold([Response("I", " like it.")])[0]
    )


def test_the_rubric_counts_what_a_review_does(rng: np.random.Generator) -> None:
    small = ReviewsSettings(gold="rubric").shrunk()
    assert isinstance(small, ReviewsSettings)
    task = small.build()
    said = {
        " really dull. avoid it if you can.": 0.0,
        " really dull! never again!": 0.25,
        " wonderful. every bite was a joy.": 0.5,
        " wonderful. every bite was a joy. I recommend it to anyone.": 0.75,
        " wonderful! every bite was a joy. I recommend it to anyone.": 1.0,
    }
    assert task.gold([Response("The soup was", text) for text in said]).tolist() == list(said.values())
    written = task.gold([Response(*REVIEWS.sample(rng)) for _ in range(4000)])
    assert 0 < (written == 1).mean() < 0.01


def test_fluency_is_one_for_the_grammar_s_own_and_zero_for_word_salad(
    toy_reviews: Reviews, rng: np.random.Generator
) -> None:
    own = [Response(*REVIEWS.sample(rng)) for _ in range(20)]
    salad = [Response(r.prompt, " great" * 9 + ".") for r in own]
    assert toy_reviews.fluency(own).tolist() == [1.0] * 20
    assert toy_reviews.fluency(salad).tolist() == [0.0] * 20


def test_special_tokens_are_distinct_and_the_begin_token_comes_once(toy_reviews: Reviews) -> None:
    tokenizer = toy_reviews.tokenizer
    pad, bos, eos = tokenizer.pad_token_id, tokenizer.bos_token_id, tokenizer.eos_token_id
    assert len({pad, bos, eos}) == 3
    assert encoded(tokenizer, "The plot").count(int(bos)) == 1
    assert int(bos) not in encoded(tokenizer, " was", add_special_tokens=False)
    config = toy_reviews.model().config
    assert (config.pad_token_id, config.bos_token_id, config.eos_token_id) == (pad, bos, eos)


def test_a_review_s_tokens_are_its_prompt_s_and_its_response_s(toy_reviews: Reviews, rng: np.random.Generator) -> None:
    tokenizer = toy_reviews.tokenizer
    for prompt, rest in (REVIEWS.sample(rng) for _ in range(50)):
        apart = encoded(tokenizer, prompt) + encoded(tokenizer, rest, add_special_tokens=False)
        assert apart == encoded(tokenizer, prompt + rest)
        assert tokenizer.decode(apart, skip_special_tokens=True) == prompt + rest


def test_any_text_survives_the_tokenizer(toy_reviews: Reviews) -> None:
    text = "Zażółć — 「味」 <b>\t\n  two  spaces 😀"
    assert toy_reviews.tokenizer.decode(toy_reviews.tokenizer.encode(text), skip_special_tokens=True) == text


def test_each_model_is_a_fresh_copy_without_dropout(toy_reviews: Reviews) -> None:
    first, second = toy_reviews.model(), toy_reviews.model()
    with torch.no_grad():
        next(first.parameters()).zero_()
    assert next(second.parameters()).any()
    assert not second.training
    assert second.dtype == torch.float32
    assert second.config.attention_dropout == 0.0


def test_frozen_models_have_their_weights_in_common_and_nothing_else(toy_reviews: Reviews) -> None:
    first, second = toy_reviews.model(frozen=True), toy_reviews.model(frozen=True)
    pairs = list(zip(first.parameters(), second.parameters(), strict=True))
    assert all(a is not b and a.data_ptr() == b.data_ptr() for a, b in pairs)
    assert not any(p.requires_grad for p in first.parameters())
    assert first.get_output_embeddings().weight is first.get_input_embeddings().weight  # type: ignore[no-untyped-call]
    first.lm_head = torch.nn.Identity()
    assert isinstance(second.lm_head, torch.nn.Linear)


def test_the_model_learns_what_follows_what(toy_reviews: Reviews, rng: np.random.Generator) -> None:
    tokenizer, losses = toy_reviews.tokenizer, []
    for prompt, rest in (REVIEWS.sample(rng) for _ in range(50)):
        ids = torch.tensor([encoded(tokenizer, prompt + rest)])
        with torch.no_grad():
            losses.append(float(toy_reviews.model()(input_ids=ids, labels=ids).loss))
    assert np.mean(losses) < 4.0 < np.log(len(tokenizer))
