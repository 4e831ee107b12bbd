"""The writer: who was told that something is stored can rely on it, and nobody waits for ever."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from prefrl.page.writer import Unavailable, Writer
from prefrl.storage.log import StoreFull, Transaction, row
from prefrl.store import Store
from prefrl.types import Segment

SOON = 40.0
"""Seconds in which everything here must have happened, on a machine that does other things too."""


@pytest.fixture
def writer(store: Store[Segment]) -> Iterator[Writer]:
    made = Writer(store.log)
    made.start()
    yield made
    made.close()


def flag(tx: Transaction, name: str) -> int:
    return tx.append(row(f"flag:{name}", "flag", "", name, {"text": "x"}))


def test_a_job_is_on_disk_when_its_future_is_resolved(writer: Writer, store: Store[Segment]) -> None:
    seq = writer.submit(lambda tx: flag(tx, "a")).result(SOON)
    assert [one["seq"] for one in store.log.since(0)] == [seq]


def test_what_waits_together_is_written_together(store: Store[Segment], monkeypatch: pytest.MonkeyPatch) -> None:
    count, plain = 0, store.log.transaction

    @contextmanager
    def counted() -> Iterator[Transaction]:
        nonlocal count
        count += 1
        with plain() as tx:
            yield tx

    monkeypatch.setattr(store.log, "transaction", counted)
    writer, gate = Writer(store.log), threading.Event()
    writer.start()
    first = writer.submit(lambda tx: gate.wait(SOON))
    later = [writer.submit(lambda tx, n=n: flag(tx, str(n))) for n in range(100)]  # type: ignore[misc]
    gate.set()
    assert first.result(SOON)
    assert len({one.result(SOON) for one in later}) == 100
    assert count <= 2
    writer.close()


def test_a_job_that_raises_fails_alone(writer: Writer, store: Store[Segment]) -> None:
    gate = threading.Event()
    writer.submit(lambda tx: gate.wait(SOON))

    def bad(tx: Transaction) -> None:
        flag(tx, "bad")
        tx.append(row("x", "flag", "", "a", {"text": float("nan")}))

    good, broken = writer.submit(lambda tx: flag(tx, "a")), writer.submit(bad)
    after = writer.submit(lambda tx: flag(tx, "b"))
    gate.set()
    assert good.result(SOON) < after.result(SOON)
    with pytest.raises(ValueError):
        broken.result(SOON)
    assert [one["actor"] for one in store.log.since(0)] == ["a", "b"]
    assert writer.alive
    assert writer.trouble == ""


def test_a_transaction_that_fails_is_told_to_all_its_jobs_and_the_next_one_works(
    writer: Writer, store: Store[Segment], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken() -> Any:
        raise RuntimeError("the disk is on fire")

    heard: list[str] = []
    with monkeypatch.context() as patch:
        patch.setattr(store.log, "transaction", broken)
        lost = writer.submit(lambda tx: flag(tx, "a"), failed=lambda: heard.append("failed"))
        with pytest.raises(Unavailable, match="try again"):
            lost.result(SOON)
    assert heard == ["failed"]
    assert "RuntimeError" in writer.trouble
    assert "fire" not in writer.trouble
    assert writer.submit(lambda tx: flag(tx, "a")).result(SOON) == 1
    assert writer.trouble == ""


def test_a_full_disk_is_told_as_such(writer: Writer, store: Store[Segment], monkeypatch: pytest.MonkeyPatch) -> None:
    def full() -> Any:
        raise StoreFull("the disk is full")

    monkeypatch.setattr(store.log, "transaction", full)
    with pytest.raises(StoreFull):
        writer.submit(lambda tx: flag(tx, "a")).result(SOON)
    assert writer.alive


def test_those_who_listen_hear_of_commits_in_their_order(writer: Writer) -> None:
    heard: list[int] = []
    futures = [writer.submit(lambda tx, n=n: flag(tx, str(n)), heard.append) for n in range(50)]  # type: ignore[misc]
    assert [one.result(SOON) for one in futures] == heard == sorted(heard)


def test_a_job_that_was_called_off_in_time_is_not_written(writer: Writer, store: Store[Segment]) -> None:
    gate, heard = threading.Event(), list[str]()
    first = writer.submit(lambda tx: gate.wait(SOON))
    off = writer.submit(lambda tx: flag(tx, "a"), failed=lambda: heard.append("failed"))
    assert off.cancel()
    gate.set()
    first.result(SOON)
    writer.submit(lambda tx: flag(tx, "b")).result(SOON)
    assert [one["actor"] for one in store.log.since(0)] == ["b"]
    assert heard == ["failed"]


def test_closing_writes_what_waits_and_then_says_no(writer: Writer, store: Store[Segment]) -> None:
    waiting = [writer.submit(lambda tx, n=n: flag(tx, str(n))) for n in range(20)]  # type: ignore[misc]
    writer.close()
    assert all(one.result(SOON) for one in waiting)
    with pytest.raises(Unavailable):
        writer.submit(lambda tx: flag(tx, "late")).result(SOON)
    assert len(list(store.log.since(0))) == 20


def test_nobody_waits_for_a_writer_that_has_died(store: Store[Segment], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(threading, "excepthook", lambda _: None)

    def dies() -> Any:
        raise SystemExit

    monkeypatch.setattr(store.log, "transaction", dies)
    writer = Writer(store.log)
    writer.start()
    with pytest.raises(Unavailable):
        writer.submit(lambda tx: flag(tx, "a")).result(SOON)
    with pytest.raises(Unavailable):
        writer.submit(lambda tx: flag(tx, "b")).result(SOON)
    assert not writer.alive
    writer.close()
