"""A labelling server in a process of its own, and raw sockets to it: for tests of what reaches it over the wire.

Run as a program with a folder, it serves questions from there until its input ends.
"""

from __future__ import annotations

import json
import logging
import os
import resource
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

FILES = 1024
"""Open files that the server may have: what most systems allow."""


@dataclass
class Answered:
    """What came back over a socket."""

    status: int
    head: str
    body: bytes

    @property
    def told(self) -> Any:
        return json.loads(self.body)


@dataclass
class Child:
    """A server that runs, and the ways in that it gave."""

    process: subprocess.Popen[str]
    port: int
    cookies: dict[str, str]
    """Name -> the Cookie header of a browser that came in."""
    bearer: str
    log: Path

    @property
    def memory(self) -> int:
        """Bytes of memory in use."""
        text = Path(f"/proc/{self.process.pid}/status").read_text()
        return 1024 * next(int(line.split()[1]) for line in text.splitlines() if line.startswith("VmRSS"))

    @property
    def work(self) -> float:
        """Seconds of a processor that the server has used: unlike the time, they do not hang on what else runs."""
        fields = Path(f"/proc/{self.process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")

    def connect(self, seconds: float = 10.0) -> socket.socket:
        return socket.create_connection(("127.0.0.1", self.port), timeout=seconds)

    def head(self, line: str, who: str = "", **headers: str) -> bytes:
        """The head of a request; a header that is given as "" is left out."""
        own = {"Host": f"127.0.0.1:{self.port}", "Origin": f"http://127.0.0.1:{self.port}"}
        if who:
            own["Cookie"] = self.cookies[who]
        named = {name.replace("_", "-"): value for name, value in headers.items()}
        lines = [f"{name}: {value}" for name, value in (own | named).items() if value]
        return "\r\n".join([f"{line} HTTP/1.1", *lines, "", ""]).encode("latin-1")

    def raw(self, sent: bytes) -> Answered:
        """Send bytes over a connection of their own."""
        with self.connect() as connection:
            connection.sendall(sent)
            return receive(connection)

    def get(self, path: str, who: str = "", **headers: str) -> Answered:
        return self.raw(self.head(f"GET {path}", who, **headers))

    def post(self, path: str, body: bytes | dict[str, Any], who: str = "", **headers: str) -> Answered:
        sent = body if isinstance(body, bytes) else json.dumps(body).encode()
        told = {"Content_Type": "application/json", "Content_Length": str(len(sent))} | headers
        return self.raw(self.head(f"POST {path}", who, **told) + sent)


def receive(connection: socket.socket) -> Answered:
    """One response. Raises `ConnectionError` where none comes."""
    with connection.makefile("rb") as file:
        line = file.readline().split()
        if len(line) < 2:
            raise ConnectionError("the connection was closed without a response")
        head = b"".join(iter(file.readline, b"\r\n")).decode("latin-1")
        lengths = [int(one.split(":")[1]) for one in head.splitlines() if one.lower().startswith("content-length:")]
        return Answered(int(line[1]), head, file.read(lengths[0]) if lengths else b"")


@contextmanager
def started(folder: Path) -> Iterator[Child]:
    """Start the server in a folder, with two annotators, an admin and a trainer."""
    log = folder / "server.log"
    with log.open("w") as file:
        command = [sys.executable, __file__, str(folder)]
        process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=file, text=True)
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        line = process.stdout.readline()
        assert line, log.read_text()
        told = json.loads(line)
        child = Child(process, told["port"], {}, told["trainer"], log)
        for name in ("ann", "ben", "boss"):
            answer = child.post("/api/session", {"token": told[name]})
            assert answer.status == 200, answer
            cookie = next(x for x in answer.head.splitlines() if x.lower().startswith("set-cookie:"))
            child.cookies[name] = cookie.partition(":")[2].partition(";")[0].strip()
        yield child
    finally:
        process.stdin.close()
        process.wait(20)
        process.stdout.close()


@dataclass
class Texts:
    """A task, as far as a page needs to know it."""

    name: str = "test"
    kind: str = "text"


def serve(folder: Path) -> None:
    """Serve until the input ends; everything that can be logged is."""
    from stores import responses

    from prefrl.label.web import WebSettings, terms_of
    from prefrl.page.site import Address, open_site
    from prefrl.store import Store

    resource.setrlimit(resource.RLIMIT_NOFILE, (FILES, FILES))
    logging.basicConfig(level=logging.DEBUG)
    settings = WebSettings(port=0, name="boss", requests_per_second=1e6, check_share=0, repeat_share=0)
    with Store[Any](folder) as store:
        store.ask(responses(200))
        terms = terms_of(settings, cast(Any, Texts()), fixed=False)
        site = open_site(store, terms, Address(port=0), settings.name, clips=None)
        told: dict[str, Any] = {"port": int(site.address.rstrip("/").rpartition(":")[2])}
        told["boss"] = site.notes[0].partition("#")[2]
        for name, role in (("ann", "annotator"), ("ben", "annotator"), ("trainer", "trainer")):
            told[name], events = site.service.access.invite(name, cast(Any, role))
            site.service.append(events)
        print(json.dumps(told), flush=True)  # noqa: T201
        sys.stdin.read()
        site.close()


if __name__ == "__main__":
    serve(Path(sys.argv[1]))
