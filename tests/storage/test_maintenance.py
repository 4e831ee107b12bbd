import contextlib
import random
import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from stores import checkpoint, derived, fill, logical, responses

from prefrl.judgements import Comparison
from prefrl.storage.log import DamagedStore, StoreError
from prefrl.storage.maintenance import backup, repair_derived, salvage, verify_store
from prefrl.storage.projection import dump, rebuild
from prefrl.store import Store
from prefrl.types import Query, Response, Segment


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A closed store with some of everything, in one file."""
    with Store[Response](tmp_path / "store") as store:
        fill(store)
    return tmp_path / "store"


def execute(folder: Path, *statements: str) -> None:
    """Change a database behind the store's back."""
    connection = sqlite3.connect(folder / "store.db")
    for name in ("event_no_update", "event_no_delete"):
        connection.execute(f"DROP TRIGGER {name}")
    for statement in statements:
        connection.execute(statement)
    connection.commit()
    connection.close()


def test_derived_tables_are_the_same_bytes_when_written_again(folder: Path) -> None:
    before = derived(folder)
    with Store[Response](folder) as store:
        with store.log.transaction() as tx:
            rebuild(tx.connection)
        with store.log.reading() as connection:
            assert list(dump(connection)) == before
    assert {line.split('"')[1] for line in before} == {
        *("query", "standing", "submission", "assignment", "annotator", "token", "setting")
    }


def test_a_whole_store_verifies(folder: Path) -> None:
    found = verify_store(folder)
    assert found.ok
    assert found.events == found.whole > 50
    assert found.blobs == 36


@pytest.mark.parametrize(
    ("change", "at"),
    [
        ("UPDATE event SET body = replace(body, '0.25', '0.75') WHERE body LIKE '%0.25%'", None),
        ("UPDATE event SET actor = 'eve' WHERE seq = 70", 70),
        ("UPDATE event SET at = '2020' WHERE seq = 3", 3),
        ("DELETE FROM event WHERE seq = 40", 40),
        ("UPDATE event SET hash = (SELECT hash FROM event WHERE seq = 9) WHERE seq = 10", 10),
    ],
)
def test_a_changed_event_is_found_and_named(folder: Path, change: str, at: int | None) -> None:
    execute(folder, change)
    found = verify_store(folder)
    assert not found.ok
    assert at is None or found.whole == at - 1
    assert found.faults[0] == f"event {found.whole + 1}: its hash is not that of what it says"


def test_a_log_that_lost_its_end_is_found_and_cannot_be_written_to(folder: Path) -> None:
    execute(folder, "DELETE FROM event WHERE seq = (SELECT max(seq) FROM event)")
    assert "it was noted to end" in verify_store(folder).faults[0]
    with pytest.raises(DamagedStore, match="prefrl verify"):
        Store[Response](folder)


def test_changed_derived_tables_are_found_and_written_again(folder: Path) -> None:
    before = derived(folder)
    execute(folder, "UPDATE query SET judged = 7 WHERE seq = (SELECT min(seq) FROM query)", "DELETE FROM token")
    (fault,) = verify_store(folder).faults
    assert fault.startswith("the derived tables")
    repair_derived(folder)
    assert verify_store(folder).ok
    assert derived(folder) == before


def test_a_damaged_log_is_not_covered_up_by_a_repair(folder: Path) -> None:
    execute(folder, "UPDATE event SET actor = 'eve' WHERE seq = 70")
    with pytest.raises(StoreError, match="event 70"):
        repair_derived(folder)
    with pytest.raises(StoreError, match="event 70"):
        backup(folder, folder.parent / "copy")
    assert not (folder.parent / "copy").exists()


def test_what_is_whole_can_be_saved(folder: Path) -> None:
    execute(folder, "UPDATE event SET actor = 'eve' WHERE seq = 70")
    found = salvage(folder, folder.parent / "saved")
    assert found.whole == 69
    assert verify_store(folder.parent / "saved").ok
    with Store[Response](folder.parent / "saved") as store:
        assert store.sequence == 69
        store.answer([Comparison(responses(1)[0].id, 1.0, "new")])


def test_a_copy_is_the_same_store_and_can_be_made_while_it_is_written_to(folder: Path, tmp_path: Path) -> None:
    with Store[Response](folder) as store:
        count = backup(folder, tmp_path / "copy")
        store.answer([Comparison(responses(2)[1].id, 1.0, "late")])
        assert store.sequence == count + 1
    assert verify_store(tmp_path / "copy").events == count
    with Store[Response](folder, write=False) as one, Store[Response](tmp_path / "copy") as other:
        assert list(other.events()) == list(one.events())[:-1]
    with pytest.raises(ValueError, match="other things"):
        backup(folder, folder)


def test_a_changed_blob_is_found(tmp_path: Path) -> None:
    zeros = np.zeros((2, 1), np.float32)
    query = Query(tuple(Segment(zeros, zeros + k, str(k), 0) for k in range(2)))
    with Store[Segment](tmp_path) as store:
        store.ask([query])
    a, b = sorted((tmp_path / "blobs").rglob("*.safetensors"))
    shutil.copy(a, b)
    (fault,) = verify_store(tmp_path).faults
    assert "has changed" in fault


def test_there_must_be_a_store(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="holds no store"):
        verify_store(tmp_path)


def flips(folder: Path, count: int, seed: int) -> tuple[int, int]:
    """(bits flipped that changed what the database says, those of them that were not found)."""
    path = folder / "store.db"
    with Store[Response](folder) as store:
        checkpoint(store)
    whole, before, rng = path.read_bytes(), logical(path), random.Random(seed)
    changed = missed = 0
    for _ in range(count):
        data = bytearray(whole)
        data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        path.write_bytes(data)
        if logical(path) != before:
            changed += 1
            with contextlib.suppress(StoreError):  # what cannot be opened is found
                missed += verify_store(folder).ok
    path.write_bytes(whole)
    return changed, missed


def test_of_400_flipped_bits_all_that_change_what_is_said_are_found(folder: Path) -> None:
    changed, missed = flips(folder, 400, 0)
    assert changed > 100
    assert missed == 0


@pytest.mark.parametrize("damage", ["cut in the middle", "a page of zeros", "cut to nothing"])
def test_a_broken_file_never_brings_down_verify(folder: Path, damage: str, tmp_path: Path) -> None:
    path = folder / "store.db"
    data = bytearray(path.read_bytes())
    if damage == "a page of zeros":
        data[8 * 4096 : 9 * 4096] = bytes(4096)
    path.write_bytes(data[: {"cut in the middle": len(data) // 2, "cut to nothing": 0}.get(damage, len(data))])
    try:
        found = verify_store(folder).ok
    except StoreError:
        found = False
    assert not found


def test_a_log_in_memory_that_was_cut_off_loses_only_what_was_not_acknowledged(folder: Path) -> None:
    """A write-ahead log with garbage at its end: SQLite takes the part whose checksums are right."""
    with Store[Response](folder) as store:
        store.answer([Comparison(responses(2)[1].id, 1.0, "late")])
        for name in ("store.db", "store.db-wal"):
            shutil.copy(folder / name, folder.parent / name)
        seq = store.sequence
    crashed = folder.parent / "crashed"
    crashed.mkdir()
    shutil.copy(folder.parent / "store.db", crashed / "store.db")
    (crashed / "store.db-wal").write_bytes((folder.parent / "store.db-wal").read_bytes() + b"torn write" * 100)
    with Store[Response](crashed) as store:
        assert store.sequence == seq
    assert verify_store(crashed).ok
