import json
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from run_folders import folder_of_run

from prefrl.cli.exchange import Form, Rows
from prefrl.cli.main import main
from prefrl.exchange.ports import EXPORTS
from prefrl.exchange.text_rows import FORMS
from prefrl.store import Store
from prefrl.types import Query, Response

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
    assert {form.value for form in Form} == {*EXPORTS, "classifier", "policy", "adapter", "sb3", "onnx"}
    assert {form.value for form in Rows} == {*FORMS, "auto"}


def test_a_policy_leaves_with_a_readme(prefrl: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder_of_run(tmp_path / "run", [-1200.0, -180.0], {"task": {"kind": "control"}, "seed": 0})
    monkeypatch.setattr("prefrl.stages.export_onnx", lambda source, to, best: to.write_bytes(b"a network"))
    monkeypatch.setattr("prefrl.stages.shown_of", lambda source: "")
    assert prefrl("export run --form onnx --to policy.onnx")[0] == 0
    assert "Gold rose from −1,200 to −180" in (tmp_path / "policy.onnx.md").read_text()
    code, printed = prefrl("export run --form policy --best --to policy")
    assert (code, "--best goes with --form sb3" in printed) == (2, True)


def test_an_export_says_what_it_left_out(prefrl: Command) -> None:
    assert prefrl("import in.jsonl --out labels")[0] == 0
    code, printed = prefrl("export labels --to out.jsonl --form preferences --ties both")
    assert code == 0
    assert "left out: 1 x annotator's name" in printed
    assert "1 written to out.jsonl" in printed
    code, printed = prefrl("export labels --to out.csv --form csv --ties both")
    assert (code, "has its own way" in printed) == (2, True)


def test_an_export_of_nothing_fails(prefrl: Command) -> None:
    with Store[Response](Path("asked")) as store:
        store.ask([Query((Response("p", "a"), Response("p", "b")))])
    code, printed = prefrl("export asked --to out.jsonl")
    assert (code, "asked holds nothing that preferences can say" in printed) == (2, True)


def test_a_dry_run_writes_nothing(prefrl: Command) -> None:
    code, printed = prefrl("import in.jsonl --out labels --dry-run")
    assert (code, "1 answers would be read" in printed) == (0, True)
    assert not Path("labels").exists()
    prefrl("import in.jsonl --out labels")
    assert prefrl("import in.jsonl --out labels --dry-run")[0] == 0


def test_columns_can_be_named_and_bad_rows_left_out(prefrl: Command) -> None:
    Path("table.csv").write_text("q,yes,no\np,a,b\np,c,c\n")
    line = "import table.csv --out labels --map prompt=q,chosen=yes,rejected=no"
    code, printed = prefrl(line)
    assert (code, "row 2: chosen and rejected are the same text" in printed) == (2, True)
    code, printed = prefrl(f"{line} --skip-bad")
    assert (code, "1 answers read into labels" in printed) == (0, True)


def test_an_import_says_what_was_there_already(prefrl: Command) -> None:
    assert "1 answers read into labels\n" in prefrl("import in.jsonl --out labels")[1]
    Path("in.jsonl").write_text("".join(json.dumps(ROW | {"prompt": p}) + "\n" for p in ("p", "q")))
    assert (
        "2 answers would be read into labels: 1 new, 1 there already"
        in (prefrl("import in.jsonl --out labels --dry-run")[1])
    )
    assert "2 answers read into labels: 1 new, 1 there already" in prefrl("import in.jsonl --out labels")[1]


def test_recorded_behaviour_comes_in_is_cloned_and_goes_out(prefrl: Command) -> None:
    rng = np.random.default_rng(0)
    seen, done = rng.normal(size=(5, 3)).astype(np.float32), rng.uniform(-2, 2, (5, 1)).astype(np.float32)
    np.savez("episodes.npz", observations=seen, actions=done, lengths=[2, 3])
    code, printed = prefrl("import episodes.npz --out run --dry-run")
    assert (code, "2 answers would be read" in printed, Path("run").exists()) == (0, True, False)
    assert "recorded behaviour, read as demonstrations: 2 by file:" in prefrl("import episodes.npz --out run")[1]
    assert "2 answers read into run: 0 new, 2 there already" in prefrl("import episodes.npz --out run")[1]
    code, printed = prefrl("export run --form demonstrations --to out.csv")
    assert (code, "go into an .npz" in printed) == (2, True)
    code, printed = prefrl("export run --form demonstrations --to out.npz")
    assert (code, "2 written to out.npz" in printed) == (0, True)
    with np.load("out.npz") as file:
        assert (file["observations"].tobytes(), file["actions"].tobytes()) == (seen.tobytes(), done.tobytes())
    small = "learner.cloning_epochs=1 learner.evaluation_episodes=1"
    code, printed = prefrl(f"run control/pendulum-demos labeler.episodes=0 {small} --out run")
    assert (code, "demonstrations 2" in printed) == (0, True)


def test_recorded_behaviour_that_is_wrong_leaves_no_store_behind(prefrl: Command) -> None:
    np.savez("bad.npz", observations=np.full((5, 3), np.nan), actions=np.zeros((5, 1)), lengths=[2, 3])
    code, printed = prefrl("import bad.npz --out run")
    assert (code, "episode 1: array observations is nan in step 0" in printed, Path("run").exists()) == (2, True, False)


def test_an_export_never_writes_over_a_file_unasked(prefrl: Command) -> None:
    prefrl("import in.jsonl --out labels")
    Path("mine.txt").write_text("mine")
    for form in ("preferences", "bundle"):
        code, printed = prefrl(f"export labels --to mine.txt --form {form}")
        assert (code, "mine.txt is there already" in printed, Path("mine.txt").read_text()) == (2, True, "mine")
    assert prefrl("export labels --to mine.txt --force")[0] == 0
    assert json.loads(Path("mine.txt").read_text())["chosen"] == "a"


def test_an_import_that_fails_leaves_no_store_behind(prefrl: Command) -> None:
    Path("bad.jsonl").write_text("{}\n")
    Path("mine").mkdir()
    Path("mine/notes.txt").write_text("mine")
    for out in ("new/deeper", "mine"):
        assert prefrl(f"import bad.jsonl --out {out}")[0] == 2
    assert not Path("new").exists()
    assert [path.name for path in Path("mine").iterdir()] == ["notes.txt"]
    prefrl("import in.jsonl --out labels")
    assert prefrl("import bad.jsonl --out labels")[0] == 2
    assert prefrl("verify labels")[0] == 0


def test_a_store_that_another_process_is_writing_to_is_not_removed(prefrl: Command) -> None:
    with Store[Response](Path("labels")):
        code, printed = prefrl("import in.jsonl --out labels")
        assert (code, "another process is writing" in printed) == (2, True)
    assert prefrl("verify labels")[0] == 0


@pytest.mark.parametrize("option", ["--skip-bad", "--map prompt=q", "--form arena", "--labelers ann"])
def test_options_that_a_bundle_would_ignore_are_refused(prefrl: Command, option: str) -> None:
    prefrl("import in.jsonl --out labels")
    prefrl("export labels --to bundle --form bundle")
    for dry in ("", " --dry-run"):
        code, printed = prefrl(f"import bundle --out copy {option}{dry}")
        assert (code, "a bundle is read whole" in printed) == (2, True)
    assert not Path("copy").exists()


def test_an_error_is_one_line_however_long_a_path_is(prefrl: Command) -> None:
    path = "x" * 100 + "/" + "y" * 200 + ".jsonl"
    Path(path).parent.mkdir()
    Path(path).write_text("")
    code, printed = prefrl(f"import {path} --out labels")
    assert (code, printed.count("\n"), path in printed) == (2, 1, True)
