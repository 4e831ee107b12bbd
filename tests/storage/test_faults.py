"""Writes that fail at the worst moment: what was acknowledged is there afterwards, and the store can be opened."""

from __future__ import annotations

import os
import re
import resource
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from stores import checkpoint, responses

from prefrl.judgements import Comparison
from prefrl.storage.files import write_file
from prefrl.storage.maintenance import verify_store
from prefrl.store import Store
from prefrl.types import Response

WRITER = """
import resource, signal, sys
from pathlib import Path
from prefrl.store import Store
from prefrl.judgements import Comparison
from prefrl.types import Query, Response

signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
queries = [Query((Response(f"p{i}", "a"), Response(f"p{i}", "b" * 300))) for i in range(40)]
store = Store(Path(sys.argv[1]))
try:
    for number, query in enumerate(queries):
        store.ask([query])
        store.answer([Comparison(query.id, 1.0, "me")])
        print("acknowledged", query.id, flush=True)
except Exception as error:
    print("failed", type(error).__name__, str(error)[:80], flush=True)
"""


def acknowledged(output: str) -> set[str]:
    return set(re.findall("acknowledged ([0-9a-f]{64})", output))


def check(folder: Path, output: str) -> None:
    """Every acknowledged answer is there, the store is whole, and it can be written to again."""
    if not (folder / "store.db").exists():
        assert not acknowledged(output)
        return
    with Store[Response](folder) as store:
        assert acknowledged(output) <= {a.query for a in store.answers()}
    assert verify_store(folder).ok


def run(folder: Path, *before: str, limit: int | None = None) -> str:
    def limited() -> None:
        if limit is not None:
            resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limit))

    command = [*before, sys.executable, "-c", WRITER, str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, preexec_fn=limited)
    assert "Traceback" not in done.stderr or "StoreError" in done.stderr or "OSError" in done.stderr, done.stderr
    return done.stdout


@pytest.mark.slow
@pytest.mark.parametrize("limit", [0, 4096, 40_000, 100_000, 131_072, 135_000, 200_000, 300_000, 500_000, 800_000])
def test_a_file_that_cannot_grow_loses_nothing_that_was_acknowledged(tmp_path: Path, limit: int) -> None:
    output = run(tmp_path / "store", limit=limit)
    check(tmp_path / "store", output)
    if limit >= 800_000:
        assert acknowledged(output)


def can_trace() -> bool:
    """strace needs a permission that not every machine gives."""
    if shutil.which("strace") is None:
        return False
    return (
        subprocess.run(["strace", "-qq", "-e", "trace=none", "true"], capture_output=True, check=False).returncode == 0
    )


traced = pytest.mark.skipif(not can_trace(), reason="needs strace: apt-get install -y strace")


@pytest.mark.slow
@traced
@pytest.mark.parametrize("call", ["pwrite64", "fdatasync", "fsync", "ftruncate", "rename"])
@pytest.mark.parametrize("error", ["EIO", "ENOSPC"])
def test_the_nth_call_that_fails_loses_nothing_that_was_acknowledged(tmp_path: Path, call: str, error: str) -> None:
    for number in (2, 7, 61):
        folder = tmp_path / str(number)
        inject = f"inject={call}:error={error}:when={number}"
        check(folder, run(folder, "strace", "-f", "-qq", "-o", "/dev/null", "-e", f"trace={call}", "-e", inject))


@pytest.mark.slow
@traced
def test_every_acknowledgement_comes_after_the_log_was_synchronised(tmp_path: Path) -> None:
    trace = tmp_path / "trace"
    strace = ["strace", "-f", "-y", "-qq", "-o", str(trace), "-e", "trace=pwrite64,write,fsync,fdatasync"]
    output = run(tmp_path / "store", *strace)
    assert len(acknowledged(output)) == 40
    dirty, seen = False, 0
    for line in trace.read_text(errors="replace").splitlines():
        if "store.db-wal>" in line:
            dirty = "sync(" not in line
        if "acknowledged" in line and "write(1" in line:
            seen += 1
            assert not dirty, line
    assert seen == 40


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 12 MB; only root may make one."""
    mount = tmp_path / "small"
    mount.mkdir()
    made = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=12m", "none", str(mount)], capture_output=True, check=False
    )
    if made.returncode:
        pytest.skip("needs the right to mount a file system")
    yield mount
    subprocess.run(["umount", "-l", str(mount)], check=True)


def test_a_full_disk_keeps_what_was_acknowledged_and_takes_more_once_there_is_room(small_disk: Path) -> None:
    filler = small_disk / "filler"
    filler.write_bytes(bytes(11_000_000))
    output = run(small_disk / "store")
    assert "failed StoreFull" in output
    assert 0 < len(acknowledged(output)) < 40
    with Store[Response](small_disk / "store", write=False) as store:
        assert acknowledged(output) <= {a.query for a in store.answers()}
    filler.unlink()
    again = run(small_disk / "store")
    assert len(acknowledged(again)) == 40
    check(small_disk / "store", again)


@pytest.mark.parametrize("damage", ["missing", "zeros", "noise"])
def test_a_lost_write_ahead_log_is_noticed_or_harmless(tmp_path: Path, damage: str) -> None:
    """The newest answers lie in the WAL alone. Without it the store is an older one, whole in itself."""
    folder, crashed = tmp_path / "store", tmp_path / "crashed"
    crashed.mkdir()
    with Store[Response](folder) as store:
        store.ask(responses(3))
        checkpoint(store)
        store.answer([Comparison(query.id, 1.0) for query in responses(3)])
        for name in ("store.db", "store.db-wal"):
            shutil.copy(folder / name, crashed / name)
    wal = crashed / "store.db-wal"
    size = wal.stat().st_size
    wal.unlink() if damage == "missing" else wal.write_bytes(bytes(size) if damage == "zeros" else os.urandom(size))
    assert verify_store(crashed).ok
    with Store[Response](crashed) as store:
        assert store.counts() == {"asked": 3, "answered": 0, "skipped": 0}
        store.answer([Comparison(query.id, 1.0) for query in responses(3)])
    assert verify_store(crashed).ok


@pytest.mark.parametrize("name", ["open", "fsync", "replace", "fdopen"])
@pytest.mark.parametrize("number", [1, 2])
def test_a_file_is_written_whole_or_not_at_all_whichever_call_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str, number: int
) -> None:
    path, calls, real = tmp_path / "file", [0], getattr(os, name)
    write_file(path, b"old")

    def failing(*args: object, **kwargs: object) -> object:
        calls[0] += 1
        if calls[0] == number:
            raise OSError(5, "input/output error")
        return real(*args, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(os, name, failing)
        try:
            write_file(path, b"new and longer")
        except OSError:
            assert path.read_bytes() in (b"old", b"new and longer")
    assert path.read_bytes() in (b"old", b"new and longer")
    assert [p.name for p in tmp_path.iterdir()] == ["file"]
