import gzip
import json
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from prefrl.exchange import reading
from prefrl.exchange.guard import guarded, unguarded
from prefrl.exchange.reading import Line, parse_json, read_lines, read_rows

ROW = {"prompt": "p", "chosen": "a", "rejected": "b"}


def listed(path: Path) -> list[Any]:
    return [parse_json(row.text) if isinstance(row, Line) else row for row in read_rows(path)]


@pytest.mark.parametrize("start", ["", "\ufeff"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_byte_order_marks_and_line_ends_of_windows_are_no_text(tmp_path: Path, start: str, end: str) -> None:
    (tmp_path / "x.jsonl").write_bytes(f"{start}{json.dumps(ROW)}{end}".encode())
    (tmp_path / "x.csv").write_bytes(f"{start}prompt,chosen,rejected{end}p,a,b{end}".encode())
    assert listed(tmp_path / "x.jsonl") == listed(tmp_path / "x.csv") == [ROW]


def test_text_that_is_not_utf8_is_named_with_its_row(tmp_path: Path) -> None:
    (tmp_path / "x.jsonl").write_bytes(b'{"a": 1}\n\xff\xfe')
    with pytest.raises(ValueError, match="row 2 is no UTF-8"):
        listed(tmp_path / "x.jsonl")


def test_a_huge_row_is_refused_before_it_is_in_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reading, "ROW_LIMIT", 1 << 20)
    for name in ("x.jsonl", "x.csv"):
        (tmp_path / name).write_text("a,b\n" + "x" * (2 << 20))
        with pytest.raises(ValueError, match="row 2 is longer than 1 MB"):
            list(read_rows(tmp_path / name))
    (tmp_path / "x.json").write_text('[1, "' + "x" * (4 << 20) + '"]')
    with pytest.raises(ValueError, match=r"row 2: .* a row of more than 1 MB"):
        listed(tmp_path / "x.json")


def test_a_file_that_unpacks_to_far_more_than_its_size_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(reading, "UNPACKED_FREELY", 1 << 20)
    (tmp_path / "x.jsonl.gz").write_bytes(gzip.compress(b'{"a": 1}\n' * 2_000_000))
    (tmp_path / "x.json.gz").write_bytes(gzip.compress(b"[" + b"1," * 8_000_000 + b"1]"))
    for name in ("x.jsonl.gz", "x.json.gz"):
        with pytest.raises(ValueError, match="unpacks to over 200 times its size"):
            for _ in read_rows(tmp_path / name):
                pass


@pytest.mark.parametrize("name", ["x.zip", "x.tar.gz", "x.tgz"])
def test_archives_are_not_opened(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_bytes(b"")
    with pytest.raises(ValueError, match="unpack it"):
        read_rows(tmp_path / name)


@given(st.lists(st.recursive(st.none() | st.booleans() | st.integers() | st.text(max_size=9), st.lists, max_leaves=5)))
def test_a_list_is_read_element_by_element_wherever_the_chunks_end(
    tmp_path_factory: pytest.TempPathFactory, elements: list[Any]
) -> None:
    path = tmp_path_factory.mktemp("list") / "x.json"
    path.write_text(json.dumps(elements, indent=1, ensure_ascii=False))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reading, "CHUNK", 3)
        assert listed(path) == elements


@pytest.mark.parametrize("text", ["[1", "[1 2]", "[1]x", "[1,,2]", "[NaN]", "[1e999]", '{"a": 1}\n[', "[" * 100_000])
def test_a_broken_list_is_refused(tmp_path: Path, text: str) -> None:
    (tmp_path / "x.json").write_text(text)
    with pytest.raises(ValueError):
        listed(tmp_path / "x.json")


@pytest.mark.parametrize("text", ["NaN", "Infinity", "-Infinity", "1e400", "-1e400", "1" * 5000])
def test_numbers_that_are_none_are_refused(text: str) -> None:
    with pytest.raises(ValueError):
        parse_json(text)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "expected a header"),
        ("a,a\n1,2\n", "names each column once"),
        ("a,b\n1,2\n1,2,3\n", "row 2: expected 2 cells, as the header has, got 3"),
        ('a,b\n"1,2\n', "row 1: unexpected end of data"),
    ],
)
def test_a_broken_table_is_named_with_its_row(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "x.csv").write_text(text)
    with pytest.raises(ValueError, match=message):
        listed(tmp_path / "x.csv")


@pytest.mark.parametrize("name", ["x.parquet", "x.arrow"])
def test_what_is_no_table_is_refused(tmp_path: Path, name: str) -> None:
    pytest.importorskip("pyarrow")
    (tmp_path / name).write_bytes(b"PAR1 and no more")
    with pytest.raises(ValueError, match="cannot be read as"):
        listed(tmp_path / name)


def test_lines_are_cut_at_line_feeds_alone(tmp_path: Path) -> None:
    (tmp_path / "x").write_bytes("a\u2028b\x0bc\rd\ne".encode())
    assert list(read_lines(tmp_path / "x")) == ["a\u2028b\x0bc\rd", "e"]


@given(st.dictionaries(st.sampled_from(["prompt", "chosen"]), st.text(max_size=5), min_size=2))
def test_a_guard_is_taken_away_again(row: dict[str, str]) -> None:
    assert unguarded(guarded(row, row)) == row


def test_nobody_elses_apostrophe_is_taken_away() -> None:
    assert unguarded({"chosen": "'=1"}) == {"chosen": "'=1"}
    with pytest.raises(ValueError, match="starts with no apostrophe"):
        unguarded({"chosen": "x", "guarded": "chosen"})
