"""The web server: uvicorn with one worker, in a thread of the process that owns the store."""

from __future__ import annotations

import asyncio
import errno
import socket
import threading
import time
from pathlib import Path
from typing import Any, cast

import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.h11_impl import H11Protocol

from prefrl.components import ConfigError

CONNECTIONS = 500
"""Kept open at once; with more, the one that has been silent longest makes room."""
SILENT_SECONDS = 20.0
"""How long a connection may go without a whole request."""
BACKLOG = 256
"""Connections that may come at once: so many may be open beyond those, before there is a chance to make room."""
MOST = 900
"""Open at once, with those on their way in or out, before others are told to come later: of 1024 files, as a rule."""
CLOSING_SECONDS = 2
"""In which requests may come to their end when the server stops."""


class Doorman:
    """Makes the protocol of each connection, and shows out those that only sit there.

    uvicorn waits for ever for a first request, for the rest of a request's head, and for a client to read: slow or
    silent clients could take all places.
    """

    def __init__(self) -> None:
        self._since: dict[H11Protocol, tuple[float, object]] = {}
        """When a connection was first seen waiting for a request, and its request before that."""
        self.connections: set[H11Protocol] = set()

    def __call__(self, server_state: Any, **parts: Any) -> H11Protocol:
        self.connections = server_state.connections
        self._make_room()
        made = H11Protocol(server_state=server_state, **parts)
        self._since[made] = time.monotonic(), None
        return made

    def _make_room(self) -> None:
        """Cut off the one that has been silent longest, if there are too many: not one that is on its way out."""
        if len(self._since) < CONNECTIONS:
            return
        self._since = {one: seen for one, seen in self._since.items() if not self._gone(one)}
        there = [one for one in self._since if not (_met(one) and one.transport.is_closing())]
        idle = [one for one in there if _met(one) and _idle(one)]
        if len(there) >= CONNECTIONS and idle:
            min(idle, key=lambda one: self._since[one][0]).transport.abort()

    async def sweep(self) -> None:
        """Close the connections that have been silent for too long; called every few seconds."""
        now = time.monotonic()
        self._since = {one: seen for one, seen in self._since.items() if not self._gone(one)}
        for one, (since, request) in list(self._since.items()):
            leaving = _met(one) and one.transport.is_closing()
            if not (leaving or (_idle(one) and one.cycle is request)):
                self._since[one] = now, one.cycle
            elif now - since > SILENT_SECONDS and leaving:
                one.transport.abort()  # it does not read what it was sent last
            elif now - since > SILENT_SECONDS and _met(one):
                one.transport.close()

    def _gone(self, one: H11Protocol) -> bool:
        return _met(one) and one not in self.connections


class WebServer:
    """Serves an application from `start` to `stop`."""

    def __init__(self, app: ASGIApp, tls: tuple[Path, Path] | None = None) -> None:
        """`tls`: files with the certificate and its key."""
        doorman = Doorman()
        config = uvicorn.Config(
            cast(Any, app),
            loop="asyncio",
            http=cast(Any, doorman),
            ws="none",
            lifespan="off",
            log_config=None,
            log_level="critical",
            access_log=False,
            proxy_headers=False,  # anybody could name another address in X-Forwarded-For
            server_header=False,  # no version for those who look for old ones
            limit_concurrency=MOST,
            backlog=BACKLOG,
            timeout_keep_alive=15,
            timeout_graceful_shutdown=CLOSING_SECONDS,
            timeout_notify=2,
            callback_notify=doorman.sweep,
            ssl_certfile=tls[0] if tls else None,
            ssl_keyfile=tls[1] if tls else None,
        )
        self._server = uvicorn.Server(config)
        self._thread: threading.Thread | None = None

    def start(self, host: str, port: int) -> int:
        """Listen, and return the port. Raises `ConfigError` where that is not possible."""
        listener = listen(host, port)
        try:
            self._server.config.load()
        except OSError as error:  # of which ssl.SSLError is one
            listener.close()
            raise ConfigError(
                f"labeler.tls_cert and labeler.tls_key hold no certificate and its key in PEM ({error.strerror})"
            ) from None
        self._thread = threading.Thread(target=self._run, args=(listener,), name="prefrl-server", daemon=True)
        self._thread.start()
        return int(listener.getsockname()[1])

    def stop(self) -> None:
        """Let the requests that are being answered end, and stop."""
        self._server.should_exit = True
        if self._thread is not None:
            self._thread.join(CLOSING_SECONDS + 2)

    def _run(self, listener: socket.socket) -> None:
        asyncio.run(self._server.serve(sockets=[listener]))


def listen(host: str, port: int) -> socket.socket:
    """A socket on an address. Raises `ConfigError` where it is taken, or is not this machine's."""
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)[0]
    except OSError as error:
        raise ConfigError(
            f"labeler.host={host}: there is no such host ({error.strerror}); expected an address of this machine, or "
            "0.0.0.0 for all of them"
        ) from None
    try:
        return socket.create_server(cast(Any, address[:2]), family=family, backlog=BACKLOG)
    except OSError as error:
        if error.errno == errno.EADDRNOTAVAIL:
            raise ConfigError(
                f"labeler.host={host}: that is no address of this machine; expected one, or 0.0.0.0 for all of them"
            ) from None
        raise ConfigError(
            f"labeler.port={port}: cannot listen on {host} ({error.strerror}); choose another port, or 0 for any"
        ) from None


def check_tls(cert: Path | None, key: Path | None) -> tuple[Path, Path] | None:
    """The files of a certificate and its key, if there are any. Raises `ConfigError` where one cannot be read."""
    for name, path in (("tls_cert", cert), ("tls_key", key)):
        try:
            if path is not None:
                path.open("rb").close()
        except OSError as error:
            raise ConfigError(f"labeler.{name}={path}: cannot be read ({error.strerror})") from None
    return (cert, key) if cert and key else None


def _idle(connection: H11Protocol) -> bool:
    """Whether a connection waits for a request, or for the rest of one's head."""
    return connection.cycle is None or connection.cycle.response_complete


def _met(connection: H11Protocol) -> bool:
    """Whether a connection is there already: its protocol is made a moment earlier."""
    return cast(Any, connection).transport is not None
