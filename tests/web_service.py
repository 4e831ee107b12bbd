"""A labelling service on a store, and browsers that have come in: for tests of the server."""

from __future__ import annotations

import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from typing import Any

from starlette.testclient import TestClient
from starlette.types import ASGIApp

from prefrl.page import api
from prefrl.page.app import create_app
from prefrl.page.questions import Policy, Terms
from prefrl.page.security import Buckets
from prefrl.page.service import Service
from prefrl.page.shown import Showing
from prefrl.store import Store

ORIGIN = "http://127.0.0.1:8900"
STRENGTHS = {"slight": 0.73, "clear": 0.88, "much": 0.95}


class Clock:
    """Monotonic seconds that pass when the test says so."""

    def __init__(self) -> None:
        self.now = 1000.0

    def __call__(self) -> float:
        return self.now


def page(kind: Any = "control", ask: api.Ask = "judge") -> api.Page:
    return api.Page(
        title="test",
        question="Which is better?",
        kind=kind,
        strength=True,
        markdown=False,
        minimum_watched=0,
        break_minutes=30,
        ui_version="0",
        ask=ask,
    )


@contextmanager
def serving(
    store: Store[Any],
    kind: Any = "control",
    fixed: bool = False,
    ask: api.Ask = "judge",
    shows: Showing | None = None,
    **policy: Any,
) -> Iterator[Service]:
    """An open service with a clock of its own; how often somebody asks is not limited."""
    terms = Terms(page(kind, ask), Policy(**policy), STRENGTHS, fixed=fixed, rate=1e6, fps=10.0, shows=shows)
    service = Service(store, terms, clock=Clock())
    service.logins = Buckets(1e6, 1e6, service.clock)
    service.open()
    try:
        yield service
    finally:
        service.close()


def browser(service: Service) -> TestClient:
    """Somebody who is not logged in."""
    made = TestClient(_app(service), base_url=ORIGIN, raise_server_exceptions=False)
    made.headers["origin"] = ORIGIN
    return made


@cache
def _app(service: Service) -> ASGIApp:
    """One application for all browsers: making it takes longer than most tests."""
    return create_app(service)


def invite(service: Service, name: str, role: Any = "annotator") -> str:
    """The token of a new link."""
    token, events = service.access.invite(name, role)
    service.append(events)
    return token


def log_in(service: Service, name: str, role: Any = "annotator") -> TestClient:
    """The browser of somebody who came by a link."""
    client = browser(service)
    answer = client.post("/api/session", json={"token": invite(service, name, role)})
    assert answer.status_code == 200, answer.text
    return client


def ask_for(client: TestClient, want: int = 1) -> list[dict[str, Any]]:
    """Questions that somebody holds, or is given."""
    found: list[dict[str, Any]] = client.post("/api/assignments", json={"want": want}).json()["assignments"]
    return found


def answering(assignment: str, outcome: str = "first", **more: Any) -> dict[str, Any]:
    """The body of a new answer."""
    return {"submission_id": secrets.token_hex(16), "assignment_id": assignment, "outcome": outcome, **more}
