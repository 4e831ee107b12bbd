"""A page that is being served: everything that is opened and closed with it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from prefrl.components import ConfigError
from prefrl.kinds import named
from prefrl.page import records
from prefrl.page.app import create_app
from prefrl.page.clips.queue import Clips, ClipSettings
from prefrl.page.questions import Terms
from prefrl.page.security import LOOPBACK, Rules
from prefrl.page.serve import WebServer, check_tls
from prefrl.page.service import Service
from prefrl.store import Store

GOODBYE_SECONDS = 2.5
"""A little longer than a page waits before it asks how things stand."""
FIRST = 2
"""Questions whose clips are drawn before anybody asks."""
SPARING = 50.0
"""Times as long as a look at all questions took is waited before the next."""
EVERYWHERE = ("0.0.0.0", "::")


@dataclass(frozen=True)
class Address:
    """Where a page is served, and under which names people reach it."""

    host: str = "127.0.0.1"
    port: int = 8900
    """0 takes any free one."""
    allowed_hosts: tuple[str, ...] = ()
    """Other names than the host's own."""
    tls_cert: Path | None = None
    tls_key: Path | None = None

    def url(self, port: int) -> str:
        """The address that people open, at the port that was taken."""
        host = "127.0.0.1" if self.host in EVERYWHERE else self.host
        name = f"[{host}]" if ":" in host else host
        return f"{'https' if self.tls_cert else 'http'}://{name}:{port}/"

    def names(self) -> set[str]:
        """The names under which the page may be reached."""
        host = self.host.lower()
        own = set() if host in EVERYWHERE else {f"[{host}]" if ":" in host else host}
        return {*LOOPBACK, *own, *(name.lower() for name in self.allowed_hosts)}

    def warnings(self) -> list[str]:
        """What is open to others, and should be known to be."""
        found = []
        if self.host not in ("127.0.0.1", "localhost", "::1") and self.tls_cert is None:
            found.append(
                f"the page is served on {self.host} without TLS: everybody on the way can read along, and take links; "
                "set labeler.tls_cert and labeler.tls_key, or keep to a network that you trust"
            )
        if self.host in EVERYWHERE and not self.allowed_hosts:
            found.append("people reach the page only by names in labeler.allowed_hosts, and there are none")
        return found


@dataclass
class Site:
    """The service, the clips and the web server of one store."""

    service: Service
    clips: Clips | None
    server: WebServer
    address: str = ""
    notes: list[str] = field(default_factory=list)
    """What people should know, the link first."""
    _pause: float = 0.0
    """Seconds to leave between two looks at all questions."""

    def close(self) -> None:
        """No more requests, then what waits is written, then the clips end."""
        self.service.finished = True
        self.server.stop()
        self.service.close()
        if self.clips is not None:
            self.clips.close()

    def judged(self) -> tuple[int, int, int]:
        """How many questions were asked, how many are judged, and how many nobody can judge."""
        with self._sparing(), self.service.store.log.reading() as connection:
            asked, judged = records.judged(connection)
            return asked, judged, self.stuck()

    def left(self) -> int:
        """How many questions still need answers that somebody could give."""
        with self._sparing():
            counts = self.service.desk.counts()
            return counts.asked - counts.answered - self.stuck()

    def stuck(self) -> int:
        """How many open questions all active people have skipped."""
        return self.service.desk.stuck(person.name for person in self.service.access.active())

    def open_queries(self) -> list[str]:
        """The ids of questions without any answer but a skip."""
        with self.service.store.log.reading() as connection:
            return records.open_queries(connection)

    def undrawn(self) -> list[str]:
        """The candidates of the questions that come first whose clips are still to be drawn."""
        if self.clips is None:
            return []
        with self.service.store.log.reading() as connection:
            queries = records.first_queries(connection, self.service.desk.policy.overlap, FIRST)
            found = records.candidates(connection, queries)
        return self.clips.missing([candidate["id"] for query in queries for candidate in found[query]])

    def people_missing(self) -> str:
        """Why the people who are there cannot answer everything, if it is so; for people to read."""
        overlap, there = self.service.desk.policy.overlap, len(self.service.access.active())
        if not there:
            return "; nobody can answer just now: let somebody in again on the page"
        short = self.service.terms.fixed and there < overlap  # a round goes on with one answer to each
        return f"; each needs {overlap} different people: invite more on the page" if short else ""

    def say_goodbye(self) -> bool:
        """Tell the pages that all is done, and let them ask once more; whether all is done still.

        An answer may be taken back until the end, and is waited for again.
        """
        self.service.finished = True
        time.sleep(GOODBYE_SECONDS)
        self.service.finished = self.left() <= 0
        return self.service.finished

    def wait(self, seconds: float) -> None:
        """Until the next answer, but no longer than about this."""
        time.sleep(min(self._pause, seconds))
        with self.service.changed:
            self.service.changed.wait(seconds)

    @contextmanager
    def _sparing(self) -> Iterator[None]:
        """A look at all questions after each answer would leave no time for the answers, where there are many."""
        begin = time.thread_time()  # this thread's own: waiting for others is no reason to look less often
        yield
        self._pause = SPARING * (time.thread_time() - begin)


def open_site(store: Store, terms: Terms, address: Address, name: str, clips: ClipSettings | None) -> Site:
    """Open the service, and serve it. Raises `ConfigError` where the address is taken.

    `name`: the admin whose link is printed. `clips`: how clips are drawn, None where candidates need none.
    """
    tls = check_tls(address.tls_cert, address.tls_key)
    store.log.reserve()
    still = named(terms.page.kind).still
    drawn = Clips(store.folder, clips, still=still) if clips is not None else None
    service = Service(store, terms, drawn)
    server = WebServer(create_app(service, Rules(frozenset(address.names()))), tls)
    service.open()  # before the server: the first request finds everything loaded
    site = Site(service, drawn, server)
    try:
        port = server.start(address.host, address.port)
        if drawn is not None:
            drawn.start()
        site.address = address.url(port)
        site.notes = [f"label here: {site.address}#{_invite(service, name)}", *service.notes, *address.warnings()]
    except BaseException:
        site.close()
        raise
    return site


def _invite(service: Service, name: str) -> str:
    """A new token for the person who started this; the links of earlier starts end, their sessions do not."""
    try:
        token, events = service.access.invite(name, "admin")
    except ValueError as error:
        raise ConfigError(f"labeler.name: {error}") from None
    service.append([*service.access.forget_invites(name), *events])
    return token
