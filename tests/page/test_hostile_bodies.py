"""A real server in a process of its own, and what must not bring it down (F17, F19, F20, F21 over the wire)."""

from __future__ import annotations

import json
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from hostile_server import Answered, Child, receive, started
from web_service import answering

from prefrl.storage.maintenance import verify_store

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="reads the memory of a process from /proc")
GROWTH = 20 * 2**20
QUICK = 1.0
"""Seconds of a processor that a refusal may cost the server; it takes about 0.1."""
DEEP = b'{"want": ' + b"[" * 200_000 + b"]" * 200_000 + b"}"


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Child]:
    """One for all: whatever was sent before, it must go on working. In the end nothing was lost, and nothing told."""
    folder = tmp_path_factory.mktemp("store")
    with started(folder) as child:
        assert child.get("/api/admin/overview", "boss").status == 200  # libraries that it loads are no growth
        yield child
    assert child.process.returncode == 0
    assert verify_store(folder).ok
    told = child.log.read_text()
    assert "Traceback" not in told
    for secret in (*(cookie.partition("=")[2] for cookie in child.cookies.values()), child.bearer, "a private remark"):
        assert secret not in told


@pytest.fixture(autouse=True)
def _goes_on(server: Child) -> Iterator[None]:
    """After each test a good request is served, and the server has not grown."""
    assert server.post("/api/assignments", {"want": 1}, "ann").status == 200
    before = server.memory
    yield
    found = server.post("/api/assignments", {"want": 1}, "ann")
    assert (found.status, len(found.told["assignments"])) == (200, 1)
    assert server.memory - before < GROWTH


@contextmanager
def quick(server: Child) -> Iterator[None]:
    """What happens here costs the server little; whether somebody else keeps it from its work is not asked."""
    before = server.work
    yield
    assert server.work - before < QUICK


def held(server: Child, who: str) -> str:
    found: str = server.post("/api/assignments", {"want": 1}, who).told["assignments"][0]["assignment_id"]
    return found


def check_refused(answer: Answered, *statuses: int) -> None:
    assert answer.status in statuses, answer
    assert set(answer.told) == {"error"}
    assert b"Traceback" not in answer.body


def pour(connection: socket.socket, piece: bytes, count: int) -> int:
    """Send pieces until they are all gone or the other side has had enough; how many bytes went."""
    sent = 0
    try:
        for _ in range(count):
            connection.sendall(piece)
            sent += len(piece)
    except OSError:
        pass
    return sent


def test_300_megabytes_are_refused_by_their_length_alone(server: Child) -> None:
    with server.connect() as connection:
        head = {"Content_Type": "application/json", "Content_Length": str(300 * 2**20)}
        connection.sendall(server.head("POST /api/answers", "ann", **head))
        with quick(server):
            check_refused(receive(connection), 413)


def test_300_megabytes_that_are_sent_all_the_same_cost_no_memory(server: Child) -> None:
    before, most = server.memory, 0
    with server.connect() as connection:
        head = {"Content_Type": "application/json", "Content_Length": str(300 * 2**20)}
        connection.sendall(server.head("POST /api/answers", "ann", **head))
        for _ in range(30):
            pour(connection, b" " * 2**20, 10)
            most = max(most, server.memory)
    assert most - before < GROWTH


@pytest.mark.parametrize("framed", [True, False], ids=["chunks without end", "chunks that never begin"])
def test_a_body_without_a_length_is_counted_as_it_comes(server: Child, framed: bool) -> None:
    with server.connect() as connection:
        head = server.head("POST /api/answers", "ann", Content_Type="application/json", Transfer_Encoding="chunked")
        connection.sendall(head)
        before = server.memory
        pour(connection, b"10000\r\n" + b"x" * 2**16 + b"\r\n" if framed else b"1" * 2**16, 300)
        assert server.memory - before < GROWTH
        assert status(connection) in (0, 400, 413)


def status(connection: socket.socket) -> int:
    """Of the response, or 0 where the connection was cut off."""
    try:
        return receive(connection).status
    except OSError:
        return 0


@pytest.mark.parametrize("path", ["answers", "undo", "flags", "assignments", "session"])
def test_what_is_nested_200_000_deep_is_refused(server: Child, path: str) -> None:
    with quick(server):
        check_refused(server.post(f"/api/{path}", DEEP, "ann"), 413)
    with quick(server):
        check_refused(server.post(f"/api/{path}", DEEP[:60_000], "ann"), 400)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("comment", rb'"\ud800"'),
        ("comment", rb'"a\u0000b"'),
        ("comment", b'"\xff"'),
        ("comment", b"NaN"),
        ("touched", b"1"),
        ("outcome", b'["first"]'),
        ("flags", b'{"a": 1}'),
        ("ranking", b"[1e400]"),
        ("timings", b'{"replays": ' + b"9" * 50_000 + b"}"),
        ("timings", b'{"visible_ms": -1}'),
        ("timings", b'{"visible_ms": Infinity}'),
        ("outcome", b'"first", "outcome": "second"'),
        ("gold", b"1"),
    ],
)
def test_an_answer_with_a_bad_value_is_refused_at_once_and_not_kept(server: Child, field: str, value: bytes) -> None:
    good = {k: v for k, v in answering(held(server, "ann")).items() if k != field}
    body = json.dumps(good).encode()[:-1] + f', "{field}": '.encode() + value + b"}"
    with quick(server):
        check_refused(server.post("/api/answers", body, "ann"), 400, 422)
    assert held(server, "ann") == good["assignment_id"]


@pytest.mark.parametrize(
    "headers",
    [
        {"Content_Type": "text/plain"},
        {"Content_Type": "application/x-www-form-urlencoded"},
        {"Content_Type": ""},
        {"Content_Encoding": "gzip"},
        {"Origin": "http://evil.test"},
        {"Origin": "null"},
        {"Origin": ""},
        {"Host": "evil.test"},
        {"Host": "evil.test\r\nHost: 127.0.0.1"},
        {"Host": ""},
        {"Content_Length": "-5"},
        {"Content_Length": "2\r\nContent-Length: 3"},
        {"Content_Length": "2\r\nTransfer-Encoding: chunked"},
        {"Expect": "200-maybe", "Origin": ""},
    ],
    ids=str,
)
def test_what_a_form_of_another_site_or_a_smuggler_could_send_is_refused(
    server: Child, headers: dict[str, str]
) -> None:
    with quick(server):
        answer = server.post("/api/answers", answering(held(server, "ann")), "ann", **headers)
    assert answer.status in (400, 403, 413, 415), answer
    assert server.get("/api/me", "ann").told["progress"]["mine"] == 0


def test_what_belongs_to_somebody_else_cannot_be_touched(server: Child) -> None:
    theirs, mine = held(server, "ben"), held(server, "ann")
    sent = answering(theirs, comment="a private remark")
    check_refused(server.post("/api/answers", sent, "ann"), 409)
    assert server.post("/api/answers", sent, "ben").status == 200
    foreign = answering(mine) | {"submission_id": sent["submission_id"]}
    check_refused(server.post("/api/answers", foreign, "ann"), 409)
    check_refused(server.post("/api/answers", sent, "ann"), 409)
    undo = {"submission_id": "0" * 32, "assignment_id": theirs}
    check_refused(server.post("/api/undo", undo, "ann"), 409)
    check_refused(server.post("/api/flags", undo | {"text": "x"}, "ann"), 409)
    assert server.get("/api/me", "ben").told["progress"]["mine"] == 1


@pytest.mark.parametrize(
    "name",
    [
        "../store.db",
        "../../../../etc/passwd",
        "%2e%2e/store.db",
        "%2e%2e%2fstore.db",
        "..%5cstore.db",
        "..\\store.db",
        "%252e%252e%252fstore.db",
        "%00",
        f"{'a' * 64}.mp4%00.webm",
        f"{'a' * 64}.mp4",
        "/etc/passwd",
        "//127.0.0.1/x",
        "%ff%fe",
        "a" * 10_000,
    ],
)
def test_no_address_leads_to_a_file_that_is_not_meant(server: Child, name: str) -> None:
    ranges = "bytes=" + ",".join(f"{i}-{i}" for i in range(1500))
    for folder in ("media", "static", "api/admin/export"):
        with quick(server):
            answer = server.get(f"/{folder}/{name}", "boss", Range=ranges)
        assert answer.status in (400, 404), answer
        assert b"SQLite" not in answer.body


ADMINS: tuple[tuple[str, Any], ...] = (
    ("annotators", {"name": "eve", "role": "admin"}),
    ("annotators/ann/resume", {}),
    ("annotators/boss/revoke", {}),
    ("project", {"overlap": 9}),
    ("guideline", {"text": "x"}),
)


def test_nobody_rises_above_their_role(server: Child) -> None:
    bearer = {"Authorization": f"Bearer {server.bearer}"}
    cookie = server.cookies["ann"].partition("=")[2]
    for path, body in ADMINS:
        check_refused(server.post(f"/api/admin/{path}", body, "ann"), 403)
        check_refused(server.post(f"/api/admin/{path}", body), 401)
        check_refused(server.post(f"/api/admin/{path}", body, **bearer), 401)
    for path in ("admin/overview", "admin/export/bundle"):
        check_refused(server.get(f"/api/{path}", "ann"), 403)
        check_refused(server.get(f"/api/{path}", **bearer), 401)
    check_refused(server.post("/api/answers", answering(held(server, "ann")), **bearer), 401)
    check_refused(server.get("/api/me", **bearer), 401)
    check_refused(server.get("/api/labels", "boss"), 401)
    check_refused(server.get("/api/labels", Authorization=f"Bearer {cookie}"), 401)
    assert server.get("/api/labels", **bearer).status == 200
    assert server.get("/api/admin/overview", "boss").told["overlap"] == 1


@pytest.mark.parametrize(
    "cookie", ["prefrl=", "prefrl=x", "prefrl=" + "A" * 43, 'prefrl="\\000"', "x", "prefrl=\xe4\xff"]
)
def test_a_guessed_cookie_lets_nobody_in(server: Child, cookie: str) -> None:
    check_refused(server.get("/api/me", Cookie=cookie), 401)
    check_refused(server.get("/api/labels", Authorization=f"Bearer {cookie[7:] or 'x'}"), 401)


def test_who_is_sent_away_is_out_at_once_and_their_answers_stay(tmp_path: Path) -> None:
    with started(tmp_path) as server:
        sent = answering(held(server, "ann"))
        assert server.post("/api/answers", sent, "ann").status == 200
        waiting = answering(held(server, "ann"))
        assert server.post("/api/admin/annotators/ann/revoke", b"", "boss").status == 200
        check_refused(server.post("/api/answers", waiting, "ann"), 401)
        check_refused(server.get("/api/me", "ann"), 401)
        labels = server.get("/api/labels", Authorization=f"Bearer {server.bearer}").told["labels"]
        assert len(labels) == 1


def test_odd_requests_are_answered_or_cut_off(server: Child) -> None:
    host = f"Host: 127.0.0.1:{server.port}\r\n".encode()
    for sent in (
        b"GET / HTTP/1.0\r\n\r\n",
        b"GET http://evil.test/ HTTP/1.1\r\n" + host + b"\r\n",
        b"BREW /api/me HTTP/1.1\r\n" + host + b"\r\n",
        b"GET /\xff HTTP/1.1\r\n" + host + b"\r\n",
        b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + bytes(100) + b"\r\n\r\n",
        b"\r\n" * 1000 + b"GET\r\n\r\n",
        b"GET / HTTP/1.1\r\n" + host + b"X: a\r\n b\x00\r\n\r\n",
    ):
        with server.connect() as connection:
            connection.sendall(sent)
            assert status(connection) in (0, 400, 403, 404, 405), sent
