from __future__ import annotations

import hashlib
import io
from pathlib import Path
from typing import cast

import numpy as np
import pytest
import torch
from pydantic import ValidationError
from rich.console import Console
from transformers import PreTrainedTokenizerBase

from prefrl.envs.reviews import reviews, source
from prefrl.envs.text import Reviews, ReviewsSettings
from prefrl.policies.cloning import CloningSettings, progress
from prefrl.types import Response

REVIEWS = reviews()
TINY = {"layers": 1, "width": 16, "heads": 2, "vocabulary": 400, "reviews": 128, "batch_size": 32}


def tiny(cache: Path, **changes: object) -> CloningSettings:
    return CloningSettings.model_validate({**TINY, "cache": cache, **changes})


def folder_bytes(folder: Path) -> dict[str, str]:
    return {p.name: hashlib.sha256(p.read_bytes()).hexdigest() for p in sorted(folder.glob("*/*"))}


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


def test_the_model_learns_what_follows_what(toy_reviews: Reviews, rng: np.random.Generator) -> None:
    tokenizer, losses = toy_reviews.tokenizer, []
    for prompt, rest in (REVIEWS.sample(rng) for _ in range(50)):
        ids = torch.tensor([encoded(tokenizer, prompt + rest)])
        with torch.no_grad():
            losses.append(float(toy_reviews.model()(input_ids=ids, labels=ids).loss))
    assert np.mean(losses) < 4.0 < np.log(len(tokenizer))


def test_a_model_is_cloned_once_and_then_read(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    settings = ReviewsSettings(cloning=tiny(tmp_path))
    settings.build()
    assert "cloning the grammar" in capfd.readouterr().err
    before = folder_bytes(tmp_path)
    settings.build()
    assert capfd.readouterr().err == ""
    assert folder_bytes(tmp_path) == before
    assert {name.rsplit(".", 1)[-1] for name in before} == {"json", "safetensors"}


def test_progress_is_a_bar_with_a_rate_on_a_terminal_and_one_line_elsewhere() -> None:
    shown = {}
    for terminal in (True, False):
        console = Console(file=io.StringIO(), force_terminal=terminal, width=120)
        with progress(3, console) as report:
            for _ in range(3):
                report.advance(1.5)
        shown[terminal] = cast("io.StringIO", console.file).getvalue()
    assert "3/3" in shown[True]
    assert "steps/s, loss 1.50" in shown[True]
    assert shown[False].count("\n") == 1


def test_cloning_twice_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        tiny(tmp_path / name).build(REVIEWS.sample, source())
    assert folder_bytes(tmp_path / "a") == folder_bytes(tmp_path / "b")


@pytest.mark.parametrize("damage", ["model.safetensors", "tokenizer.json", "MANIFEST.json"])
def test_a_damaged_copy_is_made_anew_and_said(tmp_path: Path, damage: str, capfd: pytest.CaptureFixture[str]) -> None:
    tiny(tmp_path).build(REVIEWS.sample, source())
    before = folder_bytes(tmp_path)
    (file,) = tmp_path.glob(f"*/{damage}")
    file.write_bytes(file.read_bytes()[:-9])
    tiny(tmp_path).build(REVIEWS.sample, source())
    assert "damaged" in capfd.readouterr().err
    assert folder_bytes(tmp_path) == before


def test_another_size_seed_or_grammar_is_another_model_and_the_folder_is_not_part_of_it(tmp_path: Path) -> None:
    digests = {
        tiny(tmp_path).digest("a"),
        tiny(tmp_path, width=32).digest("a"),
        tiny(tmp_path, seed=1).digest("a"),
        tiny(tmp_path).digest("b"),
    }
    assert len(digests) == 4
    assert tiny(tmp_path).digest("a") == tiny(tmp_path / "elsewhere").digest("a")


def test_a_width_that_cannot_be_split_into_heads_is_an_error() -> None:
    with pytest.raises(ValidationError, match="multiple of 2 x heads"):
        CloningSettings(width=100, heads=8)
