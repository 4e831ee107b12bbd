"""Clips have names that tell nothing, and are kept while there is room and they are whole."""

from __future__ import annotations

import asyncio
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from clip_server import BYTES, CONFIG, Start, alive, attempts, candidate, get, name, prepare, starting, until

from prefrl.page.clips import encode as encoding
from prefrl.page.clips.encode import whole
from prefrl.page.clips.queue import ClipFailed, Clips, ClipSettings, ClipUnknown
from prefrl.page.clips.shelf import Shelf
from prefrl.store import Store
from prefrl.types import Query, Segment


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return prepare(tmp_path)


@pytest.fixture
def start(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Start]:
    monkeypatch.setattr("prefrl.page.clips.queue.formats", lambda: ("mp4", "webm"))
    with starting(folder) as begin:
        yield begin


# --- names --------------------------------------------------------------------------------------------------------


def test_a_clip_keeps_its_name_over_a_restart_and_changes_it_with_the_picture(folder: Path, start: Start) -> None:
    names = start().names(candidate(1))
    assert [n.rsplit(".")[1] for n in names] == ["mp4", "webm"]
    assert candidate(1) not in names[0]
    assert start().names(candidate(1)) == names
    assert start().names(candidate(2)) != names
    (folder / "config.yaml").write_text(CONFIG.replace("33", "34"))
    assert start().names(candidate(1)) != names


def test_a_clip_named_by_an_earlier_server_is_drawn(start: Start) -> None:
    (old := start(begun=False)).close()
    assert asyncio.run(start().get(name(old, 3), 20)).name == name(old, 3)


HOSTILE = [
    "",
    "x.mp4",
    "../config.yaml",
    "..%2f..%2fconfig.yaml",
    "%2e%2e/config.yaml",
    "..\\config.yaml",
    "/etc/passwd",
    "\0.mp4",
    f"{'a' * 63}.mp4",
    f"{'a' * 65}.mp4",
    f"{'A' * 64}.mp4",
    f"{'a' * 64}.mp4\n",
    f"{'a' * 64}\0.mp4",
    f"{'a' * 64}.mp4/../../x",
    f"{'a' * 64}.html",
    f"{'a' * 64}.webp",
    f"{'a' * 64}",
    "\u0661" * 64 + ".mp4",
    f"{'a' * 64}.mp4",
]


@pytest.mark.parametrize("hostile", HOSTILE)
def test_a_name_that_the_server_did_not_make_is_unknown_and_draws_nothing(
    hostile: str, folder: Path, start: Start
) -> None:
    with pytest.raises(ClipUnknown):
        asyncio.run(start().get(hostile, 5))
    assert attempts(folder) == []


def test_a_name_in_capitals_is_unknown(start: Start) -> None:
    clips = start()
    digits, suffix = name(clips, 1).split(".")
    with pytest.raises(ClipUnknown):
        asyncio.run(clips.get(f"{digits.upper()}.{suffix}", 5))


# --- the cache ------------------------------------------------------------------------------------------------------


def test_the_least_lately_used_clip_goes_first_and_can_be_drawn_again(folder: Path, start: Start) -> None:
    clips = start(cache_bytes=2 * BYTES)
    first, second = get(clips, 1), get(clips, 2)
    get(clips, 1)
    third = get(clips, 3)
    assert [path.exists() for path in (first, second, third)] == [True, False, True]
    assert clips.counts()["cached"] == 2
    assert get(clips, 2).exists()
    assert attempts(folder) == [1, 2, 3, 2]


def test_one_clip_is_kept_however_small_the_cache(start: Start) -> None:
    clips = start(cache_bytes=1)
    assert get(clips, 1).exists()
    assert get(clips, 2).exists()
    assert clips.counts()["cached"] == 1


@pytest.mark.parametrize("harm", ["vanished", "torn", "emptied", "replaced by a link", "replaced by a folder's link"])
def test_what_is_no_longer_whole_is_drawn_again(harm: str, folder: Path, start: Start) -> None:
    clips = start()
    path = get(clips, 1)
    secret = folder / "secret.mp4"
    secret.write_bytes(path.read_bytes())
    match harm:
        case "vanished":
            path.unlink()
        case "torn":
            path.write_bytes(path.read_bytes()[:-3])
        case "emptied":
            path.write_bytes(b"")
        case "replaced by a link":
            path.unlink()
            path.symlink_to(secret)
        case _:
            path.parent.rename(folder / "elsewhere")
            path.parent.symlink_to(folder / "elsewhere")
    if harm.startswith("replaced"):
        with pytest.raises(ClipFailed, match="read back"):  # the fake writes through links; the real one does not
            get(clips, 1)
    else:
        assert whole(get(clips, 1))
    assert attempts(folder) == [1, 1]
    assert whole(secret)


def test_a_restart_finds_the_clips_and_removes_what_was_not_finished(folder: Path, start: Start) -> None:
    paths = [get(start(), number) for number in (1, 2, 3)]
    for age, path in enumerate(paths):
        os.utime(path, (1e9 - age, 1e9 - age))
    unfinished = paths[0].with_name(f".{paths[0].name}-{'a' * 12}")
    strangers = [paths[0].with_name(".notes"), folder / "clips" / "x.mp4", folder / "clips" / "zz" / paths[0].name]
    outside = folder / "outside"
    outside.mkdir()
    for path in (unfinished, *strangers, outside / f"ee{paths[0].name[2:]}"):
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(bytes(1000))
    (folder / "clips" / "ee").symlink_to(outside)
    (folder / "attempts").unlink()

    clips = start(cache_bytes=2 * BYTES)
    until(lambda: not unfinished.exists() and clips.counts()["cached"] == 2)
    assert [path.exists() for path in paths] == [True, True, False]
    assert all(path.exists() for path in strangers)
    assert len(list(outside.iterdir())) == 1
    get(clips, 1)
    assert attempts(folder) == []


def test_a_clip_used_before_the_stock_is_taken_counts_as_the_newest(folder: Path) -> None:
    (folder / "clips").mkdir()
    shelf = Shelf(folder / "clips", 2 * BYTES)
    paths = []
    for k in range(3):
        paths.append(folder / "clips" / f"a{k}" / f"a{k}{'0' * 62}.mp4")
        paths[-1].parent.mkdir()
        boxes = ((b"ftyp", 8), (b"moov", 8), (b"mdat", 9))
        paths[-1].write_bytes(b"".join(n.to_bytes(4, "big") + kind + bytes(n - 8) for kind, n in boxes))
        os.utime(paths[-1], (1e9 + k, 1e9 + k))
    shelf.find(paths[0].name)
    shelf.scan()
    assert [path.exists() for path in paths] == [True, False, True]
    assert len(shelf) == 2


# --- with the real process -------------------------------------------------------------------------------------------


@pytest.fixture
def run(tmp_path: Path) -> tuple[Path, Query[Segment]]:
    """A run of the toy task, with a query."""
    (tmp_path / "config.yaml").write_text(CONFIG)
    states = np.random.default_rng(0).uniform(-1, 1, (2, 5, 2))
    zeros = np.zeros((5, 2), np.float32)
    query = Query(tuple(Segment(zeros, zeros, f"e{k}", 0, x) for k, x in enumerate(states)))
    with Store[Segment](tmp_path) as store:
        store.ask([query])
    return tmp_path, query


def test_a_query_is_drawn_beside_an_open_store_in_each_format_that_is_asked_for(
    run: tuple[Path, Query[Segment]],
) -> None:
    folder, query = run
    clips = Clips(folder, ClipSettings())
    clips.start()
    first, second = ([n.removeprefix("/media/") for n in clips.names(c.id)] for c in query.candidates)
    with Store[Segment](folder):
        drawn = [asyncio.run(clips.get(n, 60)) for n in first]
        assert all(map(whole, drawn))
        assert [path.suffix.removeprefix(".") for path in drawn] == list(encoding.formats())
        clips.want(query.candidates[1].id)
        until(lambda: clips.counts()["waiting"] == 0, 60)
        assert (folder / "clips" / second[-1][:2] / second[-1]).exists()  # in the format that was asked for last
    pid = clips._drawer.pid
    assert pid is not None
    assert alive(pid)
    clips.close()
    assert not alive(pid)


def test_a_killed_server_leaves_no_process_behind(run: tuple[Path, Query[Segment]]) -> None:
    folder, query = run
    code = (
        "import asyncio, os, sys; from pathlib import Path; from prefrl.page.clips.queue import Clips, ClipSettings\n"
        "clips = Clips(Path(sys.argv[1]), ClipSettings()); clips.start()\n"
        "asyncio.run(clips.get(clips.names(sys.argv[2])[0].removeprefix('/media/'), 60))\n"
        "sys.stdout.write(str(clips._drawer.pid)); sys.stdout.flush(); os.kill(os.getpid(), 9)"
    )
    command = [sys.executable, "-c", code, str(folder), query.candidates[0].id]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=120)
    assert done.returncode == -9, done.stderr
    until(lambda: not alive(int(done.stdout)))
