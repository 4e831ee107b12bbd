"""Python functions as a reward: called as TRL calls them, checked, and nothing to fit."""

from __future__ import annotations

import json
import math
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from pydantic import ValidationError

from prefrl import Config
from prefrl.components import ConfigError
from prefrl.envs.texts import Texts, TextsSettings
from prefrl.reward_models.functions import FunctionsSettings, answer, sentiment
from prefrl.store import Store
from prefrl.types import Response

CONVERSATION = "System: Be brief.\n\nHuman: 2 + 2?\n\nAssistant: "
RNG = np.random.default_rng(0)


@pytest.fixture
def task(tmp_path: Path) -> Texts:
    rows = [
        {"prompt": "1 + 1?", "answer": "2", "level": 1},
        {"prompt": [{"role": "system", "content": "Be brief."}, {"role": "user", "content": "2 + 2?"}], "answer": "4"},
    ]
    path = tmp_path / "x.jsonl"
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return TextsSettings(prompts=path, layers=1, width=16, heads=2).build()


def test_a_function_gets_prompts_completions_tokens_and_columns(task: Texts) -> None:
    seen: dict[str, Any] = {}

    def watching(prompts: list[Any], completions: list[Any], completion_ids: list[Any], **columns: Any) -> list[float]:
        seen.update(columns, prompts=prompts, completions=completions, completion_ids=completion_ids)
        return [1.0, 2.0]

    reward = FunctionsSettings.of(watching).build(task, RNG)
    found = reward.score([Response("1 + 1?", "2.", (1,), (5, 2)), Response(CONVERSATION, "It is 4.")])
    assert found.tolist() == [1.0, 2.0]
    assert found.dtype == np.float32
    assert seen == {
        "prompts": ["1 + 1?", [{"role": "system", "content": "Be brief."}, {"role": "user", "content": "2 + 2?"}]],
        "completions": ["2.", [{"role": "assistant", "content": "It is 4."}]],
        "completion_ids": [[5, 2], []],
        "answer": ["2", "4"],
        "level": [1, None],
    }


def test_several_functions_are_added_by_weight_and_none_is_not_zero(task: Texts) -> None:
    def short(completions: list[str]) -> list[float]:
        return [-float(len(c)) for c in completions]

    def some(completions: list[str]) -> list[float | None]:
        return [1.0, None, math.nan]

    both = FunctionsSettings.of(short, some, weights=[0.5, 10]).build(task, RNG)
    given = [Response("1 + 1?", text) for text in ("a", "bb", "cccc")]
    assert both.score(given).tolist() == [9.5, -1.0, -2.0]
    alone = FunctionsSettings.of(some).build(task, RNG).score(given)
    assert alone[0] == 1.0
    assert np.isnan(alone[1:]).all()
    assert both.score([]).shape == (0,)


@pytest.mark.parametrize(
    ("said", "message"),
    [
        ([1.0], "'wrong' gave 1 values for 2 responses"),
        (3.0, "'wrong' gave 1 values for 2 responses"),
        (np.array(3.0), "'wrong' gave 1 values for 2 responses"),
        (["good", 1.0], "'wrong': expected numbers or None"),
        ([math.inf, 1.0], "'wrong' gave inf for 'a'"),
    ],
)
def test_what_is_no_score_names_the_function(task: Texts, said: Any, message: str) -> None:
    def wrong(completions: list[str]) -> Any:
        return said

    with pytest.raises(ValueError, match=message):
        FunctionsSettings.of(wrong).build(task, RNG).score([Response("1 + 1?", "a"), Response("1 + 1?", "b")])


def test_a_function_that_fails_is_named_with_its_error(task: Texts) -> None:
    def failing(completions: list[str]) -> list[float]:
        raise KeyError("solution")

    with pytest.raises(ValueError, match=r"the reward function 'failing' failed: KeyError: 'solution'"):
        FunctionsSettings.of(failing).build(task, RNG).score([Response("1 + 1?", "a")])


def test_our_own_functions_score_answers_and_sentiment(task: Texts) -> None:
    reward = FunctionsSettings(functions=("answer",)).build(task, RNG)
    texts = [("1 + 1?", "That is 2."), ("1 + 1?", "That is 3."), (CONVERSATION, "4"), ("unknown", "5")]
    found = reward.score([Response(prompt, text) for prompt, text in texts])
    assert found[:3].tolist() == [1.0, 0.0, 1.0]
    assert np.isnan(found[3])
    assert answer(["x", "x"], [None, ""]) == [None, None]
    said = ["It is 12.", "-2", "1.2", "See U.S.", "It is (2)", "2"]
    assert answer(said, ["2", "2", "2", "U.S.", "(2)", 2]) == [0.0, 0.0, 0.0, 1.0, 1.0, 1.0]
    good, bad = sentiment(["", ""], ["What a wonderful film!", [{"role": "assistant", "content": "Awful."}]])
    assert good > 0 > bad


def test_names_are_looked_up_and_misspelt_ones_get_a_hint(task: Texts) -> None:
    with pytest.raises(ConfigError, match=r"no installed package brings 'anser', .*; did you mean 'answer'\?"):
        FunctionsSettings(functions=("anser",)).build(task, RNG)
    with pytest.raises(ValidationError, match="2 functions have 1 weights"):
        FunctionsSettings(functions=("answer", "sentiment"), weights=(1.0,))
    with pytest.raises(ConfigError, match="names that differ"):
        FunctionsSettings.of(partial(answer), partial(sentiment))
    mine = partial(answer)
    cast(Any, mine).__name__ = "answer"
    with pytest.raises(ConfigError, match="'answer' already"):
        FunctionsSettings.of(mine)


def test_settings_with_functions_at_hand_are_the_same_by_name() -> None:
    def mine(completions: list[str]) -> list[float]:
        return [0.0] * len(completions)

    settings = FunctionsSettings.of(mine, weights=[2.0])
    assert settings.lasting() == FunctionsSettings(functions=("mine",), weights=(2.0,))
    assert FunctionsSettings.model_validate(settings.model_dump()) == settings.lasting()


def test_nobody_is_asked_where_nothing_is_fitted(tmp_path: Path) -> None:
    config = Config.load("text/toy", ["reward.kind=functions", "reward.functions=[sentiment]"])
    with Store(tmp_path / "store") as store, pytest.raises(ConfigError, match=r"set loop\.labels=0"):
        config.build(store)


def test_a_state_of_other_functions_is_refused(task: Texts) -> None:
    one = FunctionsSettings(functions=("answer",)).build(task, RNG)
    one.load(one.state())
    with pytest.raises(ValueError, match=r"\['answer'\] there, \['sentiment'\] here"):
        FunctionsSettings(functions=("sentiment",)).build(task, RNG).load(one.state())
    for call in (one.stack, one.scores, one.calibrate):
        with pytest.raises(ConfigError, match=r"loop\.labels=0"):
            cast(Any, call)([])
