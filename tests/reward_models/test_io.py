"""Reward models as transformers keeps them, and backbones of one's own."""

from __future__ import annotations

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
    BloomConfig,
    BloomModel,
    DebertaV2Config,
    FNetConfig,
    GPT2Config,
    GPT2ForSequenceClassification,
    GPTNeoConfig,
    GPTNeoModel,
    OPTConfig,
    OPTModel,
    PreTrainedModel,
    PreTrainedTokenizerFast,
    RobertaConfig,
    XLMConfig,
    XLNetConfig,
)

from prefrl.components import ConfigError
from prefrl.envs.reviews import reviews
from prefrl.envs.text import Reviews
from prefrl.reward_models.backbone import Train
from prefrl.reward_models.io import save_classifier
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
        save_classifier(mean, tmp_path / "out")


@pytest.mark.parametrize("kind", ["bloom", "gpt_neo"])
def test_backbones_with_attention_of_their_own_are_exported(toy_reviews: Reviews, tmp_path: Path, kind: str) -> None:
    reward, probes = own(toy_reviews, tmp_path / "b", models()[kind]), some(toy_reviews, 8)
    constant = save_classifier(reward, tmp_path / "c")
    found = logits(tmp_path / "c", reward.backbone.rows(probes)) + constant
    np.testing.assert_allclose(found, reward.member_scores(probes).mean(0), atol=1e-4)


def classifier(task: Reviews, folder: Path, config: Any, **tokenizer: Any) -> None:
    """A checkpoint with weights that tell texts apart, its pooler's and head's included."""
    torch.manual_seed(0)
    model: Any = AutoModelForSequenceClassification.from_config(config)  # type: ignore[no-untyped-call]
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.add_(torch.randn(parameter.shape) * 0.2)
    model.save_pretrained(folder)
    save_tokenizer(task, folder, pad_token="<pad>", bos_token="<bos>", eos_token="<eos>", **tokenizer)


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
    assert save_classifier(reward, tmp_path / "out") == 0
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


CHAT = "{{ bos_token }}{% for m in messages %}{{ m.role }}: {{ m.content }}{{ eos_token }}{% endfor %}"


def test_a_checkpoint_reads_by_its_chat_template_and_one_fitted_without_is_written_without(
    toy_reviews: Reviews, tmp_path: Path
) -> None:
    classifier(toy_reviews, tmp_path / "a", gpt2().config, chat_template=CHAT)
    probes, rows = some(toy_reviews, 4), []
    for wanted in (None, False):
        settings = TransformerSettings(checkpoint=str(tmp_path / "a"), members=1, chat_template=wanted)
        reward = settings.build(toy_reviews, np.random.default_rng(0))
        save_classifier(reward, tmp_path / str(wanted))
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


def test_a_state_for_other_frozen_weights_is_refused(toy_reviews: Reviews, tmp_path: Path) -> None:
    reward = own(toy_reviews, tmp_path / "a", models()["gpt2"], train="head")
    changed = models()["gpt2"]
    with torch.no_grad():
        next(changed.parameters()).add_(1e-3)
    with pytest.raises(ValueError, match="frozen weights are others"):
        own(toy_reviews, tmp_path / "b", changed, train="head").load(reward.state())
