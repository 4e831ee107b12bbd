"""An author: good texts of the task's own, once, each the best of its drafts, and no prompts of an evaluation."""

from __future__ import annotations

from pathlib import Path
from typing import cast

import numpy as np
import pytest

from prefrl import Config
from prefrl.components import ConfigError
from prefrl.envs.prompts import is_for_evaluation
from prefrl.envs.text import Reviews
from prefrl.label.author import Author, AuthorSettings, drafts
from prefrl.protocols import Task
from prefrl.store import Store
from prefrl.types import Query, Response


def author(task: Reviews, **settings: object) -> Author:
    return AuthorSettings.model_validate(settings).build(task)


def test_good_texts_are_shown_once_and_stand_for_themselves(toy_reviews: Reviews, tmp_path: Path) -> None:
    with Store[Response](tmp_path) as store:
        for _ in range(2):  # a second round shows nothing new
            author(toy_reviews, texts=12).answer(store, np.random.default_rng(0))
        shown = store.demonstrations()
        golds = np.concatenate(store.gold([one.like for one in shown]))
    assert len({one.like.id for one in shown}) == 12
    assert all(one.like.id == one.query.candidates[0].id for one in shown)
    assert toy_reviews.fluency([one.like for one in shown]).all()
    assert not any(is_for_evaluation(one.like.prompt) for one in shown)
    np.testing.assert_array_equal(golds, toy_reviews.gold([one.like for one in shown]))


def test_the_best_of_more_drafts_is_better(toy_reviews: Reviews) -> None:
    any_, best = (drafts(toy_reviews, 30, n, np.random.default_rng(0)) for n in (1, 8))
    assert toy_reviews.gold(best).mean() > toy_reviews.gold(any_).mean() + 0.5


def test_a_task_that_writes_too_few_different_texts_is_said_so(
    toy_reviews: Reviews, monkeypatch: pytest.MonkeyPatch
) -> None:
    (one,) = drafts(toy_reviews, 1, 1, np.random.default_rng(0))
    monkeypatch.setattr(Reviews, "written", lambda *_: [one])
    with pytest.raises(ValueError, match="only 1 different texts in 40 tries, and 2 are to be shown"):
        drafts(toy_reviews, 2, 1, np.random.default_rng(0))


def test_questions_about_others_texts_and_tasks_without_a_writer_are_refused(
    toy_reviews: Reviews, tmp_path: Path
) -> None:
    with Store[Response](tmp_path) as store:
        store.ask([Query((Response("The plot was", " fine."),))])
        with pytest.raises(ValueError, match=r"set loop\.labels=0"):
            author(toy_reviews, texts=1).answer(store, np.random.default_rng(0))
    silent = cast("Task", type("Silent", (), {"kind": "text", "name": "prompts"})())
    with pytest.raises(ConfigError, match="no writer of its own"):
        AuthorSettings().build(silent)


@pytest.mark.parametrize("count", [1, 2])
def test_questions_that_it_cannot_answer_are_refused_before_one_is_asked(tmp_path: Path, count: int) -> None:
    asked = ["loop.labels=4", "select.kind=uniform", f"select.candidates={count}"]
    with (
        Store[Response](tmp_path) as store,
        pytest.raises(ConfigError, match=r"\(author\) answers no question about the learner's own: set loop\.labels=0"),
    ):
        Config.load("text/reviews-demos", asked).build(store)
