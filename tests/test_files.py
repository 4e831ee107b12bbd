from pathlib import Path

import pytest

from prefrl.files import DamagedError, verify, whole_folder, write_file


def test_a_folder_appears_whole_or_not_at_all(tmp_path: Path) -> None:
    def broken() -> None:
        with whole_folder(tmp_path / "checkpoint") as work:
            write_file(work / "a", b"1")
            raise RuntimeError("power cut")

    with pytest.raises(RuntimeError):
        broken()
    assert list(tmp_path.iterdir()) == []
    with whole_folder(tmp_path / "checkpoint") as work:
        write_file(work / "deep" / "a", b"1")
    verify(tmp_path / "checkpoint")


@pytest.mark.parametrize("damage", ["change", "truncate", "remove", "no manifest"])
def test_damage_is_found(tmp_path: Path, damage: str) -> None:
    with whole_folder(tmp_path / "c") as work:
        write_file(work / "a", b"12345678")
    file = tmp_path / "c" / ("MANIFEST.json" if damage == "no manifest" else "a")
    data = file.read_bytes()
    file.unlink()
    if damage == "change":
        file.write_bytes(data[:-1] + bytes([data[-1] ^ 1]))
    if damage == "truncate":
        file.write_bytes(data[:-4])
    with pytest.raises(DamagedError):
        verify(tmp_path / "c")


def test_a_write_that_fails_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "file"
    write_file(path, b"old")

    def full(_: int) -> None:
        raise OSError("no space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="no space"):
        write_file(path, b"new")
    assert path.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [path]
