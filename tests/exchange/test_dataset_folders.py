import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from prefrl.exchange.formats import read_judgements
from prefrl.exchange.layout import Which
from prefrl.exchange.ports import import_judgements
from prefrl.store import Store
from prefrl.types import Response

ROWS = [{"prompt": "p", "chosen": "a", "rejected": "b"}, {"prompt": "q", "chosen": "NA", "rejected": "="}]
CHAT = [
    {
        "chosen": [{"role": "user", "content": "q"}, {"role": "assistant", "content": good}],
        "rejected": [{"role": "user", "content": "q"}, {"role": "assistant", "content": "no"}],
    }
    for good in ("yes", "sure")
]


@pytest.fixture
def saved(tmp_path: Path) -> Callable[..., Path]:
    datasets = pytest.importorskip("datasets")

    def save(rows: list[dict[str, Any]], split: str = "") -> Path:
        data = datasets.Dataset.from_list(rows)
        (datasets.DatasetDict({split: data}) if split else data).save_to_disk(str(tmp_path / "saved"))
        return tmp_path / "saved"

    return save


def chosen(path: Path, which: Which | None = None) -> set[str]:
    found = set()
    for judged in read_judgements(path, which).judged:
        found.add(judged.query.candidates[0 if judged.judgement.preference > 0.5 else 1].text)  # type: ignore[union-attr]
    return found


@pytest.mark.parametrize("split", ["", "test"])
def test_what_save_to_disk_wrote_is_read(saved: Callable[..., Path], split: str) -> None:
    path = saved(ROWS, split)
    assert chosen(path, Which(split=split)) == {"a", "NA"}
    if split:
        with pytest.raises(ValueError, match="splits there: test"):
            read_judgements(path, Which(split="train"))


def test_conversations_in_a_table_are_read(saved: Callable[..., Path]) -> None:
    assert chosen(saved(CHAT)) == {"yes", "sure"}


def test_a_folder_of_parquet_has_the_splits_that_its_names_say(tmp_path: Path) -> None:
    datasets = pytest.importorskip("datasets")
    for split, row in zip(("train", "test"), ROWS, strict=True):
        datasets.Dataset.from_list([row]).to_parquet(str(tmp_path / "set/data" / f"{split}-00000-of-00001.parquet"))
    (tmp_path / "set/README.md").write_text("no data")
    assert chosen(tmp_path / "set", Which(split="train")) == {"a"}
    assert chosen(tmp_path / "set") == {"a", "NA"}


def test_a_mistake_is_named_with_its_file_and_row(tmp_path: Path) -> None:
    (tmp_path / "train.jsonl").write_text(json.dumps(ROWS[0]) + "\n{}\n")
    with pytest.raises(ValueError, match=r"train\.jsonl, row 2: column 'prompt' is missing"):
        read_judgements(tmp_path)


def test_a_loading_script_is_never_run(tmp_path: Path) -> None:
    (tmp_path / "x.jsonl").write_text(json.dumps(ROWS[0]))
    canary = tmp_path.parent / "canary"
    (tmp_path / f"{tmp_path.name}.py").write_text(f"open({str(canary)!r}, 'w')")
    assert chosen(tmp_path) == {"a"}
    assert not canary.exists()


@pytest.mark.parametrize("name", ["../x.arrow", "/etc/passwd", "", "a/b", 3])
def test_a_state_that_names_files_elsewhere_is_refused(tmp_path: Path, name: object) -> None:
    (tmp_path / "state.json").write_text(json.dumps({"_data_files": [{"filename": name}]}))
    with pytest.raises(ValueError, match="no name of a file beside it"):
        read_judgements(tmp_path)


def test_symbolic_links_are_refused(tmp_path: Path) -> None:
    (tmp_path / "secret").write_text(json.dumps(ROWS[0]))
    (tmp_path / "set").mkdir()
    (tmp_path / "set/x.jsonl").symlink_to(tmp_path / "secret")
    with pytest.raises(ValueError, match="is a symbolic link"):
        read_judgements(tmp_path / "set")


def test_a_folder_without_data_is_refused(tmp_path: Path, text_store: Store[Response]) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="expected a bundle, or a data set"):
        import_judgements(tmp_path / "empty", text_store)
    with pytest.raises(ValueError, match="is a store itself"):
        import_judgements(text_store.folder, text_store)
