import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest

from prefrl.exchange.ports import export_bundle, export_preferences, import_bundle, import_judgements
from prefrl.judgements import Comparison, Ranking
from prefrl.storage.log import StoreError
from prefrl.store import Store
from prefrl.types import Query, Response, Segment


def lines(*rows: Mapping[str, object]) -> str:
    return "".join(json.dumps(row) + "\n" for row in rows)


GOOD = {"prompt": "p", "chosen": "yes", "rejected": "no"}


def texts(*names: str) -> Query[Response]:
    return Query(tuple(Response("p", name) for name in names))


def test_preferences_survive_going_out_and_coming_back(text_store: Store[Response], tmp_path: Path) -> None:
    path, again = tmp_path / "in.jsonl", tmp_path / "out.jsonl"
    path.write_text(lines(GOOD, {"prompt": "q", "chosen": "ü \u202e <b>", "rejected": ""}))
    assert import_judgements(path, text_store).read == 2
    assert export_preferences(text_store, again).written == 2
    assert [json.loads(x) for x in again.read_text().splitlines()] == [
        json.loads(x) for x in path.read_text().splitlines()
    ]


def test_a_ranking_goes_out_as_its_pairs_and_ties_are_counted(text_store: Store[Response], tmp_path: Path) -> None:
    query = texts("a", "b", "c")
    by_text = {c.text: rank for c, rank in zip(query.candidates, (0, 1, 1), strict=True)}
    text_store.ask([query])
    text_store.answer([Ranking(query.id, (0, 1, 1), "me")])
    done = export_preferences(text_store, tmp_path / "out.jsonl")
    assert (done.written, done.dropped["tie"]) == (2, 1)
    for row in map(json.loads, (tmp_path / "out.jsonl").read_text().splitlines()):
        assert by_text[row["chosen"]] < by_text[row["rejected"]]


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_tables_are_read_as_well(text_store: Store[Response], tmp_path: Path, suffix: str) -> None:
    datasets = pytest.importorskip("datasets")
    table = datasets.Dataset.from_list([GOOD, {"prompt": 'q, "r"', "chosen": "a\nb", "rejected": "c"}])
    path = tmp_path / f"in{suffix}"
    (table.to_csv if suffix == ".csv" else table.to_parquet)(str(path))
    assert import_judgements(path, text_store).read == 2
    assert {c.text for j in text_store.judged() for c in j.query.candidates} == {"yes", "no", "a\nb", "c"}
    broken = datasets.Dataset.from_list([GOOD, GOOD | {"chosen": None}])
    (broken.to_csv if suffix == ".csv" else broken.to_parquet)(str(path))
    with pytest.raises(ValueError, match="row 2: column 'chosen': expected a string, got None"):
        import_judgements(path, text_store)


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ('{"prompt": "p", "chosen": "a"}', "row 2: column 'rejected' is missing; there are: prompt, chosen"),
        ('{"prompt": "p", "chosen": NaN, "rejected": "b"}', "row 2: NaN is not a value"),
        ('{"prompt": "p", "chosen": 3, "rejected": "b"}', "row 2: column 'chosen': expected a string, got 3"),
        ('{"prompt": "p", "chosen": "a", "rejected": "a"}', "row 2: chosen and rejected are the same"),
        ("[1]", "row 2: expected an object"),
        ("{", "row 2:"),
    ],
)
def test_a_bad_row_is_named_and_nothing_is_imported(
    text_store: Store[Response], tmp_path: Path, row: str, message: str
) -> None:
    path = tmp_path / "bad.jsonl"
    path.write_text(lines(GOOD) + row + "\n" + lines(GOOD))
    with pytest.raises(ValueError) as caught:
        import_judgements(path, text_store)
    assert message in str(caught.value)
    assert text_store.counts()["asked"] == 0


def test_many_bad_rows_are_cut_at_twenty_and_an_empty_file_is_an_error(
    text_store: Store[Response], tmp_path: Path
) -> None:
    path = tmp_path / "bad.jsonl"
    path.write_text("{}\n" * 50)
    with pytest.raises(ValueError, match="and 30 more"):
        import_judgements(path, text_store)
    path.write_text("")
    with pytest.raises(ValueError, match="at least one judgement"):
        import_judgements(path, text_store)


def test_a_contradiction_is_kept_as_two_judgements(text_store: Store[Response], tmp_path: Path) -> None:
    path = tmp_path / "in.jsonl"
    path.write_text(lines(GOOD, {"prompt": "p", "chosen": "no", "rejected": "yes"}))
    import_judgements(path, text_store)
    judgements = [j.judgement for j in text_store.judged()]
    assert sorted(j.preference for j in judgements if isinstance(j, Comparison)) == [0.0, 1.0]
    assert len({j.labeler for j in judgements}) == 2


def test_segments_do_not_fit_text_columns_and_the_error_says_what_does(
    store: Store[Segment], make_query: Callable[..., Query[Segment]], tmp_path: Path
) -> None:
    store.ask([query := make_query()])
    store.answer([Comparison(query.id, 1.0)])
    with pytest.raises(StoreError, match="--form bundle"):
        export_preferences(store, tmp_path / "out.jsonl")


def test_two_files_that_contradict_each_other_are_both_kept(text_store: Store[Response], tmp_path: Path) -> None:
    for name, row in (("a", GOOD), ("b", {"prompt": "p", "chosen": "no", "rejected": "yes"})):
        (tmp_path / name).write_text(lines(row))
        import_judgements(tmp_path / name, text_store)
        import_judgements(tmp_path / name, text_store)  # again: nothing changes
    assert text_store.counts() == {"asked": 1, "answered": 2, "skipped": 0}


@pytest.mark.parametrize("text", ["a\u2028b", "a\u0085b", "a\nb", "\ud800", "\r", "\x00"])
def test_any_text_survives_both_forms(text_store: Store[Response], tmp_path: Path, text: str) -> None:
    text_store.ask([query := texts(text, "other")])
    text_store.answer([Comparison(query.id, 1.0, "me")])
    export_preferences(text_store, tmp_path / "out.jsonl")
    export_bundle(text_store, tmp_path / "bundle")
    for read, name in ((import_judgements, "out.jsonl"), (import_bundle, "bundle")):
        with Store[Response](tmp_path / f"copy of {name}") as copy:
            read(tmp_path / name, copy)
            (judged,) = copy.judged()
            assert {c.text for c in judged.query.candidates} == {text, "other"}


def test_texts_do_not_get_into_a_store_of_segments(
    store: Store[Segment], make_query: Callable[..., Query[Segment]], tmp_path: Path
) -> None:
    store.ask([make_query()])
    (tmp_path / "in.jsonl").write_text(lines(GOOD))
    mixed: Any = store
    with pytest.raises(StoreError, match="holds segments"):
        import_judgements(tmp_path / "in.jsonl", mixed)
