"""Clients that are slow, silent or many take nothing from those who work (F22)."""

from __future__ import annotations

import socket
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack

import pytest
from clip_server import until
from hostile_server import Child, receive, started
from web_service import answering

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads the memory of a process from /proc")
GROWTH = 40 * 2**20


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Child]:
    with started(tmp_path_factory.mktemp("store")) as child:
        yield child


def work(server: Child, count: int = 5) -> float:
    """Somebody answers questions, each over connections of their own: the seconds of a processor that it took.

    Who is held up until the silent are shown out (20 s) fails: a connection waits for its answer half as long.
    """
    before = server.work
    for _ in range(count):
        found = server.post("/api/assignments", {"want": 1}, "ann")
        assert found.status == 200, found
        sent = answering(found.told["assignments"][0]["assignment_id"])
        assert server.post("/api/answers", sent, "ann").status == 200
    return server.work - before


def crowd(server: Child, stack: ExitStack, count: int, begin: bytes = b"") -> list[socket.socket]:
    """Connections on which this much of a request is sent."""
    made = []
    for _ in range(count):
        made.append(stack.enter_context(server.connect()))
        if begin:
            made[-1].sendall(begin)
    return made


def alive(connection: socket.socket) -> bool:
    """Whether the other side still holds a connection."""
    connection.setblocking(False)
    try:
        return connection.recv(1) != b""
    except BlockingIOError:
        return True
    except OSError:
        return False


@pytest.mark.parametrize("part", ["a head", "a line", "a body"])
def test_200_requests_that_never_end_hold_nobody_up(server: Child, part: str) -> None:
    begun = {
        "a line": b"GET /ap",
        "a head": server.head("GET /api/me")[:-4] + b"\r\nX: ",
        "a body": server.head("POST /api/answers", Content_Type="application/json", Content_Length="60000") + b"{",
    }[part]
    before = server.memory
    with ExitStack() as stack:
        slow = crowd(server, stack, 200, begun)
        for _ in range(3):
            for one in slow:
                one.sendall(b" ")
            assert work(server, 2) < 3.0
        assert server.memory - before < GROWTH


def test_2000_connections_that_say_nothing_hold_nobody_up(server: Child) -> None:
    before = server.memory
    with ExitStack() as stack:
        silent = crowd(server, stack, 2000)
        assert work(server) < 3.0
        until(lambda: sum(map(alive, silent)) <= 510)
        assert server.memory - before < GROWTH
        assert work(server) < 3.0


def test_connections_that_are_kept_by_people_at_work_stay_when_others_crowd_in(server: Child) -> None:
    request = server.head("GET /api/me", "ann")
    with ExitStack() as stack:
        crowd(server, stack, 450)
        kept = stack.enter_context(server.connect())
        kept.sendall(request)
        assert receive(kept).status == 200
        crowd(server, stack, 300)
        kept.sendall(request)
        assert receive(kept).status == 200


def test_who_does_not_read_what_was_asked_for_costs_no_memory(server: Child) -> None:
    before = server.memory
    page = server.head("GET /static/app.js") * 50
    with ExitStack() as stack:
        for one in crowd(server, stack, 50):
            one.settimeout(0.2)
            try:
                one.sendall(page)
            except OSError:
                continue
        assert work(server) < 3.0
        assert server.memory - before < GROWTH


@pytest.mark.parametrize("size", [20_000, 60_000, 200_000, 20_000_000])
def test_huge_heads_are_refused(server: Child, size: int) -> None:
    before = server.memory
    with server.connect() as connection:
        try:
            connection.sendall(server.head("GET /api/me", "ann", X="x" * size))
            status = receive(connection).status
        except OSError:
            status = 0
    assert status in (0, 400, 431)
    assert server.memory - before < GROWTH
    assert work(server, 1) < 3.0


def test_many_headers_are_refused(server: Child) -> None:
    head = server.head("GET /api/me", "ann")[:-2] + b"".join(b"X-%d: y\r\n" % i for i in range(3000)) + b"\r\n"
    assert server.raw(head).status == 400


def test_a_websocket_is_refused_and_the_page_is_served(server: Child) -> None:
    upgrade = {"Connection": "Upgrade", "Upgrade": "websocket", "Sec_WebSocket_Version": "13"}
    answer = server.get("/api/state", "ann", Sec_WebSocket_Key="dGhlIHNhbXBsZSBub25jZQ==", **upgrade)
    assert answer.status == 400
    assert answer.told["error"]
    assert server.get("/").status == 200


@pytest.mark.slow
def test_silent_and_slow_connections_are_closed_in_the_end(server: Child) -> None:
    with ExitStack() as stack:
        slow = crowd(server, stack, 20, b"GET / HTTP/1.1\r\nX: ")
        slow += crowd(server, stack, 20)
        until(lambda: not any([drip(one) for one in slow[:20]] + [alive(one) for one in slow]), 120)


def drip(connection: socket.socket) -> bool:
    """Send a little more, now and then; whether the other side still takes it."""
    time.sleep(0.05)
    try:
        connection.sendall(b"x")
    except OSError:
        return False
    return alive(connection)
