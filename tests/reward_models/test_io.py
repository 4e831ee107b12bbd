"""Reward models as transformers keeps them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from text_models import bert_config, classifier, gpt2, logits, no_loss, save_tokenizer, some
from transformers import (
    BertForSequenceClassification,
)

from prefrl.components import ConfigError
from prefrl.envs.text import Reviews
from prefrl.reward_models.backbone import Train
from prefrl.reward_models.io import save_classifier
from prefrl.reward_models.text import TransformerReward, TransformerSettings


def fitted(task: Reviews, train: Train = "full", members: int = 3) -> TransformerReward:
    """Settled, with every trained weight moved away from where it began."""
    reward = TransformerSettings(members=members, train=train).build(task, np.random.default_rng(0))
    generator = torch.Generator().manual_seed(1)
    with torch.no_grad():
        for parameter in reward.parameters():
            parameter.add_(torch.randn(parameter.shape, generator=generator) * 0.05)
    reward.settle(reward.stack(some(task, 30)), no_loss)
    return reward


@pytest.mark.parametrize("train", ["full", "lora", "head"])
def test_an_exported_classifier_scores_probes_as_the_members_mean(
    toy_reviews: Reviews, tmp_path: Path, train: Train
) -> None:
    reward, probes = fitted(toy_reviews, train), some(toy_reviews, 8, seed=9)
    before = reward.score(probes)
    constant = save_classifier(reward.backbone, *reward.mean_head(), tmp_path / "classifier")
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
        constant = save_classifier(reward.backbone, *reward.mean_head(), tmp_path / "c")
    finally:
        reward.backbone.tokenizer.pad_token = kept
    found = logits(tmp_path / "c", reward.backbone.rows(probes)) + constant
    np.testing.assert_allclose(found, reward.member_scores(probes).mean(0), atol=1e-4)


def test_a_classifier_comes_back_as_a_fitted_reward_model(toy_reviews: Reviews, tmp_path: Path) -> None:
    reward, probes = fitted(toy_reviews), some(toy_reviews, 8)
    constant = save_classifier(reward.backbone, *reward.mean_head(), tmp_path / "c")
    settings = TransformerSettings(checkpoint=str(tmp_path / "c"), members=1)
    again = settings.build(toy_reviews, np.random.default_rng(0))
    assert again.fitted
    np.testing.assert_allclose(again.score(probes) + constant, reward.member_scores(probes).mean(0), atol=1e-4)


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
    bert = BertForSequenceClassification(bert_config(num_labels=1))
    kept = {name: p for name, p in bert.state_dict().items() if "pooler" not in name}
    bert.save_pretrained(tmp_path / "unpooled", state_dict=kept)
    with pytest.raises(ConfigError, match="num_labels=1"):
        build(tmp_path / "two")
    with pytest.raises(ConfigError, match="weights are missing, score"):
        build(tmp_path / "headless")
    with pytest.raises(ConfigError, match=r"weights are missing, bert\.pooler"):
        build(tmp_path / "unpooled")
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


CHAT = "{{ bos_token }}{% for m in messages %}{{ m.role }}: {{ m.content }}{{ eos_token }}{% endfor %}"


def test_a_checkpoint_reads_by_its_chat_template_and_one_fitted_without_is_written_without(
    toy_reviews: Reviews, tmp_path: Path
) -> None:
    classifier(toy_reviews, tmp_path / "a", gpt2().config, chat_template=CHAT)
    probes, rows = some(toy_reviews, 4), []
    for wanted in (None, False):
        settings = TransformerSettings(checkpoint=str(tmp_path / "a"), members=1, chat_template=wanted)
        reward = settings.build(toy_reviews, np.random.default_rng(0))
        save_classifier(reward.backbone, *reward.mean_head(), tmp_path / str(wanted))
        settings = TransformerSettings(checkpoint=str(tmp_path / str(wanted)), members=1)
        again = settings.build(toy_reviews, np.random.default_rng(0))
        rows.append(again.backbone.rows(probes))
        assert again.backbone.rows(probes) == reward.backbone.rows(probes)
        np.testing.assert_allclose(again.score(probes), reward.score(probes), atol=1e-5)
    words = reward.backbone.tokenizer
    expected = [f"<bos>user: {p.prompt}<eos>assistant: {p.text}<eos>" for p in probes]
    assert rows[0] == [words.encode(text, add_special_tokens=False) for text in expected]
    assert rows[1] == [[*p.prompt_tokens, *p.tokens] for p in probes]


def test_adapters_are_all_that_is_saved_of_a_backbone(toy_reviews: Reviews) -> None:
    state = fitted(toy_reviews, "lora").state()
    assert state["backbone"]
    assert all("lora_" in name for name in state["backbone"])
    assert not fitted(toy_reviews, "head").state()["backbone"]
