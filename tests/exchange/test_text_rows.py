import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest

from prefrl.exchange.formats import read_judgements
from prefrl.exchange.layout import Layout, Row
from prefrl.exchange.ports import export, import_judgements, try_import
from prefrl.exchange.text_rows import parse
from prefrl.judgements import Comparison, Rating, Skip
from prefrl.storage.log import StoreError
from prefrl.store import Store
from prefrl.types import Response

PAIR: dict[str, Any] = {"prompt": "p", "chosen": "yes", "rejected": "no"}
BAD = {"prompt": "p", "chosen": "yes"}
Q, YES, NO = ({"role": r, "content": c} for r, c in (("user", "q"), ("assistant", "yes"), ("assistant", "no")))


def lines(path: Path, *rows: Mapping[str, Any]) -> Path:
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


def one(row: Mapping[str, Any], layout: Layout | None = None) -> Row:
    (found,) = parse(dict(row), layout)
    assert isinstance(found, Row)
    return found


def preference_of(row: Row, text: str) -> float:
    assert isinstance(row.answer, Comparison)
    return row.answer.preference if row.query.candidates[0].text == text else 1.0 - row.answer.preference


@pytest.mark.parametrize(
    "row",
    [
        {"prompt": [Q], "chosen": [YES], "rejected": [NO]},
        {"chosen": [Q, YES], "rejected": [Q, NO]},
        {"prompt": "q", "chosen": [Q, YES], "rejected": [Q, NO]},
        {"chosen": "\n\nHuman: q\n\nAssistant: yes", "rejected": "\n\nHuman: q\n\nAssistant: no"},
        {"chosen": "Human: q\n\nAssistant: yes", "rejected": "Human: q\n\nAssistant: no", "prompt": None},
    ],
)
def test_one_conversation_is_one_query_however_it_is_laid_out(row: Mapping[str, Any]) -> None:
    found = one(row)
    assert {c.prompt for c in found.query.candidates} == {"Human: q\n\nAssistant: "}
    assert preference_of(found, "yes") == 1.0


def test_a_completion_with_a_label_is_a_rating_on_two_levels() -> None:
    for row in ({"prompt": "p", "completion": "c"}, {"prompt": [Q], "completion": [YES]}):
        for label in (True, False):
            answer = one(row | {"label": label}).answer
            assert isinstance(answer, Rating)
            assert (answer.levels, answer.scale) == ((int(label),), 2)


@pytest.mark.parametrize(("given", "expected"), [({"margin": 2.0}, 0.880797077978), ({"margin": 0}, 1.0), ({}, 1.0)])
def test_a_margin_says_how_sure_the_preference_is(given: dict[str, Any], expected: float) -> None:
    assert preference_of(one(PAIR | given), "yes") == pytest.approx(expected)


def test_a_skip_and_the_order_shown_are_read() -> None:
    row = {"prompt": "p", "responses": ["b", "a"], "labeler": "ann", "shown": [1, 0]}
    skip, ranking = one(row | {"skip": "incomparable"}).answer, one(row | {"ranks": [0, 1]})
    assert isinstance(skip, Skip)
    assert (skip.reason, skip.labeler) == ("incomparable", "ann")
    assert [ranking.query.candidates[i].text for i in ranking.answer.shown] == ["a", "b"]


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (PAIR | {"margin": -1}, "is the rejected one better?"),
        (PAIR | {"margin": 10**400}, "column 'margin': expected a finite number"),
        (PAIR | {"preference": 2}, "must lie in [0, 1], got 2"),
        (PAIR | {"weight": float("nan")}, "expected a finite number, got nan"),
        ({"chosen": "a", "rejected": "b"}, "column 'prompt' is missing; there are: chosen, rejected"),
        ({"chosen": [Q, YES], "rejected": [Q, YES]}, "the same text"),
        ({"chosen": [Q, YES], "rejected": [YES]}, "they answer different prompts"),
        ({"prompt": [Q], "chosen": [YES], "rejected": "no"}, "expected a string"),
        ({"prompt": "p", "completion": "c", "label": "good"}, "column 'label': expected true or false"),
        ({"prompt": "p", "completion": "c", "label": 1.0}, "column 'label': expected true or false"),
        ({"prompt": "p", "completion": 3, "label": True}, 'expected "prompt" and "completion"'),
        ({"prompt": "p", "responses": ["a", "b"], "best": 0, "shown": [0, 0]}, "each of 0 to 1 once"),
        ({"prompt": "p", "responses": ["a", "b"], "skip": "no"}, "expected skip or incomparable"),
    ],
)
def test_what_does_not_fit_is_refused(row: Mapping[str, Any], message: str) -> None:
    with pytest.raises(ValueError) as caught:
        parse(dict(row))
    assert message in str(caught.value)


# --- columns, bad rows, repeats -----------------------------------------------------------------------------------


def test_columns_are_read_as_they_are_mapped(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text("question,good,bad,sure,chosen\n p ,a,b,0.75,x\n")
    layout = Layout.of(columns="prompt=question, chosen=good,rejected=bad,preference=sure")
    (judged,) = read_judgements(tmp_path / "x.csv", layout=layout).judged
    assert {c.text for c in judged.query.candidates} == {"a", "b"}
    assert judged.query.candidates[0].prompt == " p "
    assert isinstance(judged.judgement, Comparison)
    assert judged.judgement.preference in (0.75, 0.25)


def test_lists_and_numbers_in_cells_are_read(tmp_path: Path) -> None:
    (tmp_path / "x.csv").write_text('prompt,responses,ranks,weight\np,"[""a"", ""b""]","[1, 0]",2\n')
    (judged,) = read_judgements(tmp_path / "x.csv").judged
    assert judged.judgement.weight == 2.0
    (tmp_path / "y.csv").write_text("prompt,completion,label\np,c,True\n")
    (judged,) = read_judgements(tmp_path / "y.csv").judged
    assert judged.judgement.levels == (1,)  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("columns", "message"),
    [
        ("prompt", "expected columns as prompt=question"),
        ("answer=x", "no column 'answer' is read"),
        ("prompt=x", "column 'x', for 'prompt', is missing; there are: prompt, chosen, rejected"),
    ],
)
def test_a_map_that_does_not_fit_is_refused(tmp_path: Path, columns: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read_judgements(lines(tmp_path / "x.jsonl", PAIR), layout=Layout.of(columns=columns))


def test_a_form_that_is_named_reads_nothing_else(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="row 1: column 'label'"):
        read_judgements(lines(tmp_path / "x.jsonl", PAIR), layout=Layout("unpaired"))


def test_bad_rows_are_left_out_only_when_asked_and_then_named(tmp_path: Path, text_store: Store[Response]) -> None:
    path = lines(tmp_path / "x.jsonl", PAIR, BAD, PAIR | {"rejected": "yes"})
    with pytest.raises(ValueError, match="nothing was read"):
        import_judgements(path, text_store)
    done = import_judgements(path, text_store, layout=Layout(skip_bad=True))
    assert done.read == 1
    (note,) = done.notes
    assert note.startswith("left out: 2 x bad row\nrow 2: column 'rejected' is missing")
    assert "row 3: chosen and rejected are the same text" in note


def test_repeats_are_named_with_their_rows(tmp_path: Path) -> None:
    (note,) = read_judgements(lines(tmp_path / "x.jsonl", PAIR, PAIR, PAIR | {"prompt": "q"}, PAIR)).notes
    assert note == (
        "2 x another judgement of the same query by the same labeler, kept as NAME#2: row 2 repeats row 1; "
        "row 4 repeats row 1"
    )


def test_a_dry_run_finds_what_an_import_would_and_writes_nothing(tmp_path: Path, text_store: Store[Response]) -> None:
    path = lines(tmp_path / "x.jsonl", PAIR | {"labeler": "ann"})
    assert try_import(path, None).read == try_import(path, text_store).read == 1
    assert text_store.sequence == 0
    import_judgements(path, text_store)
    other = lines(tmp_path / "y.jsonl", {"prompt": "p", "chosen": "no", "rejected": "yes", "labeler": "ann"})
    for attempt in (try_import, import_judgements):
        with pytest.raises(StoreError, match="otherwise before"):
            attempt(other, text_store)
    with pytest.raises(ValueError, match="nothing was read"):
        try_import(lines(tmp_path / "z.jsonl", BAD), None)


def test_an_import_that_fails_late_leaves_nothing(tmp_path: Path, text_store: Store[Response]) -> None:
    import_judgements(lines(tmp_path / "x.jsonl", PAIR | {"labeler": "ann"}), text_store)
    many = [PAIR | {"prompt": str(n), "labeler": "ann"} for n in range(1000)]
    before = text_store.sequence
    last = {"prompt": "p", "chosen": "no", "rejected": "yes", "labeler": "ann"}
    with pytest.raises(StoreError, match="otherwise before"):
        import_judgements(lines(tmp_path / "y.jsonl", *many, last), text_store)
    assert text_store.sequence == before


@pytest.mark.parametrize("form", ["responses", "tree", "argilla", "label-studio", "arena"])
@pytest.mark.parametrize("value", [None, 1, "x", []])
def test_a_row_that_is_not_of_the_form_that_was_named_is_a_mistake_in_a_row(form: str, value: Any) -> None:
    names = ("prompt", "responses", "fields", "data", "annotations", "conversation_a", "winner")
    with pytest.raises(ValueError):
        parse(dict.fromkeys(names, value), Layout(form))


def test_a_completion_without_a_label_is_a_demonstration_and_is_written_so(
    tmp_path: Path, text_store: Store[Response]
) -> None:
    rows: list[Mapping[str, Any]] = [
        {"prompt": "p", "completion": "c", "weight": 2.0},
        {"messages": [Q, YES], "labeler": "ann"},
    ]
    assert import_judgements(lines(tmp_path / "in.jsonl", *rows), text_store).read == 2
    shown = [(one.like.prompt, one.like.text) for one in text_store.demonstrations()]
    assert shown == [("p", "c"), ("Human: q\n\nAssistant: ", "yes")]
    assert text_store.judged() == []
    done = export(text_store, tmp_path / "out.jsonl", "demonstrations")
    written = [json.loads(line) for line in (tmp_path / "out.jsonl").read_text().splitlines()]
    assert [(row["prompt"], row["completion"]) for row in written] == shown
    assert [row.get("weight", 1.0) for row in written] == [2.0, 1.0]
    assert (done.written, done.dropped) == (2, {"annotator's name": 2, "time of an answer": 2})
    dropped = export(text_store, tmp_path / "pairs.jsonl", "preferences").dropped
    assert dropped["demonstration"] == 2


def test_the_assistants_last_words_are_the_completion() -> None:
    system = {"role": "system", "content": "s"}
    (shown,) = one({"messages": [system, Q, YES, Q, NO]}).query.candidates
    assert shown.prompt == "System: s\n\nHuman: q\n\nAssistant: yes\n\nHuman: q\n\nAssistant: "
    assert shown.text == "no"
    rated = one({"messages": [Q, YES], "label": False})
    assert isinstance(rated.answer, Rating)
    assert rated.query.id == one({"prompt": [Q], "completion": [YES]}).query.id


@pytest.mark.parametrize(
    ("messages", "message"),
    [
        ([Q], "column 'messages': .* got user"),
        ([YES], "column 'messages': .* got assistant"),
        ([Q, YES, Q], "column 'messages': .* got user, assistant, user"),
        ([Q, YES, NO], "ends with the assistant's words leaves it unclear"),
        ("q", "expected a list of messages"),
    ],
)
def test_a_conversation_without_a_last_word_of_the_assistant_is_refused(messages: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        one({"messages": messages})


@pytest.mark.parametrize("label", [{"label": None}, {"good": False}, {"Label": True}])
def test_a_row_with_what_may_be_a_label_is_no_demonstration(label: Mapping[str, Any]) -> None:
    with pytest.raises(ValueError, match="column 'label': expected true or false"):
        one({"prompt": "p", "completion": "c", **label})


def test_an_empty_demonstration_is_refused() -> None:
    with pytest.raises(ValueError, match="expected what a good response is like, got an empty text"):
        one({"prompt": "p", "completion": ""})
