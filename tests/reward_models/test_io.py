"""Reward models as transformers keeps them, backbones of one's own, and RewardBench's files."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from transformers import (
    AutoModelForSequenceClassification,
    BertConfig,
    BertForSequenceClassification,
    BertModel,
    GPT2Config,
    GPT2ForSequenceClassification,
    OPTConfig,
    OPTModel,
    PreTrainedModel,
    PreTrainedTokenizerFast,
)

from prefrl.components import ConfigError
from prefrl.envs.reviews import reviews
from prefrl.envs.text import Reviews
from prefrl.reward_models.backbone import Train
from prefrl.reward_models.io import ScoredPair, save_classifier, write_rewardbench
from prefrl.reward_models.text import TransformerReward, TransformerSettings
from prefrl.types import Response


def no_loss(scores: torch.Tensor) -> torch.Tensor:
    return scores.sum(1)


def some(task: Reviews, count: int, seed: int = 0) -> list[Response]:
    """Reviews as imported, of very different lengths."""
    rng, grammar = np.random.default_rng(seed), reviews()
    found = []
    for prompt, rest in (grammar.sample(rng) for _ in range(count)):
        tokens = (*task.tokenizer.encode(rest, add_special_tokens=False), int(task.tokenizer.eos_token_id))
        found.append(Response(prompt, rest, tuple(task.tokenizer.encode(prompt)), tokens))
    return found


def fitted(task: Reviews, train: Train = "full", members: int = 3) -> TransformerReward:
    """Settled, with every trained weight moved away from where it began."""
    reward = TransformerSettings(members=members, train=train).build(task, np.random.default_rng(0))
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in reward.parameters():
            parameter.add_(torch.randn(parameter.shape, generator=generator) * 0.05)
    reward.settle(reward.stack(some(task, 30)), no_loss)
    return reward


def logits(folder: Path, rows: list[list[int]]) -> Any:
    """What transformers' own class says of padded rows."""
    model = AutoModelForSequenceClassification.from_pretrained(folder)
    tokenizer = PreTrainedTokenizerFast.from_pretrained(folder)
    model.eval()
    assert tokenizer.pad_token_id == model.config.pad_token_id != tokenizer.eos_token_id
    assert len(tokenizer) <= model.get_input_embeddings().weight.shape[0]
    padded = tokenizer.pad({"input_ids": rows}, return_tensors="pt", padding_side="right")
    with torch.no_grad():
        return model(**padded).logits[:, 0].numpy()


@pytest.mark.parametrize("train", ["full", "lora", "head"])
def test_an_exported_classifier_scores_probes_as_the_members_mean(
    toy_reviews: Reviews, tmp_path: Path, train: Train
) -> None:
    reward, probes = fitted(toy_reviews, train), some(toy_reviews, 8, seed=9)
    before = reward.score(probes)
    constant = save_classifier(reward, tmp_path / "classifier")
    found = logits(tmp_path / "classifier", reward.backbone.rows(probes)) + constant
    np.testing.assert_allclose(found, reward.member_scores(probes).mean(0), atol=1e-4)
    assert reward.score(probes).tobytes() == before.tobytes()
    assert not list((tmp_path / "classifier").glob("*.bin"))


@pytest.mark.parametrize("pad", [None, "<eos>"])
def test_padding_that_could_be_the_end_gets_a_token_of_its_own(
    toy_reviews: Reviews, tmp_path: Path, pad: str | None
) -> None:
    reward, probes = fitted(toy_reviews), some(toy_reviews, 8)
    reward.backbone.tokenizer.pad_token, kept = pad, reward.backbone.tokenizer.pad_token
    try:
        constant = save_classifier(reward, tmp_path / "c")
    finally:
        reward.backbone.tokenizer.pad_token = kept
    found = logits(tmp_path / "c", reward.backbone.rows(probes)) + constant
    np.testing.assert_allclose(found, reward.member_scores(probes).mean(0), atol=1e-4)


def test_a_classifier_comes_back_as_a_fitted_reward_model(toy_reviews: Reviews, tmp_path: Path) -> None:
    reward, probes = fitted(toy_reviews), some(toy_reviews, 8)
    constant = save_classifier(reward, tmp_path / "c")
    settings = TransformerSettings(checkpoint=str(tmp_path / "c"), members=1)
    again = settings.build(toy_reviews, np.random.default_rng(0))
    assert again.fitted
    np.testing.assert_allclose(again.score(probes) + constant, reward.member_scores(probes).mean(0), atol=1e-4)


def save_tokenizer(task: Reviews, folder: Path, **changes: Any) -> None:
    words = task.tokenizer._tokenizer
    tokenizer = PreTrainedTokenizerFast(tokenizer_object=words, **changes)  # type: ignore[no-untyped-call]
    tokenizer.save_pretrained(folder)


def gpt2(labels: int = 1) -> Any:
    torch.manual_seed(0)
    config = GPT2Config(vocab_size=1000, n_positions=64, n_embd=32, n_layer=2, n_head=2, pad_token_id=0)
    config.num_labels = labels
    return GPT2ForSequenceClassification(config)


def test_a_gpt2_classifier_is_read_without_its_dropout(toy_reviews: Reviews, tmp_path: Path) -> None:
    model = gpt2()
    model.save_pretrained(tmp_path)
    save_tokenizer(toy_reviews, tmp_path, pad_token="<pad>", eos_token="<eos>")
    reward = TransformerSettings(checkpoint=str(tmp_path), members=1).build(toy_reviews, np.random.default_rng(0))
    probes = some(toy_reviews, 8)
    np.testing.assert_allclose(reward.score(probes), logits(tmp_path, reward.backbone.rows(probes)), atol=1e-4)


def test_checkpoints_that_are_no_reward_models_are_refused(toy_reviews: Reviews, tmp_path: Path) -> None:
    def build(folder: Path) -> None:
        save_tokenizer(toy_reviews, folder, pad_token="<pad>", eos_token="<eos>")
        TransformerSettings(checkpoint=str(folder), members=1).build(toy_reviews, np.random.default_rng(0))

    gpt2(labels=2).save_pretrained(tmp_path / "two")
    gpt2().base_model.save_pretrained(tmp_path / "headless")
    BertForSequenceClassification(bert_config(num_labels=1)).save_pretrained(tmp_path / "deep")
    with pytest.raises(ConfigError, match="num_labels=1"):
        build(tmp_path / "two")
    with pytest.raises(ConfigError, match="weights are missing, score"):
        build(tmp_path / "headless")
    with pytest.raises(ConfigError, match="without a linear head"):
        build(tmp_path / "deep")
    with pytest.raises(ConfigError, match=r"reward\.download"):
        build(tmp_path / "nothing")


def test_pickled_weights_are_refused(toy_reviews: Reviews, tmp_path: Path) -> None:
    model = gpt2().base_model
    model.config.save_pretrained(tmp_path)
    save_tokenizer(toy_reviews, tmp_path, eos_token="<eos>")
    (tmp_path / "pytorch_model.bin").write_bytes(b"not to be opened")
    with pytest.raises(ConfigError, match="safetensors"):
        TransformerSettings(backbone=str(tmp_path)).build(toy_reviews, np.random.default_rng(0))


def test_a_checkpoint_has_one_member_and_its_own_backbone() -> None:
    with pytest.raises(ValueError, match="set members to 1"):
        TransformerSettings(checkpoint="somewhere")
    with pytest.raises(ValueError, match="leave backbone empty"):
        TransformerSettings(checkpoint="somewhere", members=1, backbone="elsewhere")


def own(task: Reviews, folder: Path, model: PreTrainedModel, **settings: Any) -> TransformerReward:
    model.save_pretrained(folder)
    if not (folder / "tokenizer.json").exists():
        save_tokenizer(task, folder, pad_token="<pad>", eos_token="<eos>")
    return TransformerSettings(backbone=str(folder), **settings).build(task, np.random.default_rng(0))


SMALL: dict[str, Any] = {"hidden_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2}


def bert_config(**more: Any) -> BertConfig:
    return BertConfig(vocab_size=1000, intermediate_size=48, **SMALL, **more)


def models() -> dict[str, Any]:
    torch.manual_seed(0)
    opt = OPTConfig(vocab_size=1000, ffn_dim=48, max_position_embeddings=64, word_embed_proj_dim=32, **SMALL)
    return {"gpt2": gpt2().base_model, "opt": OPTModel(opt), "bert": BertModel(bert_config())}


@pytest.mark.parametrize("kind", ["gpt2", "opt", "bert"])
def test_backbones_of_any_kind_score_alike_in_any_batch_and_come_back(
    toy_reviews: Reviews, tmp_path: Path, kind: str
) -> None:
    reward, probes = own(toy_reviews, tmp_path, models()[kind]), some(toy_reviews, 40)
    together = reward.member_scores(probes)
    alone = np.concatenate([reward.member_scores([c]) for c in probes[:5]], 1)
    np.testing.assert_allclose(together[:, :5], alone, atol=1e-5)
    assert np.abs(np.diff(together)).max() > 1e-3
    reward.settle(reward.stack(probes), no_loss)
    again = TransformerSettings(backbone=str(tmp_path)).build(toy_reviews, np.random.default_rng(5))
    again.load(reward.state())
    assert again.score(probes).tobytes() == reward.score(probes).tobytes()


def test_encoders_are_pooled_as_asked_and_not_exported(toy_reviews: Reviews, tmp_path: Path) -> None:
    mean, probes = own(toy_reviews, tmp_path / "b", models()["bert"], train="head"), some(toy_reviews, 4)
    first = own(toy_reviews, tmp_path / "b", models()["bert"], train="head", pool="first")
    assert np.abs(mean.features(probes) - first.features(probes)).max() > 1e-3
    with pytest.raises(ValueError, match="encoder"):
        save_classifier(mean, tmp_path / "out")


def other_tokenizer(folder: Path, **special: Any) -> None:
    from tokenizers import Tokenizer, models, pre_tokenizers

    words = Tokenizer(models.WordLevel({"<e>": 0, "<u>": 1, "good": 2, "bad": 3, ".": 4}, unk_token="<u>"))
    words.pre_tokenizer = pre_tokenizers.Whitespace()
    tokenizer = PreTrainedTokenizerFast(tokenizer_object=words, **special)  # type: ignore[no-untyped-call]
    tokenizer.save_pretrained(folder)


def test_another_tokenizer_reads_the_text_with_an_end_where_there_was_one(toy_reviews: Reviews, tmp_path: Path) -> None:
    other_tokenizer(tmp_path, eos_token="<e>")
    reward = own(toy_reviews, tmp_path, models()["gpt2"])
    end = int(toy_reviews.tokenizer.eos_token_id)
    ended, cut = (Response("good", "bad .", (7,), tokens) for tokens in ((9, 9, end), (9, 9)))
    rows = reward.backbone.rows([ended, cut, Response("good", "bad ."), Response("good", "")])
    assert rows == [[2, 3, 4, 0], [2, 3, 4], [2, 3, 4, 0], [2, 0]]


def test_a_tokenizer_without_an_end_is_refused(toy_reviews: Reviews, tmp_path: Path) -> None:
    other_tokenizer(tmp_path)
    reward = own(toy_reviews, tmp_path, models()["gpt2"])
    with pytest.raises(ConfigError, match="neither an end token nor a separator"):
        reward.score([Response("good", "bad")])


def test_what_does_not_fit_the_context_is_named_with_both_lengths(toy_reviews: Reviews, tmp_path: Path) -> None:
    reward, (one,) = own(toy_reviews, tmp_path, models()["gpt2"]), some(toy_reviews, 1)
    long = replace(one, prompt_tokens=(5,) * 60, tokens=(5,) * 5)
    for ask in (reward.stack, reward.score, reward.features):
        with pytest.raises(ValueError, match=rf"candidate {long.id[:12]} has 65 tokens.* context of 64"):
            ask([one, long])


def test_adapters_are_all_that_is_saved_of_a_backbone(toy_reviews: Reviews) -> None:
    state = fitted(toy_reviews, "lora").state()
    assert state["backbone"]
    assert all("lora_" in name for name in state["backbone"])
    assert not fitted(toy_reviews, "head").state()["backbone"]


def test_a_state_for_other_frozen_weights_is_refused(toy_reviews: Reviews, tmp_path: Path) -> None:
    reward = own(toy_reviews, tmp_path / "a", models()["gpt2"], train="head")
    changed = models()["gpt2"]
    with torch.no_grad():
        next(changed.parameters()).add_(1e-3)
    with pytest.raises(ValueError, match="frozen weights are others"):
        own(toy_reviews, tmp_path / "b", changed, train="head").load(reward.state())


def test_rewardbench_files_have_its_columns_and_count_ties_as_errors(tmp_path: Path) -> None:
    scores = [(1.0, 0.0, "hep-go"), (1.0, 1.0, "hep-go"), (0.0, 2.0, "donotanswer")]
    rows = [ScoredPair(i, s, f"good {i}", f"bad {i}", a, b) for i, (a, b, s) in enumerate(scores)]
    assert write_rewardbench(tmp_path, "us/mine", rows) == {"donotanswer": 0.0, "hep-go": 0.5}
    each = json.loads((tmp_path / "eval-set-scores" / "us" / "mine.json").read_text())
    assert each["scores_chosen"] == [1.0, 1.0, 0.0]
    assert each["results"] == [1, 0, 0]
    assert set(each) == {
        *("id", "subset", "text_chosen", "text_rejected", "scores_chosen", "scores_rejected", "results"),
        *("model", "model_type", "chat_template"),
    }
    summary = json.loads((tmp_path / "eval-set" / "us" / "mine.json").read_text())
    assert summary["hep-go"] == 0.5
    assert summary["model"] == "us/mine"


def test_rewardbench_wants_finite_scores_and_a_name_within_its_folder(tmp_path: Path) -> None:
    row = ScoredPair(7, "hep-go", "a", "b", float("nan"), 0.0)
    with pytest.raises(ValueError, match="row 7"):
        write_rewardbench(tmp_path, "mine", [row])
    with pytest.raises(ValueError, match="model's name"):
        write_rewardbench(tmp_path, "../mine", [row])
