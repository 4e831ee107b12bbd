"""What the benchmarks of labelling share: a server in a process of its own, people with sessions, a small client.

python benchmarks/labelling.py FOLDER --port P [--overlap N] [--open N] [--repeats SHARE] [--rate R] [--lives]

As a program it is what `prefrl label FOLDER --serve` is, without the settings of a run and the libraries they need:
it opens the store, asks more questions until `--open` are open, and has people answer all. It prints a line of JSON
with `head`, the number of the newest event, when it has opened the store, and one with `seconds`, how long it took
from before that, when people can come. With `--lives` it does so in a new process for each line that it reads, so that
only the first one takes the time of importing; it prints `pid` first, and `ended` when that process has ended.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import socket
import sys
import time
from asyncio.subprocess import PIPE, Process
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console

from prefrl.label.web import WebSettings
from prefrl.page.access import Access
from prefrl.page.records import closed, store_id
from prefrl.store import Store
from prefrl.types import Query, Response

HOST = "127.0.0.1"
DEFAULT_RATE = 10.0
"""Requests a second that one person may make, as in `WebSettings`."""


@dataclass(frozen=True)
class Texts:
    """As much of a task as the page needs."""

    name: str = "replies"
    kind: str = "text"


# --- the store -----------------------------------------------------------------------------------------------------


def ask(store: Store[Response], count: int) -> None:
    """Ask about `count` new pairs of responses."""
    first = store.counts()["asked"]
    texts = [(f"prompt {i}", f"response {i} is short") for i in range(first, first + count)]
    store.ask([Query((Response(prompt, text), Response(prompt, f"{text}er"))) for prompt, text in texts])


def admit(folder: Path, count: int) -> list[str]:
    """Invite `count` people, and log them in; returns the cookies of their sessions."""
    access, tokens, events = Access(), [], []
    for i in range(count):
        _, invited = access.invite(f"person {i}")
        access.note(invited)
        token, session = access.session(f"person {i}")
        tokens.append(token)
        events += [*invited, *session]
    with Store[Response](folder) as store:
        store.log.append(events)
        with store.log.reading() as connection:
            name = f"prefrl-{store_id(connection)}"
    return [f"{name}={token}" for token in tokens]


# --- the server ----------------------------------------------------------------------------------------------------


def serve(folder: Path, settings: WebSettings, wanted: int) -> None:
    """Have people answer until nothing is left."""
    begin = time.perf_counter()
    with Store[Response](folder) as store:
        print(json.dumps({"head": store.sequence}), flush=True)
        with store.log.reading() as connection:
            left = store.counts()["asked"] - closed(connection, settings.overlap)
        if left < wanted:
            ask(store, wanted - left)
        labeler = settings.build(Texts())
        labeler.console = Console(quiet=True)
        labeler.open(store, fixed=True)
        try:
            print(json.dumps({"seconds": time.perf_counter() - begin}), flush=True)
            labeler.answer(store, np.random.default_rng(0))
        finally:
            labeler.close()


def live_again(life: Callable[[], None]) -> None:
    """A new process for each line of the standard input, one after the other."""
    import prefrl.page.site  # noqa: F401

    for _ in sys.stdin:
        told, tell = os.pipe()  # a life begins to speak once its number was said
        if (child := os.fork()) == 0:
            os.read(told, 1)
            life()
            os._exit(0)
        print(json.dumps({"pid": child}), flush=True)
        os.write(tell, b".")
        os.waitpid(child, 0)
        os.close(told)
        os.close(tell)
        print(json.dumps({"ended": child}), flush=True)


@dataclass
class Server:
    """A server in a process of its own. What it complains of is shown."""

    process: Process

    @classmethod
    async def start(cls, folder: Path, port: int, *options: object) -> Server:
        program = [sys.executable, str(Path(__file__)), str(folder), "--port", str(port), *map(str, options)]
        return cls(await asyncio.create_subprocess_exec(*program, stdin=PIPE, stdout=PIPE))

    async def said(self, name: str) -> Any:
        """What it says next, which is to be `name`."""
        assert self.process.stdout is not None
        line = await self.process.stdout.readline()
        if not line:
            raise RuntimeError(f"the server ended before it said {name!r}")
        return json.loads(line)[name]

    async def live(self) -> int:
        """With `--lives`: start a life; returns its process."""
        assert self.process.stdin is not None
        self.process.stdin.write(b"\n")
        return int(await self.said("pid"))

    async def end(self) -> None:
        if self.process.returncode is None:
            self.process.kill()
        await self.process.wait()


def cpu_seconds(pid: int) -> float:
    """What a process has computed so far, in seconds; 0 where that cannot be told."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    except OSError:
        return 0.0
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def free_port() -> int:
    """A port that nothing listens on."""
    with socket.create_server((HOST, 0)) as listener:
        return int(listener.getsockname()[1])


# --- the client ----------------------------------------------------------------------------------------------------


class Browser:
    """One person's connection: HTTP/1.1, kept alive, opened anew where it ended."""

    def __init__(self, port: int, cookie: str) -> None:
        self.port = port
        self._head = (
            f"Host: {HOST}:{port}\r\nOrigin: http://{HOST}:{port}\r\nCookie: {cookie}\r\n"
            "Content-Type: application/json\r\n"
        )
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        self.opened = 0
        """How often a connection was made."""

    async def post(self, path: str, body: dict[str, Any]) -> tuple[int, dict[str, Any]]:
        """Status and body of the response. Raises `ConnectionError` where there is none."""
        try:
            return await self._post(path, json.dumps(body).encode())
        except (OSError, EOFError) as error:
            self.close()
            raise ConnectionError(f"no response: {type(error).__name__}") from error

    async def connect(self) -> None:
        """Open the connection, if it is not open."""
        if self._streams is None or self._streams[0].at_eof():
            self.close()
            self._streams = await asyncio.open_connection(HOST, self.port)
            self.opened += 1

    async def _post(self, path: str, body: bytes) -> tuple[int, dict[str, Any]]:
        await self.connect()
        assert self._streams is not None
        reader, writer = self._streams
        writer.write(f"POST {path} HTTP/1.1\r\n{self._head}Content-Length: {len(body)}\r\n\r\n".encode() + body)
        head = (await reader.readuntil(b"\r\n\r\n")).decode("latin-1").lower()
        length = int(head.partition("content-length:")[2].partition("\r\n")[0] or 0)
        return int(head.split(" ", 2)[1]), json.loads(await reader.readexactly(length) or b"{}")

    def close(self) -> None:
        if self._streams is not None:
            self._streams[1].close()
            self._streams = None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--port", type=int, required=True)
    parser.add_argument("--overlap", type=int, default=1)
    parser.add_argument("--open", type=int, default=0)
    parser.add_argument("--repeats", type=float, default=0.0)
    parser.add_argument("--rate", type=float, default=DEFAULT_RATE)
    parser.add_argument("--lives", action="store_true")
    given = parser.parse_args()
    settings = WebSettings(
        host=HOST,
        port=given.port,
        overlap=given.overlap,
        check_share=0.0,
        repeat_share=given.repeats,
        requests_per_second=given.rate,
    )
    life = partial(serve, given.folder, settings, given.open)
    if given.lives:
        live_again(life)
    else:
        life()


if __name__ == "__main__":
    main()
