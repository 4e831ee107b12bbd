"""What is refused before anything else looks at it: foreign hosts and origins, big or odd bodies, slow clients.

One ASGI middleware around the whole application. It also puts the protecting headers on every response, and turns
whatever went wrong inside into one sentence.
"""

from __future__ import annotations

import asyncio
import json
import logging
import re
import traceback
from collections import OrderedDict
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from starlette.types import ASGIApp, Message, Receive, Scope, Send

from prefrl.page.strict import NotStrict, check_json

BODY = 64 * 1024
"""Bytes of a request's body."""
LARGER = {("PUT", "/api/queries"): 256 * 1024}
"""Of requests that hold many texts."""
HEAD = 16 * 1024
"""Bytes of a request's headers together."""
SAFE = ("GET", "HEAD")
LOOPBACK = ("127.0.0.1", "localhost", "[::1]")
POLICY = (
    # Nothing from elsewhere and no script inside a page, so that a text to be judged can never run as one.
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data:; media-src 'self'; "
    "connect-src 'self'; form-action 'self'; base-uri 'none'; frame-ancestors 'none'; "
    "require-trusted-types-for 'script'"
)
HEADERS = {
    b"content-security-policy": POLICY.encode(),
    b"x-content-type-options": b"nosniff",  # no guessing: a text stays a text
    b"referrer-policy": b"no-referrer",  # other sites do not learn where people came from
    b"x-frame-options": b"DENY",  # as frame-ancestors: nobody clicks unawares through a frame of another site
    b"cross-origin-opener-policy": b"same-origin",  # a page that opened this one gets no hold of its window
    b"cross-origin-resource-policy": b"same-origin",  # clips cannot be embedded elsewhere
    b"permissions-policy": b"camera=(), geolocation=(), microphone=()",  # nothing here films or listens
    b"cache-control": b"no-store",  # on a shared machine the next person finds nothing
}
"""On every response; what a response says itself stands."""
log = logging.getLogger(__name__)


class Refused(Exception):
    """A request that is not looked at any further."""

    def __init__(self, status: int, error: str, retry_after: float | None = None) -> None:
        super().__init__(error)
        self.status, self.error, self.retry_after = status, error, retry_after


@dataclass(frozen=True)
class Rules:
    """Who may speak to the server, and how much."""

    hosts: frozenset[str] = frozenset(LOOPBACK)
    """Names in the Host header, lower case, without a port."""
    body_seconds: float = 15.0
    """In which a body must have come."""
    seconds: float = 60.0
    """In which a request must be answered, and then each part of the response be read."""


class Guard:
    """The middleware."""

    def __init__(self, app: ASGIApp, rules: Rules) -> None:
        self.app, self.rules = app, rules

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "websocket":
            await send({"type": "websocket.close", "code": 1008})
            return
        if scope["type"] != "http":
            await self.app(scope, receive, send)
            return
        answer = _Answer(send)
        try:
            check_head(scope, self.rules)
            # Read to its end before the application sees it: nothing inside has to wait for a slow client.
            body = await self._body(scope, receive)
            async with asyncio.timeout(self.rules.seconds) as timer:
                await self.app(scope, _replay(body, receive), self._in_time(timer, answer.send))
        except Refused as error:
            await answer.refuse(error)
        except TimeoutError:
            await answer.refuse(Refused(503, "this took too long: try again in a moment", retry_after=5))
        except Exception as error:
            log.error("%s", _where(error, scope))
            await answer.refuse(Refused(500, "something went wrong on the server; what was acknowledged is safe"))

    def _in_time(self, timer: asyncio.Timeout, send: Send) -> Send:
        """Give the client as long again for each part of a response: a long download is not a slow answer."""

        async def send_part(message: Message) -> None:
            timer.reschedule(asyncio.get_running_loop().time() + self.rules.seconds)
            await send(message)

        return send_part

    async def _body(self, scope: Scope, receive: Receive) -> bytes | None:
        """The whole body of a request that may change something, or None for one that may not."""
        if scope["method"] in SAFE:
            return None
        headers = _headers(scope)
        length = headers.get(b"content-length", b"0")
        if b"content-length" in headers and b"transfer-encoding" in headers:  # a proxy may believe the other one
            raise Refused(400, "a body has a Content-Length or a Transfer-Encoding, not both")
        if not length.isdigit() or len(length) > 12:  # int() raises at thousands of digits
            raise Refused(400, "the header Content-Length is no number")
        most = LARGER.get((scope["method"], scope["path"]), BODY)
        if int(length) > most:
            raise Refused(413, f"a request may have {most} bytes, got {int(length)}")
        try:
            async with asyncio.timeout(self.rules.body_seconds):
                body = await _read(receive, most)
        except TimeoutError:
            raise Refused(408, "the request did not come to its end in time") from None
        if body:
            check_content_type(headers)
            try:
                check_json(body)
            except NotStrict as error:
                raise Refused(400, str(error)) from None
        return body


def check_head(scope: Scope, rules: Rules) -> None:
    """Raise `Refused` for what the headers alone give away."""
    if sum(len(name) + len(value) + 4 for name, value in scope["headers"]) > HEAD:
        raise Refused(400, f"the headers are larger than {HEAD} bytes")
    headers = _headers(scope)
    host = check_host([value for name, value in scope["headers"] if name == b"host"], rules.hosts)
    if headers.get(b"upgrade", b"").lower().startswith(b"websocket"):
        raise Refused(400, "this server speaks no websockets")
    if scope["method"] not in SAFE:
        check_origin(headers, host, scope.get("scheme", "http"))


def check_host(found: list[bytes], hosts: frozenset[str]) -> str:
    """The Host header, if there is one and it names this server; a rebound DNS name does not."""
    if len(found) != 1:
        raise Refused(400, f"a request needs one Host header, got {len(found)}")
    host = found[0].decode("latin-1").lower()
    match = re.fullmatch(r"(\[[0-9a-f:.]+\]|[a-z0-9._-]+)(:\d{1,5})?", host)
    if match is None:
        raise Refused(400, "the Host header is malformed")
    if match[1] not in hosts:
        raise Refused(403, f"this server does not go by the name {match[1]}; allow it with labeler.allowed_hosts")
    return host


def check_origin(headers: dict[bytes, bytes], host: str, scheme: str) -> None:
    """Raise `Refused` unless a request that may change something comes from a page of this server itself."""
    if headers.get(b"sec-fetch-site", b"same-origin") != b"same-origin":
        raise Refused(403, "requests from other sites are refused")
    origin = headers.get(b"origin")
    if origin is None:
        if headers.get(b"authorization", b"")[:7].lower() == b"bearer ":  # no browser adds that by itself
            return
        raise Refused(403, "a request that changes something needs the header Origin")
    # https is right as well: a proxy in front may have unwrapped it.
    if origin.decode("latin-1").lower() not in (f"{scheme}://{host}", f"https://{host}"):
        raise Refused(403, "requests from other sites are refused")


def check_content_type(headers: dict[bytes, bytes]) -> None:
    """Raise `Refused` unless a body says that it is JSON: forms, which other sites can send, do not."""
    kind, _, parameter = headers.get(b"content-type", b"").lower().partition(b";")
    if kind.strip() != b"application/json" or parameter.strip() not in (b"", b"charset=utf-8"):
        raise Refused(415, "expected a body of Content-Type application/json")
    if headers.get(b"content-encoding", b"identity") != b"identity":
        raise Refused(415, "a body must not be compressed")


class Buckets:
    """How often each key may do something: `rate` a second, and `burst` at once (a token bucket each)."""

    def __init__(self, rate: float, burst: float, clock: Callable[[], float]) -> None:
        self.rate, self.burst, self._clock = rate, burst, clock
        self._levels: OrderedDict[str, tuple[float, float]] = OrderedDict()

    def take(self, key: str) -> None:
        """Raise `Refused` with the seconds to wait where the key's bucket is empty."""
        now = self._clock()
        # Taken out, and put back at the end: the order is that of use.
        level, since = self._levels.pop(key, (self.burst, now))
        level = min(self.burst, level + (now - since) * self.rate)
        self._levels[key] = (max(level - 1, 0.0) if level >= 1 else level, now)
        if len(self._levels) > 10_000:  # the longest unused one is surely full again
            self._levels.popitem(last=False)
        if level < 1:
            raise Refused(429, "too many requests: slow down a little", retry_after=(1 - level) / self.rate)

    def give_back(self, key: str) -> None:
        """What was taken last was no trespass after all."""
        level, since = self._levels[key]
        self._levels[key] = min(self.burst, level + 1), since


class _Answer:
    """A response on its way out."""

    def __init__(self, send: Send) -> None:
        self._send, self._begun = send, False

    async def send(self, message: Message) -> None:
        if message["type"] == "http.response.start":
            self._begun = True
            there = {name.lower() for name, _ in message.get("headers", [])}
            extra = [(name, value) for name, value in HEADERS.items() if name not in there]
            message = {**message, "headers": [*message.get("headers", []), *extra]}
        await self._send(message)

    async def refuse(self, why: Refused) -> None:
        if self._begun:  # too late to say anything: the connection is cut where the response breaks off
            return
        body = json.dumps({"error": why.error}).encode()
        headers = [(b"content-type", b"application/json"), (b"content-length", str(len(body)).encode())]
        if why.retry_after is not None:
            headers.append((b"retry-after", str(max(1, round(why.retry_after))).encode()))
        await self.send({"type": "http.response.start", "status": why.status, "headers": headers})
        await self.send({"type": "http.response.body", "body": body})


def _headers(scope: Scope) -> dict[bytes, bytes]:
    """Names in lower case; of a header that comes twice the two values joined, which then fits nothing."""
    found: dict[bytes, bytes] = {}
    for name, value in scope["headers"]:
        found[name] = found[name] + b", " + value if name in found else value
    return found


async def _read(receive: Receive, most: int) -> bytes:
    """A body, counted as it comes: what a header says of its length proves nothing."""
    body = bytearray()
    while True:
        message = await receive()
        if message["type"] == "http.disconnect":
            raise Refused(400, "the connection was closed before the request came to its end")
        body += message.get("body", b"")
        if len(body) > most:
            raise Refused(413, f"a request may have {most} bytes")
        if not message.get("more_body", False):
            return bytes(body)


def _replay(body: bytes | None, receive: Receive) -> Receive:
    """Hand on a body that was read already, and after it what else comes."""
    if body is None:
        return receive
    waiting: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

    async def again() -> Any:
        return waiting.pop() if waiting else await receive()

    return again


def _where(error: Exception, scope: Scope) -> str:
    """What went wrong and where, without what anybody sent: messages of errors may hold it."""
    frame = traceback.extract_tb(error.__traceback__)[-1]
    route = getattr(scope.get("route"), "path", "?")
    return f"{type(error).__name__} in {frame.name} (line {frame.lineno}) while answering {scope['method']} {route}"
