"""A store's own file brings nothing new, though it has lost tokens and simulator states, and with them the ids."""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from prefrl.exchange.ports import export, import_judgements, try_import
from prefrl.judgements import Choice, Comparison, Ranking, Rating, Skip
from prefrl.storage.log import StoreError
from prefrl.store import Store
from prefrl.types import Query, Response, Segment


def asked(*texts: str, token: int = 1, prompt: str = "Human: p\n\nAssistant: ") -> Query[Response]:
    """Responses as a model has sampled them: tokens are part of what they are called after."""
    return Query(tuple(Response(prompt, text, (0,), (token, len(text))) for text in texts))


def fill(store: Store[Response]) -> None:
    queries = [asked(f"{k}", f"{k}{k}") for k in range(6)]
    store.ask(queries)
    store.answer([Comparison(query.id, k % 2, "me", (1, 0)) for k, query in enumerate(queries)])
    store.answer([Skip(queries[0].id, "incomparable", "you"), Comparison(queries[1].id, 0.5, "you", (), 2.0)])


@pytest.mark.parametrize("form", ["judgements", "dataset", "csv", "argilla", "label-studio", "arena"])
def test_a_store_knows_its_own_answers_again(form: str, text_store: Store[Response], tmp_path: Path) -> None:
    fill(text_store)
    if form in ("argilla", "label-studio", "arena"):  # these hold no weights
        text_store.retract(asked("1", "11").id, "you")
    path = tmp_path / {"dataset": "set", "csv": "x.csv"}.get(form, "x.json")
    path = path.with_suffix(".jsonl") if form in ("judgements", "arena") else path
    written = export(text_store, path, form).written
    before = list(text_store.events())
    assert try_import(path, text_store) == import_judgements(path, text_store)
    done = import_judgements(path, text_store)
    assert done.read == done.known > 0
    assert written > 5
    assert list(text_store.events()) == before


def test_every_sort_of_answer_is_turned_to_the_order_of_its_query(text_store: Store[Response], tmp_path: Path) -> None:
    three = [asked(f"{k}", f"{k}a", f"{k}b") for k in range(8)]
    text_store.ask(three)
    text_store.answer([Ranking(query.id, (0, 2, 1), "a", (2, 0, 1)) for query in three])
    text_store.answer([Choice(query.id, 1, "b", (1, 2, 0)) for query in three])
    text_store.answer([Rating(query.id, (3, 0, 4), 5, "c") for query in three])
    export(text_store, tmp_path / "x.jsonl", "judgements")
    assert import_judgements(tmp_path / "x.jsonl", text_store).known == 24
    said = text_store.answers()
    with Store[Response](tmp_path / "later") as later:  # asked the same, not answered yet
        later.ask(three)
        assert import_judgements(tmp_path / "x.jsonl", later).known == 0
        assert later.answers() == said


def test_the_same_words_from_other_tokens_are_told_apart(text_store: Store[Response], tmp_path: Path) -> None:
    one, two = asked("a", "b", token=1), asked("a", "b", token=2)
    text_store.ask([one, two])
    text_store.answer([Comparison(one.id, 1.0, "me"), Comparison(two.id, 0.0, "me")])
    export(text_store, tmp_path / "x.jsonl", "judgements")
    assert import_judgements(tmp_path / "x.jsonl", text_store).known == 2
    assert text_store.counts() == {"asked": 2, "answered": 2, "skipped": 0}


def lines(path: Path, *rows: Mapping[str, object]) -> Path:
    path.write_text("".join(json.dumps(row) + "\n" for row in rows))
    return path


def test_a_row_that_names_a_query_of_other_words_is_a_row_of_its_own(
    text_store: Store[Response], tmp_path: Path
) -> None:
    fill(text_store)
    query = asked("0", "00")
    row = {"prompt": query.candidates[0].prompt, "responses": ["0", "other"], "preference": 1, "labeler": "me"}
    for named in (query.id, "f" * 64, "what is better?", 5, query.candidates[0].id):
        import_judgements(lines(tmp_path / "x.jsonl", row | {"query": named}), text_store)
    assert text_store.counts()["asked"] == 7


def test_another_answer_to_the_query_that_a_row_names_contradicts_the_store(
    text_store: Store[Response], tmp_path: Path
) -> None:
    fill(text_store)
    query = asked("0", "00")
    texts = [candidate.text for candidate in query.candidates]
    row = {"query": query.id, "prompt": query.candidates[0].prompt, "responses": texts, "preference": 1}
    for read in (try_import, import_judgements):
        with pytest.raises(StoreError, match="'me' has judged query"):
            read(lines(tmp_path / "x.jsonl", row | {"labeler": "me"}), text_store)
    assert import_judgements(lines(tmp_path / "x.jsonl", row | {"labeler": "new"}), text_store).known == 0
    assert text_store.counts()["asked"] == 6


def test_segments_are_known_again_without_their_states(store: Store[Segment], tmp_path: Path) -> None:
    pytest.importorskip("minari")
    zeros = np.zeros((3, 2), np.float32)
    segments = [Segment(zeros + k, zeros, f"{k}", k, np.full((3, 4), k, np.float64)) for k in range(6)]
    queries = [Query(pair) for pair in zip(segments[::2], segments[1::2], strict=True)]
    store.ask(queries)
    store.answer([Comparison(query.id, 1.0, "me", (1, 0)) for query in queries])
    export(store, tmp_path / "episodes", "minari")
    assert import_judgements(tmp_path / "episodes", store).known == 3
    assert store.counts() == {"asked": 3, "answered": 3, "skipped": 0}
