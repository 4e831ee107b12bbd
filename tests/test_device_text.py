"""As `test_device`, for language models: the learners of text and the reward models of responses."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from other_device import Far, assert_same, both, values
from transformers import BertConfig, BertModel

from prefrl.components import settings_class
from prefrl.envs.texts import Texts, TextsSettings
from prefrl.fit.settings import FittingSettings
from prefrl.fit.trainer import fit_judged
from prefrl.judgements import Comparison, Demonstrated, Judged
from prefrl.reward_models.backbone import Backbone
from prefrl.reward_models.text import TransformerReward, TransformerSettings
from prefrl.types import Query, Response

ROUNDING = 1e-4
"""Attention has another kernel there."""
PROMPTS = tuple(f"{i}" for i in range(24))
LEARNERS: dict[str, tuple[str, dict[str, Any]]] = {
    "rloo": ("text", {"updates": 1, "prompts": 2, "responses": 2}),
    "grpo": ("text", {"algorithm": "grpo", "updates": 1, "prompts": 2, "responses": 2, "minibatches": 2}),
    "raft": ("raft", {"updates": 1, "prompts": 2, "responses": 2}),
    "sft": ("sft", {"asked_responses": 2, "minibatch": 2}),
    "dpo": ("dpo", {"asked_responses": 2, "minibatch": 2}),
    "kto": ("kto", {"asked_responses": 2, "minibatch": 2}),
    "online_dpo": ("online_dpo", {"asked_responses": 2, "updates": 1, "prompts": 4}),
}


@pytest.fixture(scope="module")
def task() -> Texts:
    """A Llama over bytes with random weights."""
    small = TextsSettings(layers=1, width=16, heads=2, response_tokens=3, context=64).build()
    return replace(small, known={prompt: {} for prompt in PROMPTS}, learning=PROMPTS[3:], evaluating=PROMPTS[:3])


def judged(count: int = 8) -> list[Judged[Response]]:
    found = []
    for i in range(count):
        query = Query((Response(PROMPTS[i], "yes" * (i + 1)), Response(PROMPTS[i], "no")))
        found.append(Judged(query, Comparison(query.id, float(i % 2))))
    return found


class Answers:
    """A store that holds judgements, and nothing else."""

    def demonstrations(self) -> list[Demonstrated[Response]]:
        return []

    def judged(self) -> list[Judged[Response]]:
        return judged(4)


class Lengths:
    """A reward for long answers."""

    def score(self, candidates: list[Response]) -> np.ndarray:
        return np.array([len(c.tokens) for c in candidates], np.float32)


def encoder(task: Texts) -> TransformerReward:
    size: dict[str, Any] = {
        "hidden_size": 16,
        "intermediate_size": 16,
        "num_hidden_layers": 1,
        "num_attention_heads": 2,
    }
    torch.manual_seed(0)
    model: Any = BertModel(BertConfig(vocab_size=len(task.tokenizer), **size))
    backbone = Backbone(model.eval(), task.tokenizer, task.ends, task.encode, 16, "mean")
    return TransformerReward(TransformerSettings(), backbone, np.random.default_rng(0))


REWARDS: dict[str, Callable[[Texts], Any]] = {
    "all weights": lambda task: TransformerSettings(members=2).build(task, np.random.default_rng(0)),
    "the heads": lambda task: TransformerSettings(train="head").build(task, np.random.default_rng(0)),
    "an encoder": encoder,
}


@pytest.mark.parametrize("kind", REWARDS)
def test_a_reward_model_of_text_is_fitted_on_its_device(kind: str, task: Texts) -> None:
    fitting = FittingSettings(epochs=2, batch_size=4, centre=1.0)  # else only rounding moves a bias, and Adam with it
    some = [c for one in judged() for c in one.query.candidates]

    def fitted(device: torch.device) -> tuple[Any, Any, Any]:
        model = REWARDS[kind](task)
        model.to(device)
        found = fit_judged(model, judged(), fitting, np.random.default_rng(0))
        scored = (model.score(some), model.raw_member_scores(some), model.features(some))
        return found.metrics, scored, model.state()

    here, there = both(fitted)
    assert_same(there[0], here[0], ROUNDING)
    assert_same(there[1], here[1], ROUNDING)
    assert_same(values(there[2]), values(here[2]), ROUNDING)
    tensors = [*there[2]["backbone"].values(), *(there[2][name] for name in ("heads", "bias", "shift", "scale"))]
    assert {type(x) for x in tensors} == {Far}


@pytest.mark.parametrize("name", LEARNERS)
def test_a_learner_of_text_keeps_to_its_device_and_learns_the_same_there(name: str, task: Texts) -> None:
    kind, options = LEARNERS[name]
    chosen: Any = settings_class("learners", kind)
    settings = chosen(kind=kind, evaluation_prompts=2, **options)

    def round_of(device: torch.device) -> tuple[Any, Any]:
        learner = settings.model_copy(update={"device": device}).build(task, np.random.default_rng(0))
        asked = learner.sample(2, np.random.default_rng(1))
        improved = learner.improve(Lengths(), Answers(), np.random.default_rng(2))
        evaluated = learner.evaluate(Lengths(), np.random.default_rng(3))
        learner.load(learner.state())
        return {**improved, **evaluated.metrics, "asked": [c.id for c in asked]}, learner.state()

    here, there = both(round_of)
    assert_same(there[0], here[0], ROUNDING)
    assert_same(values(there[1]), values(here[1]), ROUNDING)
    assert {type(p) for p in there[1]["model"].values()} == {Far}
