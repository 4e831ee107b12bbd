"""A page that is being served: everything that `WebLabeler` opens and closes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal, cast

from prefrl.components import ConfigError
from prefrl.page import api, records
from prefrl.page import static_files as pages
from prefrl.page.app import create_app
from prefrl.page.clips.queue import Clips
from prefrl.page.questions import Policy
from prefrl.page.security import LOOPBACK, Rules
from prefrl.page.serve import WebServer, check_tls
from prefrl.page.service import Service
from prefrl.page.terms import Terms
from prefrl.protocols import ControlTask
from prefrl.store import Store

if TYPE_CHECKING:
    from prefrl.label.web import WebLabeler

QUESTIONS = {"control": "Which clip is better?", "text": "Which response is better?"}
GOODBYE_SECONDS = 2.5
"""A little longer than a page waits before it asks how things stand."""
SPARING = 50.0
"""Times as long as a look at all questions took is waited before the next."""
EVERYWHERE = ("0.0.0.0", "::")


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
        begin = time.thread_time()
        yield
        self._pause = SPARING * (time.thread_time() - begin)


def open_site(labeler: WebLabeler, store: Store[Any]) -> Site:
    """Open the service, and serve it. Raises `ConfigError` where the address is taken."""
    settings = labeler.settings
    tls = check_tls(settings.tls_cert, settings.tls_key)
    store.log.reserve()
    clips = Clips(store.folder, settings.clips) if labeler.task.kind == "control" else None
    service = Service(store, terms_of(labeler), clips)
    server = WebServer(create_app(service, Rules(frozenset(hosts(labeler)))), tls)
    service.open()
    site = Site(service, clips, server)
    try:
        port = server.start(settings.host, settings.port)
        if clips is not None:
            clips.start()
        host = "127.0.0.1" if settings.host in EVERYWHERE else settings.host
        name = f"[{host}]" if ":" in host else host
        site.address = f"{'https' if tls else 'http'}://{name}:{port}/"
        site.notes = [
            f"label here: {site.address}#{_invite(service, settings.name)}",
            *service.notes,
            *warnings(labeler),
        ]
    except BaseException:
        site.close()
        raise
    return site


def terms_of(labeler: WebLabeler) -> Terms:
    """What a project asks and how, from its settings."""
    settings, task = labeler.settings, labeler.task
    page = api.Page(
        title=task.name,
        question=settings.question or QUESTIONS[task.kind],
        kind=cast(Literal["control", "text"], task.kind),
        strength=settings.strength,
        markdown=settings.markdown,
        minimum_watched=settings.minimum_watched if task.kind == "control" else 0.0,
        break_minutes=settings.break_minutes,
        ui_version=pages.ui_version(pages.static_files()),
    )
    lease = settings.lease_seconds or (120.0 if task.kind == "control" else 600.0)
    policy = Policy(settings.overlap, lease, settings.check_share, settings.repeat_share, settings.seed)
    return Terms(
        page=page,
        policy=policy,
        strengths=dict(settings.strengths),
        guideline=settings.guideline,
        consent=settings.consent,
        fps=cast(ControlTask, task).fps if task.kind == "control" else 0.0,
        fixed=labeler.fixed and not settings.stay_open,
        check_warn=settings.check_warn,
        check_pause=settings.check_pause,
        rate=settings.requests_per_second,
    )


def hosts(labeler: WebLabeler) -> set[str]:
    """The names under which the page may be reached."""
    host = labeler.settings.host.lower()
    own = set() if host in EVERYWHERE else {f"[{host}]" if ":" in host else host}
    return {*LOOPBACK, *own, *(name.lower() for name in labeler.settings.allowed_hosts)}


def warnings(labeler: WebLabeler) -> list[str]:
    """What is open to others, and should be known to be."""
    settings = labeler.settings
    found = []
    if settings.host not in ("127.0.0.1", "localhost", "::1") and settings.tls_cert is None:
        found.append(
            f"the page is served on {settings.host} without TLS: everybody on the way can read along, and take links; "
            "set labeler.tls_cert and labeler.tls_key, or keep to a network that you trust"
        )
    if settings.host in EVERYWHERE and not settings.allowed_hosts:
        found.append("people reach the page only by names in labeler.allowed_hosts, and there are none")
    return found


def _invite(service: Service, name: str) -> str:
    """A new token for the person who started this; the links of earlier starts end, their sessions do not."""
    try:
        token, events = service.access.invite(name, "admin")
    except ValueError as error:
        raise ConfigError(f"labeler.name: {error}") from None
    service.append([*service.access.forget_invites(name), *events])
    return token
