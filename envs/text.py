"""The text task: write a review that begins with a given prompt. The gold is how positive it is, or a rubric."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import Field
from transformers import LlamaForCausalLM, PreTrainedTokenizerFast
from vaderSentiment.vaderSentiment import SentimentIntensityAnalyzer

from prefrl.components import Settings
from prefrl.envs.grammar import Grammar
from prefrl.envs.prompts import is_for_evaluation
from prefrl.envs.reviews import reviews, source
from prefrl.policies.cloning import CloningSettings
from prefrl.policies.pretrained import on_same_weights
from prefrl.types import Fields, Floats, Response

SHIPPED = Path(__file__).parent / "starts" / "reviews"
"""The starting policy of the default settings; `benchmarks/start_reviews.py` makes it."""


PRAISE = 0.5
"""VADER's compound score from which a review is taken to praise."""


class ReviewsSettings(Settings):
    """Short reviews of films, meals, hotels, books and gadgets; the gold is VADER's compound score, or a rubric."""

    kind: Literal["reviews"] = "reviews"
    gold: Literal["sentiment", "rubric"] = "sentiment"
    """What a review is worth: VADER's compound score, or the share of four things that it does (`rubric`): it praises,
    tells what happened, recommends, and exclaims. Fewer than one in a hundred of the start's reviews do all four."""
    response_tokens: int = Field(48, ge=2)
    """The most tokens that a response may have, the end token included."""
    cloning: CloningSettings = CloningSettings()
    """The starting policy."""

    def shrunk(self) -> ReviewsSettings:
        small = {"layers": 1, "width": 32, "heads": 2, "vocabulary": 512, "reviews": 640}
        return self.model_copy(update={"cloning": self.cloning.model_copy(update=small)})

    def build(self) -> Reviews:
        grammar = reviews()
        return Reviews(self, grammar, *self.cloning.build(grammar.sample, source(), SHIPPED))


class Reviews:
    """Prompts are openings of reviews; one in eight is kept for evaluation and never learned on."""

    name = "reviews"
    kind = "text"

    def __init__(
        self,
        settings: ReviewsSettings,
        grammar: Grammar,
        model: LlamaForCausalLM,
        tokenizer: PreTrainedTokenizerFast,
    ) -> None:
        self.response_tokens = settings.response_tokens
        self.tokenizer = tokenizer
        self.ends = (int(tokenizer.eos_token_id),)
        self._model = model
        self._grammar = grammar
        self._worth = {"sentiment": self._sentiment, "rubric": self._rubric}[settings.gold]
        self._told, self._advised = grammar.phrases("fact_good"), grammar.phrases("advise_good")
        self._vader = SentimentIntensityAnalyzer()

    def model(self, frozen: bool = False) -> LlamaForCausalLM:
        """The cloned model, in float32; it has no dropout."""
        return on_same_weights(self._model) if frozen else copy.deepcopy(self._model)

    def encode(self, prompt: str) -> tuple[int, ...]:
        return tuple(self.tokenizer.encode(prompt))

    def columns(self, prompt: str) -> Fields:
        return {}

    def prompts(self, count: int, rng: np.random.Generator) -> list[str]:
        return self._draw(count, rng, evaluation=False)

    def evaluation_prompts(self, count: int, rng: np.random.Generator) -> list[str]:
        return self._draw(count, rng, evaluation=True)

    def written(self, count: int, rng: np.random.Generator) -> list[Response]:
        """Reviews by the grammar, good and bad, that begin with prompts to learn."""
        found: list[Response] = []
        while len(found) < count:
            prompt, rest = self._grammar.sample(rng)
            if not is_for_evaluation(prompt):
                found.append(Response(prompt, rest))
        return found

    def gold(self, responses: Sequence[Response]) -> Floats:
        """(N,) VADER's compound score in [-1, 1] (Hutto and Gilbert 2014) of the whole review; or, by the rubric, the
        share of what it does, in [0, 1].

        The prompt is scored along, since a reader sees it and VADER's negations reach across its end; on their own
        all prompts score 0.
        """
        return np.array([self._worth(r) for r in responses], np.float32)

    def fluency(self, responses: Sequence[Response]) -> Floats:
        """(N,) 1 where the grammar could have written prompt and response, to the last full stop, else 0."""
        return np.array([self._grammar.accepts(r.prompt + r.text) for r in responses], np.float32)

    def _sentiment(self, response: Response) -> float:
        return float(self._vader.polarity_scores(response.prompt + response.text)["compound"])

    def _rubric(self, response: Response) -> float:
        said = response.text.lower()
        praises, exclaims = self._sentiment(response) >= PRAISE, "!" in said
        told, advised = (any(phrase in said for phrase in phrases) for phrases in (self._told, self._advised))
        return (praises + told + advised + exclaims) / 4

    def _draw(self, count: int, rng: np.random.Generator, evaluation: bool) -> list[str]:
        found: list[str] = []
        while len(found) < count:
            prompt, _ = self._grammar.sample(rng)
            if is_for_evaluation(prompt) == evaluation:
                found.append(prompt)
        return found
