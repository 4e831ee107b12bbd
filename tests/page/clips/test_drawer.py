"""Clips are drawn once, in the order of need, and no drawing can take the server down."""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from clip_server import Start, alive, attempts, candidate, get, name, prepare, processes, starting, until
from web_service import Clock

from prefrl.page.clips.queue import ClipBusy, ClipFailed, Clips, ClipSettings


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return prepare(tmp_path)


@pytest.fixture
def start(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Start]:
    monkeypatch.setattr("prefrl.page.clips.queue.formats", lambda: ("mp4", "webm"))
    with starting(folder) as begin:
        yield begin


# --- drawn once -----------------------------------------------------------------------------------------------------


def test_a_clip_is_drawn_when_asked_for_and_only_once(folder: Path, start: Start) -> None:
    clips = start()
    path = get(clips, 1)
    assert path == folder / "clips" / path.name[:2] / path.name
    assert get(clips, 1) == path
    assert attempts(folder) == [1]
    assert clips.counts() == {"drawn": 1, "failed": 0, "cached": 1, "waiting": 0}


def test_many_who_ask_for_one_clip_share_one_drawing(folder: Path, start: Start) -> None:
    clips = start({1: ["wait"]})

    async def ask() -> list[Path]:
        asked = [asyncio.create_task(clips.get(name(clips, 1), 20)) for _ in range(20)]
        await asyncio.sleep(0.1)
        asked[0].cancel()  # the first to ask leaves: the others are served
        (folder / "go").touch()
        return await asyncio.gather(*asked[1:])

    assert len(set(asyncio.run(ask()))) == 1
    assert attempts(folder) == [1]


def test_what_takes_longer_than_one_waits_for_is_drawn_all_the_same(folder: Path, start: Start) -> None:
    clips = start({1: ["wait"]})
    with pytest.raises(ClipBusy, match="ask again"):
        get(clips, 1, wait=0.05)
    (folder / "go").touch()
    assert get(clips, 1).exists()
    assert attempts(folder) == [1]


def test_what_is_looked_at_comes_before_what_comes_soon_and_that_before_the_rest(folder: Path, start: Start) -> None:
    clips = start({0: ["wait"]})
    clips.want(candidate(0))
    until(lambda: attempts(folder) == [0])
    for number in (1, 2):
        clips.want(candidate(number))
    for number in (3, 4):
        clips.want(candidate(number), soon=True)
    with pytest.raises(ClipBusy):
        get(clips, 5, wait=0.01)
    clips.want(candidate(2), soon=True)
    assert clips.counts()["waiting"] == 6
    (folder / "go").touch()
    until(lambda: clips.counts()["waiting"] == 0)
    assert attempts(folder) == [0, 5, 2, 3, 4, 1]


def test_no_more_wait_than_may_and_people_come_before_plans(folder: Path, start: Start) -> None:
    clips = start({0: ["wait"]}, waiting=2)
    clips.want(candidate(0))
    until(lambda: attempts(folder) == [0])
    for number in (1, 2, 3):
        clips.want(candidate(number))
    for number in (4, 5, 6):
        with pytest.raises(ClipBusy):
            get(clips, number, wait=0.01)
    assert clips.counts()["waiting"] == 3
    (folder / "go").touch()
    until(lambda: clips.counts()["waiting"] == 0)
    assert attempts(folder) == [0, 4, 5]


def test_what_is_there_or_has_no_pictures_is_not_wanted_again(folder: Path, start: Start) -> None:
    clips = start()
    get(clips, 1)
    clips.want(candidate(1))
    clips.want("f" * 64)
    clips.want(candidate(2))
    until(lambda: clips.counts()["waiting"] == 0)
    assert attempts(folder) == [1, 2]


# --- failures -------------------------------------------------------------------------------------------------------


def test_a_clip_that_cannot_be_drawn_is_told_at_once_the_next_time(folder: Path, start: Start) -> None:
    clips = start({1: ["error", "draw"]})
    for _ in range(3):
        with pytest.raises(ClipFailed, match="it has no states"):
            get(clips, 1)
    clips.want(candidate(1))
    assert attempts(folder) == [1]
    assert clips.counts() == {"drawn": 0, "failed": 1, "cached": 0, "waiting": 0}
    clips.retry(candidate(1))
    assert get(clips, 1).exists()
    assert clips.counts()["failed"] == 0


def test_a_failure_that_may_pass_is_tried_again_after_a_while(
    folder: Path, start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = Clock()
    monkeypatch.setattr("prefrl.page.clips.queue.time", SimpleNamespace(monotonic=clock))
    clips = start({1: ["passing", "draw"]}, retry_seconds=30)
    for _ in range(2):
        with pytest.raises(ClipFailed):
            get(clips, 1)
    assert attempts(folder) == [1]
    clock.now += 31
    assert get(clips, 1).exists()


@pytest.mark.parametrize("what", ["crash", "garbage"])
def test_a_crash_costs_one_attempt_and_a_new_process_goes_on(what: str, folder: Path, start: Start) -> None:
    clips = start({1: [what, "draw"]})
    assert get(clips, 1).exists()
    assert get(clips, 2).exists()
    assert attempts(folder) == [1, 1, 2]
    first, second, third = processes(folder)
    assert first != second == third


def test_what_crashes_twice_has_failed_and_others_are_drawn(
    folder: Path, start: Start, caplog: pytest.LogCaptureFixture
) -> None:
    clips = start({1: ["crash"]})
    for _ in range(2):
        with pytest.raises(ClipFailed, match="crashed"):
            get(clips, 1)
    assert attempts(folder) == [1, 1]
    assert get(clips, 2).exists()
    assert "a driver gave up" in caplog.text
    assert f"no clip of candidate {candidate(1)}" in caplog.text


def test_a_hang_is_ended_with_all_that_it_started(folder: Path, start: Start) -> None:
    clips = start({1: ["hang", "draw"]}, limit_seconds=1.0)
    get(clips, 0)
    assert get(clips, 1).exists()
    assert attempts(folder) == [0, 1, 1]
    until(lambda: not alive(processes(folder)[0]))
    until(lambda: not alive(int((folder / "sleeper").read_text())))


def test_what_hangs_twice_has_failed(folder: Path, start: Start) -> None:
    clips = start({1: ["hang"]}, first_limit_seconds=2.5)
    with pytest.raises(ClipFailed, match=r"longer than 2\.5 seconds"):
        get(clips, 1)
    assert attempts(folder) == [1, 1]


def test_only_the_first_clip_of_a_process_has_the_longer_limit(folder: Path, start: Start) -> None:
    clips = start({1: ["hang", "error"]}, limit_seconds=0.5, first_limit_seconds=50)
    get(clips, 0)
    with pytest.raises(ClipFailed):  # with the longer limit it would still be drawn when we no longer wait
        get(clips, 1, wait=40)
    assert attempts(folder) == [0, 1, 1]


def test_a_clip_that_is_said_to_be_drawn_and_is_not_has_failed(start: Start) -> None:
    with pytest.raises(ClipFailed, match="cannot be read back"):
        get(start({1: ["lie"]}), 1)


def test_a_process_that_does_not_start_is_a_failure_that_may_pass(folder: Path) -> None:
    clips = Clips(folder, ClipSettings(retry_seconds=0.0), [str(folder / "no-such-program")])
    clips.start()
    with pytest.raises(ClipFailed, match="does not start"):
        get(clips, 1)
    clips.close()


def test_a_mistake_of_the_server_itself_does_not_stop_the_drawing(
    start: Start, monkeypatch: pytest.MonkeyPatch
) -> None:
    clips = start()
    with monkeypatch.context() as patch:
        patch.setattr(clips._drawer, "draw", lambda *_: 1 / 0)
        with pytest.raises(ClipFailed, match="log says why"):
            get(clips, 1)
    assert get(clips, 2).exists()


def test_a_process_is_replaced_after_so_many_clips(folder: Path, start: Start) -> None:
    clips = start(clips_per_process=2)
    for number in range(5):
        get(clips, number)
    pids = processes(folder)
    assert pids[0] == pids[1] != pids[2] == pids[3] != pids[4]
    assert not any(map(alive, pids[:4]))


def test_closing_ends_what_is_being_drawn_and_sends_who_waits_away(
    folder: Path, start: Start, caplog: pytest.LogCaptureFixture
) -> None:
    clips = start({1: ["hang"]}, first_limit_seconds=300)

    async def ask() -> None:
        asked = [asyncio.create_task(clips.get(name(clips, number), 300)) for number in (1, 2)]
        await asyncio.to_thread(until, lambda: (folder / "sleeper").exists())
        await asyncio.to_thread(clips.close)
        assert not alive(processes(folder)[0])
        for one in asked:
            with pytest.raises(ClipBusy):
                await asyncio.wait_for(one, 30)  # a tenth of what they wait for a clip, half of what the drawing takes

    asyncio.run(ask())
    assert caplog.text == ""  # to be closed is no failure
    with pytest.raises(ClipBusy):
        get(clips, 3)
    clips.close()
