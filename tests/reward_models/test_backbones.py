"""Backbones of any kind, and classifiers on encoders with all of their heads."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from text_models import SMALL, bert_config, classifier, gpt2, logits, no_loss, save_tokenizer, some
from transformers import (
    BertConfig,
    BertModel,
    BloomConfig,
    BloomModel,
    DebertaV2Config,
    FNetConfig,
    GPTNeoConfig,
    GPTNeoModel,
    OPTConfig,
    OPTModel,
    PreTrainedModel,
    RobertaConfig,
    XLMConfig,
    XLNetConfig,
)

from prefrl.components import ConfigError
from prefrl.envs.text import Reviews
from prefrl.reward_models.backbone import Train
from prefrl.reward_models.io import save_classifier
from prefrl.reward_models.text import TransformerReward, TransformerSettings


def own(task: Reviews, folder: Path, model: PreTrainedModel, **settings: Any) -> TransformerReward:
    model.save_pretrained(folder)
    if not (folder / "tokenizer.json").exists():
        save_tokenizer(task, folder, pad_token="<pad>", eos_token="<eos>")
    return TransformerSettings(backbone=str(folder), **settings).build(task, np.random.default_rng(0))


def models() -> dict[str, Any]:
    torch.manual_seed(0)
    opt = OPTConfig(vocab_size=1000, ffn_dim=48, max_position_embeddings=64, word_embed_proj_dim=32, **SMALL)
    bloom = BloomConfig(vocab_size=1000, hidden_size=32, n_layer=1, n_head=2)
    neo = GPTNeoConfig(vocab_size=1000, hidden_size=32, num_layers=1, num_heads=2, attention_types=[[["local"], 1]])
    causal = {"gpt2": gpt2().base_model, "opt": OPTModel(opt), "bloom": BloomModel(bloom), "gpt_neo": GPTNeoModel(neo)}
    return causal | {"bert": BertModel(bert_config())}


@pytest.mark.parametrize("kind", ["gpt2", "opt", "bloom", "bert"])
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
        save_classifier(mean.backbone, *mean.mean_head(), tmp_path / "out")


@pytest.mark.parametrize("kind", ["bloom", "gpt_neo"])
def test_backbones_with_attention_of_their_own_are_exported(toy_reviews: Reviews, tmp_path: Path, kind: str) -> None:
    reward, probes = own(toy_reviews, tmp_path / "b", models()[kind]), some(toy_reviews, 8)
    constant = save_classifier(reward.backbone, *reward.mean_head(), tmp_path / "c")
    found = logits(tmp_path / "c", reward.backbone.rows(probes)) + constant
    np.testing.assert_allclose(found, reward.member_scores(probes).mean(0), atol=1e-4)


def encoders() -> dict[str, Any]:
    more: dict[str, Any] = {"vocab_size": 1000, "intermediate_size": 48, "pad_token_id": 0, "num_labels": 1, **SMALL}
    deberta: dict[str, Any] = {"relative_attention": True, "pos_att_type": ["c2p", "p2c"], "pooler_hidden_size": 32}
    return {"bert": BertConfig(**more), "roberta": RobertaConfig(**more), "deberta": DebertaV2Config(**more, **deberta)}


@pytest.mark.parametrize("kind", ["bert", "roberta", "deberta"])
@pytest.mark.parametrize("train", ["full", "lora", "head"])
def test_an_encoder_s_classifier_is_read_fitted_and_written_with_all_its_head(
    toy_reviews: Reviews, tmp_path: Path, kind: str, train: Train
) -> None:
    classifier(toy_reviews, tmp_path / "a", encoders()[kind])
    settings = TransformerSettings(checkpoint=str(tmp_path / "a"), members=1, train=train)
    reward, probes = settings.build(toy_reviews, np.random.default_rng(0)), some(toy_reviews, 20)
    rows, before = reward.backbone.rows(probes), reward.score(probes)
    assert before.std() > 1e-3
    np.testing.assert_allclose(before, logits(tmp_path / "a", rows), atol=1e-5)
    np.testing.assert_allclose(before[:3], [logits(tmp_path / "a", [row])[0] for row in rows[:3]], atol=1e-5)
    reward.scores(reward.stack(probes)).sum().backward()  # type: ignore[no-untyped-call]
    with torch.no_grad():
        for parameter in reward.parameters():
            assert parameter.grad is not None
            parameter.sub_(parameter.grad.sign() * 1e-3)
    reward.settle(reward.stack(probes), no_loss)
    assert save_classifier(reward.backbone, *reward.mean_head(), tmp_path / "out") == 0
    assert np.abs(reward.score(probes) - before).max() > 0.1
    np.testing.assert_allclose(logits(tmp_path / "out", rows), reward.score(probes), atol=1e-4)
    again = settings.build(toy_reviews, np.random.default_rng(1))
    again.load(reward.state())
    assert again.score(probes).tobytes() == reward.score(probes).tobytes()


def test_a_pooler_that_the_heads_see_is_part_of_what_is_frozen(toy_reviews: Reviews, tmp_path: Path) -> None:
    classifier(toy_reviews, tmp_path, encoders()["bert"])
    settings = TransformerSettings(checkpoint=str(tmp_path), members=1, train="head")
    one, other = (settings.build(toy_reviews, np.random.default_rng(0)) for _ in range(2))
    with torch.no_grad():
        dict(other.backbone.model.named_parameters())["bert.pooler.dense.bias"].add_(1)
    with pytest.raises(ValueError, match="frozen weights are others"):
        other.load(one.state())


def test_classifiers_whose_scores_are_no_linear_head_s_are_refused(toy_reviews: Reviews, tmp_path: Path) -> None:
    size: dict[str, Any] = {"vocab_size": 1000, "num_labels": 1, "pad_token_id": 0}
    bent = XLMConfig(emb_dim=32, n_layers=1, n_heads=2, summary_activation="tanh", **size)
    mixing = FNetConfig(hidden_size=32, num_hidden_layers=1, intermediate_size=48, **size)
    both_ways = XLNetConfig(d_model=32, n_layer=1, n_head=2, d_inner=48, **size)
    wrong = {"hangs on padding, or is not": (bent, mixing), "XLNet.*: expected a causal": (both_ways,)}
    for message, configs in wrong.items():
        for config in configs:
            folder = tmp_path / config.model_type
            classifier(toy_reviews, folder, config)
            with pytest.raises(ConfigError, match=message):
                TransformerSettings(checkpoint=str(folder), members=1).build(toy_reviews, np.random.default_rng(0))


def test_a_state_for_other_frozen_weights_is_refused(toy_reviews: Reviews, tmp_path: Path) -> None:
    reward = own(toy_reviews, tmp_path / "a", models()["gpt2"], train="head")
    changed = models()["gpt2"]
    with torch.no_grad():
        next(changed.parameters()).add_(1e-3)
    with pytest.raises(ValueError, match="frozen weights are others"):
        own(toy_reviews, tmp_path / "b", changed, train="head").load(reward.state())
