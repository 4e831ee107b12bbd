"""What the application says of itself, held against what it does: requests made from its own description."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import pytest
import schemathesis
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from hypothesis.errors import Unsatisfiable
from schemathesis import GenerationMode
from schemathesis.checks import CHECKS
from starlette.testclient import TestClient
from stores import responses
from web_service import ask_for, browser, invite, log_in, serving

from prefrl.page.app import routes
from prefrl.page.security import Buckets
from prefrl.page.service import Service
from prefrl.store import Store

CONFORM = ("not_a_server_error", "status_code_conformance", "content_type_conformance", "response_schema_conformance")
ROLES = ("annotator", "admin", "trainer", "nobody")
MODES = (GenerationMode.POSITIVE, GenerationMode.NEGATIVE)
OWN = ("authorization", "cookie", "host", "origin", "content-length", "user-agent")
"""Headers that a client sets itself."""


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    with Store[Any](tmp_path_factory.mktemp("store")) as store:
        store.ask([*responses(20), *responses(20, 3)])
        with serving(store, "text", overlap=2) as opened:
            opened.logins = Buckets(1e6, 1e6, opened.clock)
            yield opened


@pytest.fixture(scope="module")
def operations(service: Service) -> list[Any]:
    """Everything that the application says it can do."""
    described: Any = schemathesis.openapi.from_dict(routes(service).openapi())
    return [one.ok() for one in described.get_all_operations()]


def come_in(service: Service, role: Any) -> TestClient:
    """The browser, or the program, of somebody in this role."""
    if role == "nobody":
        return browser(service)
    if role == "trainer":
        client = browser(service)
        client.headers["authorization"] = f"Bearer {invite(service, 'run', 'trainer')}"
        return client
    return log_in(service, f"some {role}", role)


def send(client: TestClient, case: Any) -> Any:
    """Send a request as this client: with its own way in, not with a made one."""
    sent = case.as_transport_kwargs(base_url=str(client.base_url))
    sent.pop("cookies", None)
    if isinstance(sent.get("data"), bytes | str):
        sent["content"] = sent.pop("data")
    headers = {name: value for name, value in sent.pop("headers").items() if name.lower() not in OWN}
    return client.request(**sent, headers=headers)


def hold_to_it(client: TestClient, requests: st.SearchStrategy[Any], examples: int) -> Counter[int]:
    """Send made requests, and hold the answers against the description; how often each status came."""
    checks: list[Any] = CHECKS.get_by_names(list(CONFORM))
    came: Counter[int] = Counter()

    @settings(
        max_examples=examples,
        phases=[Phase.generate],
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(requests)
    def hold(case: Any) -> None:
        answer = send(client, case)
        came[answer.status_code] += 1
        case.validate_response(answer, checks=checks)

    with suppress(Unsatisfiable):  # a wrong request cannot be made where nothing is asked for
        hold()
    return came


def hold_all(service: Service, operations: list[Any], role: str, mode: GenerationMode, examples: int) -> None:
    total: Counter[int] = Counter()
    for operation in operations:
        came = hold_to_it(come_in(service, role), operation.as_strategy(generation_mode=mode), examples)
        total += came
        if role == "nobody" and operation.path.startswith("/api/") and operation.path != "/api/session":
            assert not any(status < 400 for status in came), operation.label
        if role != "admin" and operation.path.startswith("/api/admin/"):
            assert not any(status < 400 for status in came), operation.label
    assert sum(total.values()) >= 10 * examples
    assert (total[200] > 0) or mode is GenerationMode.NEGATIVE


@pytest.mark.parametrize("role", ROLES)
@pytest.mark.parametrize("mode", MODES)
def test_whoever_asks_for_what_the_answer_is_a_declared_one(
    service: Service, operations: list[Any], role: str, mode: GenerationMode
) -> None:
    hold_all(service, operations, role, mode, 2)


@pytest.mark.parametrize("role", ROLES)
@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize(
    "examples", [pytest.param(10, marks=pytest.mark.slow), pytest.param(100, marks=pytest.mark.nightly)]
)
def test_whoever_asks_often_the_answer_is_a_declared_one(
    service: Service, operations: list[Any], role: str, mode: GenerationMode, examples: int
) -> None:
    hold_all(service, operations, role, mode, examples)


@pytest.mark.parametrize("path", ["/api/answers", "/api/undo", "/api/flags"])
def test_whatever_is_said_of_a_question_that_there_is_the_answer_is_a_declared_one(
    service: Service, operations: list[Any], path: str
) -> None:
    client = log_in(service, f"worker at {path[5:]}")
    held = [one["assignment_id"] for one in ask_for(client, 4)]
    made = next(one for one in operations if one.path == path).as_strategy(generation_mode=GenerationMode.POSITIVE)
    came = hold_to_it(client, st.builds(about, made, st.sampled_from(held)), 30)
    assert set(came) & {200, 409}


def about(case: Any, assignment: str) -> Any:
    case.body["assignment_id"] = assignment
    return case
