from collections.abc import Mapping
from typing import Any

import pytest

from prefrl.exchange.layout import Layout, Row
from prefrl.exchange.text_rows import form_of, parse
from prefrl.exchange.tool_rows import user_id
from prefrl.judgements import Choice, Comparison, Ranking, Skip

FIELDS = {"instruction": "p", "generation-2": "b", "generation-1": "a"}
TASK = {"data": {"prompt": "p", "text1": "a", "text2": "b"}}
ASKED = [{"role": "user", "content": "p"}]
BATTLE = {
    "conversation_a": [*ASKED, {"role": "assistant", "content": "a"}],
    "conversation_b": [*ASKED, {"role": "assistant", "content": "b"}],
    "model_a": "x",
    "model_b": "y",
    "judge": "ann",
}


def said(row: Mapping[str, Any]) -> list[Any]:
    """What a row says, in short: the better text, "tie", a skip's reason, ranks by text; or why it says nothing."""
    return [found if isinstance(found, str) else short(found) for found in parse(dict(row))]


def short(row: Row) -> Any:
    texts, answer = [c.text for c in row.query.candidates], row.answer
    match answer:
        case Comparison(preference=preference):
            return "tie" if preference == 0.5 else texts[0 if preference > 0.5 else 1]
        case Ranking(ranks=ranks):
            return dict(zip(texts, ranks, strict=True))
        case Choice(best=best):
            return texts[best]
        case Skip(reason=reason):
            return reason
    raise AssertionError(answer)


def record(value: Any, fields: Mapping[str, Any] = FIELDS, **more: Any) -> dict[str, Any]:
    return {"id": "1", "fields": fields, "responses": {"q": [{"value": value, "user_id": "u", **more}]}}


THREE = FIELDS | {"generation-3": "c"}


@pytest.mark.parametrize(
    ("row", "expected"),
    [
        (record("generation_2"), ["b"]),
        (record("tie"), ["tie"]),
        (record("generation-1", status="draft"), ["draft of a response"]),
        (record("generation-1", status="discarded"), ["skip"]),
        (record(["generation-2", "generation-1"]), [{"a": 1, "b": 0}]),
        (record("generation-3", THREE), ["c"]),
        (
            record([{"value": f"generation-{n}", "rank": rank} for n, rank in ((1, 2), (2, 1), (3, 2))], THREE),
            [{"a": 1, "b": 0, "c": 1}],
        ),
        (record("good"), ["answer to question 'q', which names no response"]),
        ({"fields": FIELDS, "responses": {}}, ["record without a response"]),
    ],
)
def test_records_of_argilla_are_read(row: Mapping[str, Any], expected: list[Any]) -> None:
    assert said(row) == expected


def test_argillas_users_get_their_names_back_where_a_record_names_them() -> None:
    row: dict[str, Any] = {"fields": FIELDS, "metadata": {"labelers": ["ann"]}}
    row["responses"] = {"q": [{"value": "tie", "user_id": user_id("ann")}, {"value": "tie", "user_id": "other"}]}
    assert [found.answer.labeler for found in parse(row) if isinstance(found, Row)] == ["ann", "other"]


def annotated(*results: Mapping[str, Any], **more: Any) -> dict[str, Any]:
    return TASK | {"annotations": [{"result": [{"value": value} for value in results], "completed_by": 7, **more}]}


@pytest.mark.parametrize(
    ("row", "expected"),
    [
        (annotated({"selected": "left"}), ["a"]),
        (annotated({"selected": "right"}), ["b"]),
        (annotated({"choices": ["Tie"]}), ["tie"]),
        (annotated({"choices": ["incomparable"]}), ["incomparable"]),
        (annotated({"selected": "left"}, was_cancelled=True), ["skip"]),
        (annotated({"text": ["hm"]}), ["annotation without a choice of left or right"]),
        (TASK | {"annotations": []}, ["task without an annotation"]),
    ],
)
def test_tasks_of_label_studio_are_read(row: Mapping[str, Any], expected: list[Any]) -> None:
    assert said(row) == expected


@pytest.mark.parametrize(
    ("winner", "expected"),
    [("model_a", "a"), ("model_b", "b"), ("tie", "tie"), ("tie (bothbad)", "incomparable")],
)
def test_battles_of_the_arena_are_read(winner: str, expected: str) -> None:
    assert said(BATTLE | {"winner": winner}) == [expected]
    (found,) = parse(BATTLE | {"winner": winner})
    assert isinstance(found, Row)
    assert found.answer.labeler == "ann"
    assert found.query.candidates[0].prompt == "Human: p\n\nAssistant: "


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (record(["generation-1"]), "a ranking of all of generation-1, generation-2"),
        (record(["generation-1", "generation-1"]), "expected a ranking of"),
        (record("x", {"prompt": "p", "a": 3}), "field 'a': expected text"),
        ({"fields": FIELDS, "responses": [1]}, "question -> list"),
        ({"fields": FIELDS, "responses": {"q": [3]}}, "question 'q'"),
        ({"data": {"a": "x"}, "annotations": []}, "name them with --map left="),
        ({"data": {"left": "x", "right": 3}, "annotations": []}, "expected text in the task's data"),
        (TASK | {"annotations": [3]}, "expected an annotation"),
        (TASK | {"annotations": 3}, '"annotations": list'),
        (BATTLE | {"winner": "model_c"}, "winner: expected model_a, model_b, tie"),
        (BATTLE | {"winner": "tie", "conversation_b": None}, "expected a list of messages"),
        (BATTLE | {"winner": "tie", "conversation_b": BATTLE["conversation_a"]}, "compare a candidate with itself"),
    ],
)
def test_what_does_not_fit_is_refused(row: Mapping[str, Any], message: str) -> None:
    with pytest.raises(ValueError) as caught:
        parse(dict(row))
    assert message in str(caught.value)


def test_a_task_with_other_names_is_read_by_a_map() -> None:
    row = {"data": {"q": "p", "x": "a", "y": "b"}, "annotations": [{"result": [{"value": {"selected": "left"}}]}]}
    (found,) = parse(row, Layout.of(columns="prompt=q,left=x,right=y"))
    assert isinstance(found, Row)
    assert short(found) == "a"


@pytest.mark.parametrize(
    ("row", "form"),
    [
        (record("tie"), "argilla"),
        (TASK | {"annotations": []}, "label-studio"),
        (BATTLE, "arena"),
        ({"prompt": {"role": "prompter"}}, "tree"),
        ({"prompt": "p", "responses": []}, "responses"),
        ({"prompt": "p", "completion": "c", "label": True}, "unpaired"),
        ({"chosen": "a", "rejected": "b"}, "preferences"),
        ({}, "preferences"),
    ],
)
def test_the_columns_tell_the_form(row: Mapping[str, Any], form: str) -> None:
    assert form_of(row) == form
