"""`prefrl label`: whose queries are answered, by whom, and what is said of it."""

import json
from pathlib import Path

import pytest
from shell import Shell

from prefrl.judgements import Comparison
from prefrl.store import Store
from prefrl.types import Response


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("label text/toy --host 0.0.0.0", "--host and --port go with --serve"),
        ("label text/toy --port 0", "--host and --port go with --serve"),
        ("label text/toy --serve --terminal", "--terminal and --serve are two ways"),
        ("label store --serve --out other", "store holds neither a run with a checkpoint"),
        ("label store --serve --given given.jsonl", "--given and --policy are for new ones"),
    ],
)
def test_an_option_that_would_be_ignored_is_refused(prefrl: Shell, line: str, message: str) -> None:
    Path("store").mkdir()
    Path("store/store.url").write_text("sqlite:///elsewhere.db")
    Path("given.jsonl").write_text("")
    assert prefrl(line) == 2
    assert prefrl.err == f"error: {prefrl.err[7:].strip()}\n"
    assert message in prefrl.err
    assert not Path("labels").exists()


def test_a_store_in_another_database_is_served_and_its_queries_counted_once(prefrl: Shell, tmp_path: Path) -> None:
    pytest.importorskip("uvicorn")
    Path("pool").mkdir()
    Path("pool/store.url").write_text(f"sqlite:///{tmp_path / 'elsewhere.db'}")
    assert prefrl("label text/toy loop.labels=3 --out pool") == 0
    with Store[Response](Path("pool")) as store:
        query = store.judged()[0].query
        store.answer([Comparison(query.id, 1.0, "somebody else")])
    assert prefrl("label pool --serve --port 0") == 0  # all is answered: it ends at once
    assert "everything is answered in pool; new questions: prefrl label pool --serve --out" in prefrl.out
    assert "3 of 3 queries answered, 0 skipped, in pool" in prefrl.out


def test_ctrl_c_while_a_folder_is_served_names_that_folder(prefrl: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    def stopped(*_: object) -> None:
        raise KeyboardInterrupt

    assert prefrl("label text/toy loop.labels=3 --out pool") == 0
    monkeypatch.setattr("prefrl.stages.serve", stopped)
    assert prefrl("label pool --serve") == 130
    assert "what was answered is in pool." in prefrl.out


def test_candidates_of_ones_own_can_be_labelled(prefrl: Shell) -> None:
    rows = [{"prompt": "this film was", "responses": [" wonderful .", " terrible .", " long ."]}]
    Path("given.jsonl").write_text("\n".join(json.dumps(row) for row in rows))
    assert prefrl("label text/toy --given given.jsonl --out labels") == 0
    assert prefrl("export labels --to out.jsonl") == 0
    best = {json.loads(line)["chosen"] for line in Path("out.jsonl").read_text().splitlines()}
    assert " wonderful ." in best
    assert " terrible ." not in best
    Path("given.jsonl").write_text('{"prompt": "p"}')
    assert prefrl("label text/toy --given given.jsonl --out other") == 2
    assert "row 1: expected" in prefrl.err


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ('{"prompt": "p", "responses": "bad"}', "row 1: expected"),
        ('{"prompt": "p", "responses": ["a"]}', "row 1: a query needs at least 2"),
        ("", "at least one row"),
    ],
)
def test_given_candidates_are_checked(prefrl: Shell, row: str, message: str) -> None:
    Path("given.jsonl").write_text(row)
    assert prefrl("label text/toy --given given.jsonl --out labels") == 2
    assert message in prefrl.err
    assert prefrl("label control/toy --given given.jsonl --out other") == 2
    assert "holds responses to prompts, but the task is of kind 'control'" in prefrl.err


def test_asking_for_more_labels_asks_for_the_rest(prefrl: Shell) -> None:
    assert prefrl("label control/toy --out labels loop.labels=5") == 0
    assert prefrl("label control/toy --out labels loop.labels=12") == 0
    assert "12 of 12 queries answered" in prefrl.out
