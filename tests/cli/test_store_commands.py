import shutil
import sqlite3
from pathlib import Path

import pytest
from stores import fill
from typer.testing import CliRunner

from prefrl.cli.main import app
from prefrl.storage.log import StoreError
from prefrl.store import Store
from prefrl.types import Response


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    with Store[Response](tmp_path / "store") as store:
        fill(store)
    return tmp_path / "store"


def call(*args: object) -> tuple[int, str]:
    done = CliRunner().invoke(app, [str(a) for a in args], catch_exceptions=False)
    return done.exit_code, done.output


def test_a_whole_store_is_said_to_be_whole_and_a_copy_of_it_too(folder: Path, tmp_path: Path) -> None:
    status, said = call("verify", folder)
    assert (status, said[:18]) == (0, "whole: 105 events,")
    assert call("backup", folder, "--to", tmp_path / "copy") == (0, f"105 events copied into {tmp_path / 'copy'}\n")
    assert call("verify", tmp_path / "copy")[1] == said


def test_damage_is_named_repaired_where_it_can_be_and_what_is_whole_is_saved(folder: Path, tmp_path: Path) -> None:
    with sqlite3.connect(folder / "store.db") as connection:
        connection.execute("DELETE FROM standing")
    connection.close()
    status, said = call("verify", folder)
    assert status == 1
    assert "derived tables" in said
    assert call("verify", folder, "--repair-derived")[0] == 0
    with sqlite3.connect(folder / "store.db") as connection:
        connection.execute("DROP TRIGGER event_no_update")
        connection.execute("UPDATE event SET at = 'never' WHERE seq = 50")
    connection.close()
    status, said = call("verify", folder)
    assert status == 1
    assert "event 50" in said
    assert "whole up to event 49" in said
    assert call("verify", folder, "--salvage", tmp_path / "saved")[1].startswith("49 events saved")
    assert call("verify", tmp_path / "saved")[0] == 0


def test_an_old_store_is_brought_up_to_date(tmp_path: Path) -> None:
    shutil.copy(Path(__file__).parents[1] / "storage/data/store-1/store.db", tmp_path / "store.db")
    assert call("migrate", tmp_path)[1] == f"{tmp_path} has schema 2\n"
    assert call("verify", tmp_path)[0] == 0


@pytest.mark.parametrize("args", [(), ("--repair-derived",), ("--salvage", "saved")])
def test_what_cares_for_a_store_makes_none(tmp_path: Path, args: tuple[str, ...]) -> None:
    for command in (
        ["verify", tmp_path, *args],
        ["backup", tmp_path, "--to", tmp_path / "copy"],
        ["migrate", tmp_path],
    ):
        with pytest.raises(StoreError, match="holds no store"):
            call(*command)
        assert list(tmp_path.iterdir()) == []


def test_what_is_no_database_is_told_and_not_repaired(tmp_path: Path) -> None:
    (tmp_path / "store.db").write_bytes(b"x" * 4096)
    with pytest.raises(StoreError, match="cannot be opened"):
        call("verify", tmp_path, "--repair-derived")
    assert (tmp_path / "store.db").read_bytes() == b"x" * 4096
