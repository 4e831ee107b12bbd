"""Long downloads: who reads slowly gets all of it, who does not read at all is cut off."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import pytest

from prefrl.page.security import Guard, Rules
from prefrl.page.serve import WebServer

SECONDS = 1.5
"""In which each part must be read."""
PART, PARTS = 64 * 1024, 160
HEAD = b"GET / HTTP/1.1\r\nHost: 127.0.0.1\r\nConnection: close\r\n\r\n"


class Large:
    """An application that sends ten megabytes, as a file is sent."""

    def __init__(self) -> None:
        self.ended = threading.Event()
        """All is sent, or given up."""

    async def __call__(self, scope: Any, receive: Any, send: Any) -> None:
        length = str(PART * PARTS).encode()
        try:
            await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", length)]})
            for number in range(PARTS):
                await send({"type": "http.response.body", "body": b"x" * PART, "more_body": number < PARTS - 1})
        finally:
            self.ended.set()


@pytest.fixture
def large() -> Large:
    return Large()


@pytest.fixture
def download(large: Large) -> Iterator[socket.socket]:
    """A connection that has asked for it, and holds little in between."""
    server = WebServer(Guard(large, Rules(seconds=SECONDS)))
    port = server.start("127.0.0.1", 0)
    with socket.socket() as connection:
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 64 * 1024)
        connection.settimeout(20)
        connection.connect(("127.0.0.1", port))
        connection.sendall(HEAD)
        yield connection
    server.stop()


def read(connection: socket.socket, pause: float) -> int:
    """Read to the end, in steps of a part; the bytes of the body."""
    head, body = b"", 0
    while b"\r\n\r\n" not in head:
        head += connection.recv(100)
    body = len(head.partition(b"\r\n\r\n")[2])
    while some := connection.recv(PART):
        body += len(some)
        time.sleep(pause * len(some) / PART)
    return body


def test_a_download_may_take_longer_than_an_answer(download: socket.socket) -> None:
    assert read(download, 2.5 * SECONDS / PARTS) == PART * PARTS


def test_who_does_not_read_is_cut_off(download: socket.socket, large: Large) -> None:
    assert large.ended.wait(20 * SECONDS)
    with suppress(ConnectionResetError):
        assert read(download, 0.0) < PART * PARTS
