import json
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from prefrl.cli import main
from prefrl.cli_data import Form, Rows
from prefrl.label.exchange import EXPORTS
from prefrl.label.text_rows import FORMS

ROW = {"prompt": "p", "chosen": "a", "rejected": "b", "labeler": "ann"}
Command = Callable[[str], tuple[int, str]]


@pytest.fixture
def prefrl(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Command:
    """Runs `prefrl ...` in this process; gives its exit status and what it printed."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    (tmp_path / "in.jsonl").write_text(json.dumps(ROW) + "\n")

    def run(line: str) -> tuple[int, str]:
        monkeypatch.setattr(sys, "argv", ["prefrl", *line.split()])
        try:
            main()
            code = 0
        except SystemExit as error:
            code = int(error.code or 0)
        return code, "".join(capsys.readouterr())

    return run


def test_the_commands_know_every_form() -> None:
    assert {form.value for form in Form} == {*EXPORTS, "classifier"}
    assert {form.value for form in Rows} == {*FORMS, "auto"}


def test_an_export_says_what_it_left_out(prefrl: Command) -> None:
    assert prefrl("import in.jsonl --out labels")[0] == 0
    code, printed = prefrl("export labels --to out.jsonl --form preferences --ties both")
    assert code == 0
    assert "left out: 1 x annotator's name" in printed
    assert "1 written to out.jsonl" in printed
    code, printed = prefrl("export labels --to out.csv --form csv --ties both")
    assert (code, "has its own way" in printed) == (2, True)


def test_a_dry_run_writes_nothing(prefrl: Command) -> None:
    code, printed = prefrl("import in.jsonl --out labels --dry-run")
    assert (code, "1 judgements would be read" in printed) == (0, True)
    assert not Path("labels").exists()
    prefrl("import in.jsonl --out labels")
    assert prefrl("import in.jsonl --out labels --dry-run")[0] == 0


def test_columns_can_be_named_and_bad_rows_left_out(prefrl: Command) -> None:
    Path("table.csv").write_text("q,yes,no\np,a,b\np,c,c\n")
    line = "import table.csv --out labels --map prompt=q,chosen=yes,rejected=no"
    code, printed = prefrl(line)
    assert (code, "row 2: chosen and rejected are the same text" in printed) == (2, True)
    code, printed = prefrl(f"{line} --skip-bad")
    assert (code, "1 judgements read into labels" in printed) == (0, True)
