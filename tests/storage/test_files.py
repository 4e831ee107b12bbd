import os
from pathlib import Path

import pytest

from prefrl.storage.files import DamagedError, read_lines, verify, whole_folder, write_file


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


def watch(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, Path]]:
    """What is made durable and what gets its name, in order."""
    done: list[tuple[str, Path]] = []
    sync, replace = os.fsync, os.replace

    def fsync(handle: int) -> None:
        done.append(("sync", Path(os.readlink(f"/proc/self/fd/{handle}"))))
        sync(handle)

    def move(old: Path, new: Path) -> None:
        done.append(("to", new))
        replace(old, new)

    monkeypatch.setattr("os.fsync", fsync)
    monkeypatch.setattr("os.replace", move)
    monkeypatch.setattr("os.rename", move)
    return done


def test_a_file_is_durable_before_it_has_its_name_and_its_name_before_anybody_is_told(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    done = watch(monkeypatch)
    write_file(tmp_path / "new" / "file", b"text")
    made, (word, work), *rest = done
    assert made == ("sync", tmp_path)  # where the folder `new` is entered
    assert (word, work.parent, work.name[:6]) == ("sync", tmp_path / "new", ".file-")
    assert rest == [("to", tmp_path / "new/file"), ("sync", tmp_path / "new")]


def test_a_whole_folder_is_durable_under_its_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    done = watch(monkeypatch)
    with whole_folder(tmp_path / "c") as work:
        write_file(work / "a", b"1")
    assert ("sync", work) in done
    assert done[-2:] == [("to", tmp_path / "c"), ("sync", tmp_path)]


def fill(path: Path, text: bytes) -> None:
    with whole_folder(path) as work:
        write_file(work / "a", text)


def test_a_folder_of_ours_is_replaced_and_leaves_nothing_beside_it(tmp_path: Path) -> None:
    fill(tmp_path / "c", b"1")
    fill(tmp_path / "c", b"2")
    assert (tmp_path / "c/a").read_bytes() == b"2"
    assert [p.name for p in tmp_path.iterdir()] == ["c"]


@pytest.mark.parametrize("begun", [False, True])
def test_a_folder_with_anything_else_in_it_is_never_removed(tmp_path: Path, begun: bool) -> None:
    if begun:
        fill(tmp_path / "c", b"1")
    (tmp_path / "c").mkdir(exist_ok=True)
    (tmp_path / "c/letter.txt").write_text("dear")
    with pytest.raises(ValueError, match=r"letter\.txt"):
        fill(tmp_path / "c", b"2")
    assert (tmp_path / "c/letter.txt").read_text() == "dear"
    (tmp_path / "file").write_text("x")
    with pytest.raises(ValueError, match="is a file"):
        fill(tmp_path / "file", b"2")


def test_files_have_the_mode_that_the_user_wishes(tmp_path: Path) -> None:
    old = os.umask(0o077)
    try:
        fill(tmp_path / "c", b"1")
    finally:
        os.umask(old)
    assert (tmp_path / "c").stat().st_mode & 0o777 == 0o700
    assert (tmp_path / "c/a").stat().st_mode & 0o777 == 0o600


def test_lines_are_cut_at_line_feeds_alone(tmp_path: Path) -> None:
    (tmp_path / "f").write_bytes("\ufeffa\u2028b\u0085c\r\nd\n".encode())
    assert list(read_lines(tmp_path / "f")) == ["a\u2028b\u0085c", "d"]
