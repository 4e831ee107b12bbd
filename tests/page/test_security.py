"""What is refused at the door: foreign hosts, origins and hostile bodies (F17, F19, F20, F21, F22)."""

from __future__ import annotations

import asyncio
import json
import logging
import resource
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient
from web_service import ORIGIN, answering, ask_for, browser, invite, log_in, serving

from prefrl.page.people import cookie_name
from prefrl.page.security import BODY, HEADERS, Buckets, Guard, Refused, Rules, check_host
from prefrl.page.service import Service
from prefrl.store import Store
from prefrl.types import Query, Response, Segment

HOST = ORIGIN.removeprefix("http://")
JSON = {"content-type": "application/json"}
DEEP = b'{"want":' + b"[" * 30_000 + b"]" * 30_000 + b"}"
HOSTILE = {
    "no JSON": b"want=1",
    "nothing": b"{",
    "a list": b"[1]",
    "a number": b"1",
    "null": b"null",
    "deep": DEEP,
    "deep and open": b'{"want":' + b"[" * 60_000,
    "escapes without end": b'{"a": "' + b'\\"' * 30_000,
    "NaN": b'{"want": NaN}',
    "infinity": b'{"want": -Infinity}',
    "1e400": b'{"want": 1e400}',
    "huge": b'{"want": ' + b"9" * 60_000 + b"}",
    "twice": b'{"want": 1, "want": 1}',
    "surrogate": rb'{"want": "\ud800"}',
    "surrogate key": rb'{"\udfff": 1}',
    "NUL": rb'{"want": "a\u0000b"}',
    "no UTF-8": b'{"want": "\xff"}',
    "UTF-16": '{"want": 1}'.encode("utf-16"),
    "byte order mark": b"\xef\xbb\xbf{}",
}
WRONG = ['{"want": "1"}', '{"want": 1.5}', '{"want": true}', '{"want": 0}', '{"want": 99}', '{"want": 1, "x": 1}']


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """One for all tests: whatever was sent before, it must go on working."""
    queries = [Query((Response(f"p{n}", "a"), Response(f"p{n}", "b"))) for n in range(50)]
    with Store[Response](tmp_path_factory.mktemp("store")) as store:
        store.ask(queries)
        with serving(store, "text") as opened:
            yield opened


@pytest.fixture
def ann(service: Service) -> TestClient:
    return log_in(service, "ann")


def check_failure(answer: Any, *statuses: int) -> None:
    """A failure is one sentence, and tells nothing of the inside."""
    assert answer.status_code in statuses, (answer.status_code, answer.text)
    assert set(answer.json()) == {"error"}
    assert "Traceback" not in answer.text
    assert ".py" not in answer.text


def work(call: Callable[[], object]) -> float:
    """The seconds of a processor that a call takes: the least of three, since garbage may be collected meanwhile."""
    spent = []
    for _ in range(3):
        begin = time.process_time()
        call()
        spent.append(time.process_time() - begin)
    return min(spent)


# --- F17: bodies ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_body_is_refused_at_once_and_the_next_good_one_is_taken(ann: TestClient, name: str) -> None:
    assert work(lambda: check_failure(ann.post("/api/assignments", content=HOSTILE[name], headers=JSON), 400)) < 0.1
    assert len(ask_for(ann)) == 1


@pytest.mark.parametrize("body", WRONG)
def test_values_of_the_wrong_type_or_size_are_refused(ann: TestClient, body: str) -> None:
    check_failure(ann.post("/api/assignments", content=body.encode(), headers=JSON), 422)


@pytest.mark.parametrize("path", ["answers", "undo", "flags", "heartbeat", "session", "admin/annotators"])
def test_no_address_falls_over_hostile_bodies(ann: TestClient, path: str) -> None:
    for body in HOSTILE.values():
        check_failure(ann.post(f"/api/{path}", content=body, headers=JSON), 400)
    check_failure(ann.post(f"/api/{path}", content=b"{}", headers=JSON), 422, 403)


def test_a_body_of_300_megabytes_costs_nothing(service: Service) -> None:
    sent, pieces = 0, 300 * 16
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss

    async def receive() -> dict[str, Any]:
        nonlocal sent
        sent += 1
        return {"type": "http.request", "body": b"x" * 65_536, "more_body": sent < pieces}

    status = asyncio.run(ask(service, receive, [(b"content-type", b"application/json")]))
    assert status == 413
    assert sent <= 2
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 20_000


def test_a_body_that_says_it_is_too_long_is_not_read(service: Service) -> None:
    async def receive() -> dict[str, Any]:
        raise AssertionError("the body was read")

    assert asyncio.run(ask(service, receive, [(b"content-length", str(BODY + 1).encode())])) == 413
    assert asyncio.run(ask(service, receive, [(b"content-length", b"-1")])) == 400


def test_a_body_that_never_ends_is_waited_for_only_so_long(service: Service) -> None:
    async def receive() -> dict[str, Any]:
        await asyncio.sleep(60)
        return {}

    rules = Rules(body_seconds=0.05)
    assert asyncio.run(ask(service, receive, [(b"content-type", b"application/json")], rules)) == 408


async def ask(service: Service, receive: Any, headers: list[tuple[bytes, bytes]], rules: Rules | None = None) -> int:
    """A request by hand; returns the status."""
    from prefrl.page.app import routes

    found = []

    async def send(message: Any) -> None:
        found.append(message.get("status"))

    head = [(b"host", HOST.encode()), (b"origin", ORIGIN.encode()), *headers]
    scope = {"type": "http", "method": "POST", "path": "/api/session", "headers": head, "scheme": "http"}
    await Guard(routes(service), rules or Rules())(scope, receive, send)
    return int(found[0])


@pytest.mark.parametrize(
    "kind",
    [
        "text/plain",
        "application/x-www-form-urlencoded",
        "multipart/form-data; boundary=x",
        "",
        "application/json;charset=utf-16",
    ],
)
def test_only_json_is_taken(ann: TestClient, kind: str) -> None:
    check_failure(ann.post("/api/assignments", content=b'{"want": 1}', headers={"content-type": kind}), 415)
    packed = JSON | {"content-encoding": "gzip"}
    check_failure(ann.post("/api/assignments", content=b'{"want": 1}', headers=packed), 415)


def test_a_comment_may_hold_whatever_text_there_is(ann: TestClient, service: Service) -> None:
    text = "<img src=x onerror=alert(1)> \u202e\u0301 {{7*7}} ';DROP TABLE event;-- \U0001f600 =cmd"
    body = answering(ask_for(ann)[0]["assignment_id"], comment=text)
    assert ann.post("/api/answers", json=body).status_code == 200
    assert ann.get("/api/history").json()["entries"][0]["answer"]["comment"] == text
    longer = answering(ask_for(ann)[0]["assignment_id"], comment="x" * 4001)
    check_failure(ann.post("/api/answers", json=longer), 422)


# --- F20: hosts and origins ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("evil.test", 403),
        ("127.0.0.1.evil.test", 403),
        ("127.0.0.1@evil.test", 400),
        ("evil.test:8900", 403),
        ("", 400),
        ("a b", 400),
        ("127.0.0.1:x", 400),
        ("[::1", 400),
        ("localhost.", 403),
        ("127.0.0.1/x", 400),
    ],
)
def test_a_foreign_or_malformed_host_is_refused(ann: TestClient, host: str, status: int) -> None:
    for path in ("/", "/api/me", "/healthz", "/static/app.js"):
        check_failure(ann.get(path, headers={"host": host}), status)


@pytest.mark.parametrize("host", ["localhost", "LOCALHOST:1", "[::1]:8900", "127.0.0.1"])
def test_a_host_of_this_machine_is_taken(service: Service, host: str) -> None:
    assert browser(service).get("/healthz", headers={"host": host}).status_code == 200


def test_a_missing_or_second_host_is_refused() -> None:
    for hosts in ([], [b"127.0.0.1", b"127.0.0.1"], [b"127.0.0.1", b"evil.test"]):
        with pytest.raises(Refused) as refused:
            check_host(hosts, Rules().hosts)
        assert refused.value.status == 400


@pytest.mark.parametrize(
    "origin",
    [
        "http://evil.test",
        "null",
        "https://127.0.0.1:8900.evil.test",
        "http://127.0.0.1:8901",
        "http://localhost:8900",
        "",
        "file://",
    ],
)
def test_another_site_cannot_change_anything(ann: TestClient, service: Service, origin: str) -> None:
    before = service.store.sequence
    check_failure(ann.post("/api/assignments", json={"want": 1}, headers={"origin": origin}), 403)
    check_failure(ann.delete("/api/session", headers={"origin": origin}), 403)
    assert service.store.sequence == before
    assert ann.get("/api/me").status_code == 200


def test_a_request_without_an_origin_changes_nothing(ann: TestClient, service: Service) -> None:
    del ann.headers["origin"]
    check_failure(ann.post("/api/assignments", json={"want": 1}), 403)
    assert ann.get("/api/me").status_code == 200


@pytest.mark.parametrize("site", ["cross-site", "same-site", "none"])
def test_what_a_browser_says_of_the_site_is_heeded(ann: TestClient, site: str) -> None:
    check_failure(ann.post("/api/assignments", json={"want": 1}, headers={"sec-fetch-site": site}), 403)
    assert ann.post("/api/assignments", json={"want": 1}, headers={"sec-fetch-site": "same-origin"}).status_code == 200


def test_no_other_site_is_told_that_it_may_read(ann: TestClient) -> None:
    answer = ann.options("/api/me", headers={"origin": "http://evil.test", "access-control-request-method": "GET"})
    check_failure(answer, 403)
    for path in ("/", "/api/me", "/nowhere"):
        found = ann.get(path, headers={"origin": "http://evil.test"}).headers
        assert not [name for name in found if name.startswith("access-control")]


@pytest.mark.parametrize("path", ["/", "/api/me", "/static/app.js", "/nowhere", "/healthz", "/media/x"])
def test_every_response_carries_the_protecting_headers(ann: TestClient, path: str) -> None:
    for answer in (ann.get(path), ann.get(path, headers={"host": "evil.test"})):
        there = {name.encode(): value.encode() for name, value in answer.headers.items()}
        for name, value in HEADERS.items():
            assert name in there
            assert name == b"cache-control" or there[name] == value


def test_the_protecting_headers_are_those_that_browsers_know(ann: TestClient) -> None:
    """Written out, so that none can be lost from the list that the server goes by."""
    for path in ("/", "/static/app.js", "/api/me", "/nowhere"):
        found = ann.get(path).headers
        assert found["content-security-policy"].split("; ") == [
            "default-src 'none'",
            "script-src 'self'",
            "style-src 'self'",
            "img-src 'self' data:",
            "media-src 'self'",
            "connect-src 'self'",
            "form-action 'self'",
            "base-uri 'none'",
            "frame-ancestors 'none'",
            "require-trusted-types-for 'script'",
        ]
        assert (found["x-content-type-options"], found["x-frame-options"]) == ("nosniff", "DENY")
        assert found["referrer-policy"] == "no-referrer"
        assert found["cross-origin-opener-policy"] == found["cross-origin-resource-policy"] == "same-origin"
        assert found["permissions-policy"] == "camera=(), geolocation=(), microphone=()"
        assert found["cache-control"] == ("no-cache" if path in ("/", "/static/app.js") else "no-store")


# --- F19: paths ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "name",
    [
        "../app.py",
        "..%2fapp.py",
        "%2e%2e/%2e%2e/app.py",
        "..\\app.py",
        "/etc/passwd",
        "app.js%00",
        "%00",
        "APP.JS",
        "x" * 5000,
    ],
)
def test_only_known_files_are_served(ann: TestClient, name: str) -> None:
    for folder in ("static", "media", "api/admin/export"):
        assert ann.get(f"/{folder}/{name}").status_code in (400, 403, 404), (folder, name)


class OneClip:
    """Knows one clip."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def names(self, candidate: str) -> list[str]:
        return []

    def want(self, candidate: str, soon: bool = False) -> None:
        """Nothing to draw."""

    async def get(self, name: str, wait: float) -> Path:
        return self.path

    def counts(self) -> dict[str, int]:
        return {}


def test_clips_are_for_people_who_are_logged_in_and_come_in_parts(service: Service, tmp_path: Path) -> None:
    clip = tmp_path / "clip.mp4"
    clip.write_bytes(bytes(range(256)) * 1000)
    service.clips = OneClip(clip)
    name = f"/media/{'a' * 64}.mp4"
    check_failure(browser(service).get(name), 401)
    ann = log_in(service, "ann")
    whole = ann.get(name)
    assert whole.content == clip.read_bytes()
    assert "immutable" in whole.headers["cache-control"]
    part = ann.get(name, headers={"range": "bytes=10-19"})
    assert part.status_code == 206
    assert part.content == clip.read_bytes()[10:20]
    assert ann.get(name, headers={"range": "bytes=9999999-"}).status_code == 416
    for ranges in ("bytes=" + ",".join(f"{i}-" for i in range(10_000)), "bytes=" + "0-0," * 99 + "0-0", "rows=1-2"):
        assert ann.get(name, headers={"range": ranges}).status_code in (200, 206, 400, 416)
        assert work(lambda sent={"range": ranges}: ann.get(name, headers=sent)) < 0.2  # type: ignore[misc]


# --- the rest ------------------------------------------------------------------------------------------------------


def test_huge_headers_and_websockets_are_refused(ann: TestClient) -> None:
    check_failure(ann.get("/api/me", headers={"x-large": "x" * 20_000}), 400)
    upgrade = {"connection": "upgrade", "upgrade": "websocket", "sec-websocket-version": "13"}
    check_failure(ann.get("/api/me", headers=upgrade), 400)


def test_too_many_requests_are_told_to_wait(store: Store[Segment]) -> None:
    with serving(store) as service:
        ann, ben = log_in(service, "ann"), log_in(service, "ben")
        service.requests = Buckets(10, 30, service.clock)
        statuses = [ann.get("/api/me").status_code for _ in range(40)]
        assert statuses == [200] * 30 + [429] * 10
        assert int(ann.get("/api/me").headers["retry-after"]) >= 1
        assert ben.get("/api/me").status_code == 200
        service.clock.now += 1.0  # type: ignore[attr-defined]
        assert [ann.get("/api/me").status_code for _ in range(11)] == [200] * 10 + [429]


def test_links_cannot_be_tried_out_in_a_row(service: Service) -> None:
    client, plenty = browser(service), service.logins
    service.logins = Buckets(1, 20, service.clock)
    statuses = [client.post("/api/session", json={"token": str(n)}).status_code for n in range(30)]
    service.logins = plenty
    assert statuses == [401] * 20 + [429] * 10


def test_many_people_come_in_from_one_address(service: Service) -> None:
    tokens = [invite(service, f"person {n}") for n in range(30)]
    plenty, service.logins = service.logins, Buckets(1, 20, service.clock)
    statuses = [browser(service).post("/api/session", json={"token": token}).status_code for token in tokens]
    service.logins = plenty
    assert statuses == [200] * 30


def test_what_went_wrong_inside_is_neither_told_nor_logged_with_what_was_sent(
    ann: TestClient, service: Service, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def broken(*_: object) -> Any:
        raise RuntimeError("secret text of somebody")

    monkeypatch.setattr(service.desk, "extend", broken)
    with caplog.at_level(logging.DEBUG):
        check_failure(ann.post("/api/heartbeat", json={"assignments": ["a" * 32]}), 500)
    assert "secret" not in caplog.text
    assert "RuntimeError" in caplog.text


def test_no_token_and_no_text_reaches_a_log(service: Service, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.DEBUG):
        token = invite(service, "zoe")
        client = browser(service)
        client.post("/api/session", json={"token": token})
        client.post("/api/answers", json=answering(ask_for(client)[0]["assignment_id"], comment="a private remark"))
    for secret in (token, client.cookies[cookie_name(service)], "private remark"):
        assert secret not in caplog.text


def test_a_request_that_takes_too_long_is_given_up(service: Service) -> None:
    async def slow(*_: object) -> None:
        await asyncio.sleep(60)

    found: list[Any] = []

    async def send(message: Any) -> None:
        found.append(message)

    async def receive() -> Any:
        return {"type": "http.request", "body": b"", "more_body": False}

    scope = {"type": "http", "method": "GET", "path": "/", "headers": [(b"host", HOST.encode())], "scheme": "http"}
    asyncio.run(Guard(slow, Rules(seconds=0.05))(scope, receive, send))
    assert found[0]["status"] == 503
    assert json.loads(found[1]["body"])["error"]
